"""Reading a file in a child process that may not use more than so much memory and time."""

from __future__ import annotations

import multiprocessing
import resource
import sys
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path

from mass_engine.errors import EngineError
from mass_engine.video.reader import VideoWarning, read_frames

#: Address space beyond what the child starts with: threads' stacks take much of it; the bombs ask for more.
MEMORY = 4 << 30
SECONDS = 60.0


@dataclass
class Outcome:
    """What reading a file ended in. ``code`` is empty for a file that was read; ``grown`` in bytes."""

    code: str = ""
    message: str = ""
    advice: str = ""
    sizes: set[tuple[int, int]] = field(default_factory=set)
    times: list[float] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    grown: int = 0


def read_bounded(path: Path) -> Outcome:
    """Read all of ``path`` in a child. Fails when it crashes, hangs or asks for too much memory."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([__name__])
    ours, theirs = context.Pipe(duplex=False)
    child = context.Process(target=_read, args=(theirs, path), daemon=True)
    child.start()
    theirs.close()
    try:
        if not ours.poll(SECONDS):
            raise AssertionError(f"reading took more than {SECONDS:.0f} s")
        outcome = ours.recv()
    except EOFError:
        child.join()
        raise AssertionError(f"the reader died with {child.exitcode}") from None
    finally:
        child.kill()
        child.join()
    assert isinstance(outcome, Outcome)
    return outcome


def _read(answer: Connection, path: Path) -> None:
    if sys.platform == "linux":  # elsewhere address space is counted in ways that say little
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        limit = pages * resource.getpagesize() + MEMORY
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    before, outcome = _peak(), Outcome()
    warnings: list[VideoWarning] = []
    try:
        for frame in read_frames(path, on_warning=warnings.append):
            outcome.sizes.add((frame.rgb.shape[0], frame.rgb.shape[1]))
            outcome.times.append(frame.time)
    except EngineError as error:
        outcome.code, outcome.message, outcome.advice = error.code, error.message, error.advice
    outcome.warnings = [warning.code for warning in warnings]
    outcome.grown = _peak() - before
    answer.send(outcome)


def _peak() -> int:
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit
