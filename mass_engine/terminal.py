"""Progress on a terminal: one bar with the stage and the time left; plain lines elsewhere."""

from __future__ import annotations

from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, TaskProgressColumn, TextColumn
from rich.progress import Progress as RichProgress

from mass_engine.progress import Progress


class TerminalProgress:
    """A context manager whose ``report`` takes :class:`Progress` and whose ``warn`` prints a warning."""

    def __init__(self) -> None:
        self._console = Console(stderr=True)
        self._bar = RichProgress(
            TextColumn("{task.description:<9}"),
            BarColumn(),
            TaskProgressColumn(),
            TextColumn("{task.fields[left]}"),
            TextColumn("{task.fields[note]}"),
            console=self._console,
            disable=not self._console.is_terminal,
        )
        self._task = self._bar.add_task("start", total=1.0, left="", note="")
        self._stage = ""

    def __enter__(self) -> TerminalProgress:
        self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.stop()

    def report(self, step: Progress) -> None:
        """Show one report."""
        left = "" if step.time_left is None else f"{step.time_left:.0f} s left"
        self._bar.update(
            self._task, completed=step.fraction, description=step.stage, left=left, note=step.message
        )
        if not self._console.is_terminal and step.stage != self._stage:
            self._console.print(f"{step.stage} ({step.fraction:.0%})", highlight=False)
        self._stage = step.stage

    def warn(self, code: str, message: str, advice: str) -> None:
        """Show one warning."""
        self._console.print(f"warning: {code}: {message} {advice}", highlight=False)
