"""Child processes that cannot outlive their parent and are stopped as a whole group."""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from service import launcher

_PR_SET_DUMPABLE = 4


@dataclass
class Backoff:
    """Pauses before starting again what died: none, then doubling from ``first`` to ``last`` seconds."""

    first: float = 0.5
    last: float = 30.0
    _pause: float = 0.0

    def next(self, ran: float) -> float:
        """Seconds to wait, after a run of ``ran`` seconds. A long run wipes the slate clean."""
        if ran > 2 * self.last:
            self._pause = 0.0
        pause, self._pause = self._pause, min(max(self.first, 2 * self._pause), self.last)
        return pause


def launch(
    command: Sequence[str],
    *,
    env: Mapping[str, str] | None = None,
    cwd: Path | None = None,
    stdout: int | IO[bytes] | None = None,
    stderr: int | IO[bytes] | None = None,
    death_signal: signal.Signals = signal.SIGKILL,
    limits: Mapping[str, int] | None = None,
    pass_fds: Sequence[int] = (),
) -> subprocess.Popen[bytes]:
    """Start ``command`` in its own session, bound to the calling thread (Linux) and to ``limits``.

    The kernel sends ``death_signal`` to the child when the *thread* that called this ends, however it ends:
    call it from a thread that lives as long as the child should. A terminal's Ctrl-C does not reach it.
    """
    spec = {"parent": os.getpid(), "death_signal": int(death_signal), "limits": dict(limits or {})}
    return subprocess.Popen(
        [sys.executable, "-I", "-S", launcher.__file__, json.dumps(spec), *command],
        stdin=subprocess.DEVNULL,
        stdout=stdout,
        stderr=stderr,
        env=None if env is None else dict(env),
        cwd=cwd,
        start_new_session=True,
        pass_fds=tuple(pass_fds),
    )


def hide_memory() -> None:
    """Keep other processes of this user, an engine that was taken over for one, from reading this process's
    memory and environment, where passwords are (Linux; elsewhere do nothing). There are no core dumps then.
    """
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_DUMPABLE, 0, 0, 0, 0)


def signal_group(process: subprocess.Popen[bytes], number: signal.Signals) -> None:
    """Send ``number`` to every process of the child's group that still exists."""
    # The group outlives its leader while any member does; once empty, its id stays unused for long enough.
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(process.pid, number)


def stop_group(process: subprocess.Popen[bytes], grace: float, first: signal.Signals = signal.SIGTERM) -> int:
    """Ask the leader to stop, wait ``grace`` seconds, then kill the whole group; return the exit code.

    Members that the leader left behind are killed as well, also when it exited by itself.
    """
    if process.poll() is None:
        with contextlib.suppress(ProcessLookupError):
            process.send_signal(first)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(grace)
    signal_group(process, signal.SIGKILL)
    return process.wait()
