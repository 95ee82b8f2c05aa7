"""The first instruction of every child process: tie it to its parent, bound it, then become the program.

Run by path as a script: ``python -I -S launcher.py SPEC PROGRAM [ARGUMENT...]`` with SPEC the JSON of
:class:`Spec`. A ``preexec_fn`` would do the same between fork and exec, but it runs Python code in the copy
of a process with threads, which can deadlock; a fresh interpreter cannot. Only the standard library is used.
"""

from __future__ import annotations

import ctypes
import json
import os
import resource
import sys
from typing import TypedDict

_PR_SET_PDEATHSIG = 1
_PR_SET_NO_NEW_PRIVS = 38


class Spec(TypedDict):
    """``parent``: pid that must be alive; ``death_signal``: sent when it dies; ``limits``: by name."""

    parent: int
    death_signal: int
    limits: dict[str, int]


def bind_to_parent(parent: int, death_signal: int) -> None:
    """Ask the kernel for ``death_signal`` when the parent *thread* ends (Linux); elsewhere do nothing.

    Survives exec. Exits at once when the parent died before the request could be made.
    """
    if sys.platform != "linux":
        return
    libc = ctypes.CDLL(None, use_errno=True)
    libc.prctl(_PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0)
    if libc.prctl(_PR_SET_PDEATHSIG, death_signal, 0, 0, 0) != 0:
        raise OSError(ctypes.get_errno(), "prctl(PR_SET_PDEATHSIG) failed")
    if os.getppid() != parent:
        os._exit(1)


def apply_limits(limits: dict[str, int]) -> None:
    """Set resource limits by name (``core``, ``fsize``, ``nofile``, ``as``), never above the hard limit."""
    for name, value in limits.items():
        kind = getattr(resource, f"RLIMIT_{name.upper()}")
        hard = resource.getrlimit(kind)[1]
        bound = value if hard == resource.RLIM_INFINITY else min(value, hard)
        resource.setrlimit(kind, (bound, bound))


def main() -> None:
    """Apply the spec in ``argv[1]``, then exec ``argv[2:]``; exit 127 when there is no such program."""
    spec: Spec = json.loads(sys.argv[1])
    program = sys.argv[2:]
    bind_to_parent(spec["parent"], spec["death_signal"])
    apply_limits(spec["limits"])
    try:
        os.execvp(program[0], program)
    except OSError as error:
        print(f"cannot start {program[0]}: {error.strerror}", file=sys.stderr)
        raise SystemExit(127) from None


if __name__ == "__main__":
    main()
