"""The engine as a child process: its command line, its events, its end."""

from __future__ import annotations

import contextlib
import json
import logging
import math
import signal
import subprocess
import threading
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from service.processes import launch, stop_group

log = logging.getLogger(__name__)

#: The options of a job and the engine's flags for them.
FLAGS: dict[str, str] = {
    "preset": "--preset",
    "side": "--side",
    "seed": "--seed",
    "fov": "--fov",
    "max_frames": "--max-frames",
    "holdout": "--holdout",
    "device": "--device",
}

_MAX_LINE = 64 * 1024
_TAIL_LINES = 40
_UNREAD_LINES = 500
_MAX_WARNINGS = 100


@dataclass(frozen=True)
class EngineProgress:
    """One progress event; ``fraction`` is between 0 and 1, ``time_left`` in seconds or unknown."""

    stage: str
    fraction: float
    time_left: float | None
    message: str


@dataclass(frozen=True)
class EngineFailure:
    """What the engine said was wrong: a stable code, a sentence, and what to do about it."""

    code: str
    message: str
    advice: str


class UnknownOptionError(ValueError):
    """A job carries an option the engine has no flag for."""


def fit_command(
    engine: Sequence[str],
    video: Path,
    run: Path,
    options: Mapping[str, str | int | float | None],
    *,
    resume: bool = False,
    from_stage: str | None = None,
    max_seconds: float | None = None,
) -> list[str]:
    """The command that fits ``video`` into the directory ``run``, or goes on with what lies there already.

    ``from_stage``: of what lies there, only what came before this stage counts. A video longer than
    ``max_seconds`` is to be refused. Raises UnknownOptionError.
    """
    unknown = sorted(set(options) - set(FLAGS))
    if unknown:
        raise UnknownOptionError(f"unknown option {unknown[0]!r}")
    # One word per option, so that no value can be taken for a flag.
    flags = [f"{FLAGS[name]}={value}" for name, value in options.items() if value is not None]
    if max_seconds is not None:
        flags.append(f"--max-seconds={max_seconds:g}")
    if resume:
        flags.append("--resume")
        if from_stage is not None:
            flags.append(f"--from-stage={from_stage}")
    return [*engine, "fit", str(video), "--out", str(run), "--json", *flags]


def animate_command(
    engine: Sequence[str], avatar: Path, run: Path, motion: Mapping[str, object], device: str | None = None
) -> list[str]:
    """The command that renders a motion of ``avatar`` into the directory ``run``; ``device``: the engine's
    choice if there is none."""
    spec = run / "motion.json"
    spec.write_text(json.dumps(motion))
    words = [*engine, "animate", str(avatar), "--motion", str(spec), "--out", str(run), "--json"]
    return words if device is None else [*words, f"--device={device}"]


class EngineProcess:
    """One run. Start it from the thread that stays until it ends; always call :meth:`stop` at the end.

    ``warnings`` begin with those given, of runs before it.
    """

    def __init__(
        self, command: Sequence[str], environment: Mapping[str, str], warnings: Sequence[dict[str, str]] = ()
    ) -> None:
        self.progress: EngineProgress | None = None
        self.failure: EngineFailure | None = None
        self.warnings = [*warnings]
        self._tail: deque[str] = deque(maxlen=_TAIL_LINES)
        self._said: deque[str] = deque(maxlen=_UNREAD_LINES)
        self._closed = threading.Event()
        self._process = launch(
            command,
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            death_signal=signal.SIGKILL,
        )
        assert self._process.stdout is not None
        assert self._process.stderr is not None
        self._readers = [
            threading.Thread(target=self._read_events, args=(self._process.stdout,), daemon=True),
            threading.Thread(target=self._read_tail, args=(self._process.stderr,), daemon=True),
        ]
        for reader in self._readers:
            reader.start()

    @property
    def pid(self) -> int:
        """The process id, which is also the id of its group and session."""
        return self._process.pid

    @property
    def tail(self) -> str:
        """The last lines it wrote that were no events."""
        return "\n".join(self._tail)

    def new_lines(self) -> list[str]:
        """What it said to the job's owner since the last call: stages, warnings, its error."""
        lines = []
        with contextlib.suppress(IndexError):
            while True:
                lines.append(self._said.popleft())
        return lines

    def wait(self, seconds: float) -> int | None:
        """The exit code, negative for a signal, or None while it runs; returns early when it ends."""
        if self._closed.wait(seconds):
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(seconds)
        return self._process.poll()

    def stop(self, grace: float) -> int:
        """End the whole process group: ask, wait ``grace`` seconds, kill. Also reaps one that has ended."""
        code = stop_group(self._process, grace)
        for reader in self._readers:
            reader.join(5.0)
        return code

    def _read_events(self, stream: IO[bytes]) -> None:
        with stream:
            while line := stream.readline(_MAX_LINE):
                self._take(line)
        self._closed.set()

    def _read_tail(self, stream: IO[bytes]) -> None:
        with stream:
            while line := stream.readline(_MAX_LINE):
                self._tail.append(line.decode(errors="replace").rstrip()[:500])

    def _take(self, line: bytes) -> None:
        event = _parse(line)
        kind = event.get("type")
        if kind == "progress":
            before, self.progress = self.progress, _progress(event)
            if before is None or before.stage != self.progress.stage:
                self._said.append(f"stage {self.progress.stage}")
        elif kind == "error":
            self.failure = EngineFailure(
                _text(event, "code", 80), _text(event, "message", 1000), _text(event, "advice", 1000)
            )
            self._said.append(f"error {self.failure.code}: {self.failure.message}")
        elif kind == "warning":
            warning = {key: _text(event, key, 900) for key in ("code", "message", "advice")}
            if len(self.warnings) < _MAX_WARNINGS and warning not in self.warnings:
                self.warnings = [*self.warnings, warning]
            # Its words are for the job's owner, and go when the job goes; the log stays.
            log.info("engine %d warns: %s", self.pid, warning["code"][:80])
            self._said.append(f"warning {_text(event, 'code', 80)}: {_text(event, 'message', 900)}")
        elif kind != "done":
            self._tail.append(line.decode(errors="replace").rstrip()[:500])


def _parse(line: bytes) -> dict[str, Any]:
    try:
        event = json.loads(line)
    except ValueError:  # a library that prints; bad UTF-8 is a ValueError as well
        return {}
    return event if isinstance(event, dict) else {}


def _progress(event: Mapping[str, Any]) -> EngineProgress:
    fraction = _number(event.get("fraction"))
    time_left = _number(event.get("time_left"))
    return EngineProgress(
        stage=_text(event, "stage", 40),
        fraction=min(max(fraction or 0.0, 0.0), 1.0),
        time_left=None if time_left is None else max(time_left, 0.0),
        message=_text(event, "message", 500),
    )


def _number(value: object) -> float | None:
    """A finite number, else None."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        return None
    return float(value)


def _text(event: Mapping[str, Any], key: str, longest: int) -> str:
    value = event.get(key)
    return value[:longest] if isinstance(value, str) else ""
