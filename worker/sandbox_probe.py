"""Runs inside the sandbox and tries to get out; prints one JSON object, measure -> fault (empty: it holds).

Run by path as a script with a :class:`Target` as JSON. Only the standard library is used.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import json
import mmap
import os
import resource
import socket
import sys
from collections.abc import Callable
from typing import TypedDict


class Target(TypedDict):
    """What to try: a listening port and unix socket, a secret to read, files to write, a process."""

    port: int
    socket: str
    secret: str
    outside: str
    inside: str
    video: str
    parent: int


def _network(target: Target) -> str:
    for family, kind, address in (
        (socket.AF_INET, socket.SOCK_STREAM, ("127.0.0.1", target["port"])),
        (socket.AF_UNIX, socket.SOCK_STREAM, target["socket"]),
        (socket.AF_INET, socket.SOCK_DGRAM, ("127.0.0.1", 53)),
        (socket.AF_INET, socket.SOCK_DGRAM, ("192.0.2.1", 53)),
    ):
        with contextlib.suppress(OSError), socket.socket(family, kind) as attempt:
            attempt.settimeout(2.0)
            attempt.connect(address)
            return f"{family.name} {kind.name} reached {address}"
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.syscall(425, 8, ctypes.create_string_buffer(256)) >= 0:
        return "io_uring can be set up"
    return ""


def _files(target: Target) -> str:
    for path in (target["secret"], "/etc/passwd"):
        with contextlib.suppress(OSError), open(path) as file:
            file.read(1)
            return f"{path} can be read"
    for path in (target["outside"], target["video"], "/tmp/mass-probe"):
        with contextlib.suppress(OSError), open(path, "w"):
            os.unlink(path)
            return f"{path} can be written"
    with open(target["inside"], "w") as file:
        file.write("x")
    with open(target["video"], "rb") as video:
        video.read()
    return ""


def _environment(_: Target) -> str:
    known = {
        *("PATH", "HOME", "TMPDIR", "USER", "MASS_MODEL_DIR", "PYTHONUNBUFFERED", "PYTHONFAULTHANDLER"),
        *("LANG", "LC_ALL", "LC_CTYPE", "TZ", "OMP_NUM_THREADS", "LD_LIBRARY_PATH", "DYLD_LIBRARY_PATH"),
        *("SYSTEMROOT", "CUDA_VISIBLE_DEVICES", "NVIDIA_VISIBLE_DEVICES", "NVIDIA_DRIVER_CAPABILITIES"),
    }
    return ", ".join(sorted(set(os.environ) - known))


def _capabilities(_: Target) -> str:
    with open("/proc/self/status") as file:
        status = dict(line.split(":", 1) for line in file)
    if int(status["CapEff"], 16) or int(status["CapPrm"], 16):
        return f"capabilities {status['CapEff'].strip()}"
    if status["NoNewPrivs"].strip() != "1":
        return "new privileges can be had"
    try:
        os.setuid(0)
    except OSError:
        return ""
    return "" if os.getuid() != 0 or not int(status["CapEff"], 16) else "root can be had"


def _other_processes(target: Target) -> str:
    parent = target["parent"]
    for name in ("environ", "mem", "maps"):
        with contextlib.suppress(OSError), open(f"/proc/{parent}/{name}", "rb") as file:
            file.read(1)
            return f"/proc/{parent}/{name} can be read"
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.ptrace(16, parent, None, None) == 0:
        return "the worker can be traced"
    return ""


def _signals(target: Target) -> str:
    with contextlib.suppress(OSError):
        os.kill(target["parent"], 0)
        return "the worker can be signalled"
    return ""


def _memory(_: Target) -> str:
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if limit == resource.RLIM_INFINITY:
        return "no limit is set"
    try:
        mmap.mmap(-1, limit + mmap.PAGESIZE)
    except (OSError, OverflowError):
        return ""
    return "more than the limit can be mapped"


def _file_size(target: Target) -> str:
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)[0]
    if limit == resource.RLIM_INFINITY:
        return "no limit is set"
    with open(target["inside"], "wb") as file:
        try:
            os.ftruncate(file.fileno(), limit + 1)
        except OSError as error:
            return "" if error.errno == errno.EFBIG else os.strerror(error.errno or 0)
    return "a larger file can be made"


def _open_files(_: Target) -> str:
    limit = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    taken: list[int] = []
    try:
        while len(taken) < limit:
            taken += [os.open("/dev/null", os.O_RDONLY)]
    except OSError as error:
        return "" if error.errno == errno.EMFILE else os.strerror(error.errno or 0)
    finally:
        for descriptor in taken:
            os.close(descriptor)
    return f"more than {limit} files can be open"


def _processes(_: Target) -> str:
    hard = resource.getrlimit(resource.RLIMIT_NPROC)[1]
    if hard == resource.RLIM_INFINITY:
        return "no limit is set"
    # Whether the limit counts for this user is seen best at its lowest.
    resource.setrlimit(resource.RLIMIT_NPROC, (0, hard))
    try:
        child = os.fork()
    except OSError:
        return ""
    if child == 0:
        os._exit(0)
    os.waitpid(child, 0)
    return "the limit does not count for this user"


def _processor(_: Target) -> str:
    limit = resource.getrlimit(resource.RLIMIT_CPU)[0]
    return "no limit is set" if limit == resource.RLIM_INFINITY else ""


def _group(_: Target) -> str:
    own = os.getpid() == os.getpgrp() == os.getsid(0)
    return "" if own else "it shares a group with others"


def _user(_: Target) -> str:
    return "" if _owner_outside() != 0 else "it runs as root, without capabilities"


def _owner_outside() -> int:
    """The user id that the world outside sees."""
    uid = os.getuid()
    with contextlib.suppress(OSError), open("/proc/self/uid_map") as file:
        for line in file:
            first, outer, count = map(int, line.split())
            if first <= uid < first + count:
                return outer + uid - first
    return uid


MEASURES: dict[str, Callable[[Target], str]] = {
    "process group": _group,
    "network": _network,
    "files": _files,
    "environment": _environment,
    "capabilities": _capabilities,
    "other processes": _other_processes,
    "signals": _signals,
    "unprivileged user": _user,
    "memory limit": _memory,
    "file size limit": _file_size,
    "open files limit": _open_files,
    "processor limit": _processor,
    "processes limit": _processes,
}


def main() -> None:
    """Try everything in order and print what was found."""
    target: Target = json.loads(sys.argv[1])
    faults = {}
    for name, measure in MEASURES.items():
        try:
            faults[name] = measure(target)
        except OSError as error:
            faults[name] = f"the test failed: {error}"
    print(json.dumps(faults))


if __name__ == "__main__":
    main()
