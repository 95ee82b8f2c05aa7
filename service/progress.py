"""Progress of transfers and jobs on a terminal; plain lines where there is none."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.progress import (
    BarColumn,
    DownloadColumn,
    Progress,
    TaskProgressColumn,
    TextColumn,
    TimeElapsedColumn,
    TransferSpeedColumn,
)

from service.client import BytesProgress, JobInfo


@contextmanager
def transfer_bar(title: str) -> Iterator[BytesProgress | None]:
    """A bar on standard error for bytes sent or received; None where there is no terminal."""
    if not sys.stderr.isatty():
        yield None
        return
    columns = (TextColumn("{task.description}"), BarColumn(), DownloadColumn(), TransferSpeedColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(title, total=None)

        def tell(done: int, total: int) -> None:
            bar.update(task, completed=done, total=total)

        yield tell


class FollowBar:
    """Shows a job while it runs: a bar on a terminal, else one line per change of state or stage."""

    def __init__(self) -> None:
        self._bar: Progress | None = None
        self._said: tuple[str, str | None] | None = None
        if sys.stderr.isatty():
            columns = (
                TextColumn("{task.description:9}"),
                BarColumn(),
                TaskProgressColumn(),
                TextColumn("{task.fields[left]}"),
                TimeElapsedColumn(),
            )
            self._bar = Progress(*columns, console=Console(stderr=True))
            self._task = self._bar.add_task("queued", total=1.0, left="")

    def __enter__(self) -> Self:
        if self._bar is not None:
            self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.stop()

    def show(self, job: JobInfo) -> None:
        """Take in what the service said last."""
        doing = job.stage or job.state if job.state == "running" else job.state
        if self._bar is not None:
            self._bar.update(self._task, description=doing, completed=job.fraction, left=_left(job.time_left))
        elif (job.state, job.stage) != self._said:
            print(f"{doing} {job.fraction:.0%} {_left(job.time_left)}".rstrip(), file=sys.stderr, flush=True)
        self._said = (job.state, job.stage)


def _left(seconds: float | None) -> str:
    if seconds is None:
        return ""
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes}:{rest:02d} left"
