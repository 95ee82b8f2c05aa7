"""The last step before the engine: give up every right it does not need, then become it.

Run by path as a script: ``python -I -S confine.py SPEC PROGRAM [ARGUMENT...]`` with SPEC the JSON of
:class:`Spec`. Only the standard library is used. Each measure is taken where the system allows it; that one
could not be taken is no error here: what holds is proved from inside by worker/sandbox_probe.py.

Sources: landlock(7), seccomp(2), user_namespaces(7), capabilities(7), and the kernel's uapi headers.
"""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import platform
import resource
import struct
import sys
from typing import TypedDict

_PR_SET_PDEATHSIG, _PR_SET_DUMPABLE, _PR_SET_SECCOMP = 1, 4, 22
_PR_CAPBSET_DROP, _PR_SET_NO_NEW_PRIVS = 24, 38
_SECCOMP_MODE_FILTER = 2
_CLONE_NEWUTS, _CLONE_NEWIPC, _CLONE_NEWUSER, _CLONE_NEWNET = 0x04000000, 0x08000000, 0x10000000, 0x40000000
#: Every kind of namespace but threads: what clone may not ask for.
_CLONE_NAMESPACES = 0x7E020000
_NOBODY = 65534

_EPERM, _ENOSYS = 1, 38
_ALLOW, _ERRNO, _KILL = 0x7FFF0000, 0x00050000, 0x80000000

#: Architecture -> (audit name, number of clone, numbers refused, numbers that do not exist).
#: Refused: sockets, other processes' memory, mounts and namespaces, keys, kernel modules and tracing.
#: Not there: io_uring, which makes sockets without the calls above, and clone3, whose flags lie in memory
#: that a filter cannot read (the C library then uses clone).
_SYSCALLS: dict[str, tuple[int, int, tuple[int, ...], tuple[int, ...]]] = {
    "x86_64": (
        0xC000003E,
        56,
        (
            *(41, 42, 43, 49, 50, 288),
            *(101, 310, 311, 438, 155, 161, 165, 166, 272, 308, 428, 429, 430),
            *(248, 249, 250, 169, 175, 176, 246, 298, 313, 320, 321, 323),
        ),
        (425, 435),
    ),
    "aarch64": (
        0xC00000B7,
        220,
        (
            *(198, 203, 202, 200, 201, 242),
            *(117, 270, 271, 438, 41, 51, 40, 39, 97, 268, 428, 429, 430),
            *(217, 218, 219, 142, 105, 106, 104, 241, 273, 294, 280, 282),
        ),
        (425, 435),
    ),
}

#: Landlock's rights: read (execute, read a file, read a folder), all of version 1, and what later ones added.
_LL_READ = 1 << 0 | 1 << 2 | 1 << 3
_LL_READ_FILE, _LL_WRITE_FILE = 1 << 2, 1 << 1
_LL_ALL = {1: (1 << 13) - 1, 2: (1 << 14) - 1, 3: (1 << 15) - 1, 4: (1 << 15) - 1, 5: (1 << 16) - 1}
#: A work directory gets neither devices nor sockets nor programs to run.
_LL_WORK = ((1 << 16) - 1) & ~(1 << 0 | 1 << 6 | 1 << 9 | 1 << 11)
#: Rights that a rule on a plain file may name.
_LL_FILE = 1 << 0 | 1 << 1 | 1 << 2 | 1 << 14 | 1 << 15
_LL_TCP = 3  # bind and connect
_LL_SCOPE = 3  # abstract unix sockets and signals
_LL_CREATE, _LL_ADD, _LL_RESTRICT = 444, 445, 446
_LL_PATH_BENEATH = 1


class Spec(TypedDict):
    """``parent`` must be alive; ``user``: uid and gid to become, if any; ``limits`` by name; folders (or
    files) that may be read, used as devices, and written; whether the network is needed."""

    parent: int
    user: list[int] | None
    limits: dict[str, int]
    read: list[str]
    device: list[str]
    write: list[str]


def confine(spec: Spec) -> None:
    """Take every measure that can be taken."""
    libc = ctypes.CDLL(None, use_errno=True)
    if spec["user"] is not None:
        uid, gid = spec["user"]
        os.setgroups([])
        os.setresgid(gid, gid, gid)
        os.setresuid(uid, uid, uid)
    _own_namespaces(libc)
    _drop_capabilities(libc)
    _set_limits(spec["limits"])
    libc.prctl(_PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0)
    _restrict_files(libc, spec)
    _filter_calls(libc)
    # A change of user cleared what the launcher asked for; the parent may have died since.
    libc.prctl(_PR_SET_PDEATHSIG, 9, 0, 0, 0)
    if os.getppid() != spec["parent"]:
        os._exit(1)


def _own_namespaces(libc: ctypes.CDLL) -> None:
    """A network of its own, with not even a loopback; refused inside most containers."""
    uid, gid = os.getuid(), os.getgid()
    libc.prctl(_PR_SET_DUMPABLE, 1, 0, 0, 0)  # else the maps below belong to root
    if libc.unshare(_CLONE_NEWUSER | _CLONE_NEWNET | _CLONE_NEWIPC | _CLONE_NEWUTS) != 0:
        libc.unshare(_CLONE_NEWNET)  # root needs no namespace of users for it, if it may
        return
    # Under a name that is not root's: a root inside would get its capabilities back with exec.
    with contextlib.suppress(OSError):
        _write("/proc/self/setgroups", "deny")
        _write("/proc/self/uid_map", f"{uid or _NOBODY} {uid} 1")
        _write("/proc/self/gid_map", f"{gid or _NOBODY} {gid} 1")


def _drop_capabilities(libc: ctypes.CDLL) -> None:
    for capability in range(64):
        if libc.prctl(_PR_CAPBSET_DROP, capability, 0, 0, 0) != 0:
            break
    header = struct.pack("=Ii", 0x20080522, 0)
    libc.capset(header, struct.pack("=6I", *(6 * [0])))


def _set_limits(limits: dict[str, int]) -> None:
    for name, value in limits.items():
        kind = getattr(resource, f"RLIMIT_{name.upper()}")
        hard = resource.getrlimit(kind)[1]
        bound = value if hard == resource.RLIM_INFINITY else min(value, hard)
        resource.setrlimit(kind, (bound, bound))


def _restrict_files(libc: ctypes.CDLL, spec: Spec) -> None:
    version = libc.syscall(_LL_CREATE, None, ctypes.c_size_t(0), 1)
    if version < 1:
        return
    handled = _LL_ALL[min(version, 5)]
    attributes = struct.pack(
        "=QQQ", handled, _LL_TCP if version >= 4 else 0, _LL_SCOPE if version >= 6 else 0
    )
    size = 24 if version >= 6 else 16 if version >= 4 else 8
    ruleset = libc.syscall(_LL_CREATE, attributes, ctypes.c_size_t(size), 0)
    if ruleset < 0:
        return
    rules = (
        (spec["read"], _LL_READ),
        (spec["device"], _LL_READ | _LL_WRITE_FILE | 1 << 15),
        (spec["write"], _LL_WORK),
    )
    for paths, rights in rules:
        for path in paths:
            _allow(libc, ruleset, path, rights & handled)
    libc.syscall(_LL_RESTRICT, ruleset, 0)
    os.close(ruleset)


def _allow(libc: ctypes.CDLL, ruleset: int, path: str, rights: int) -> None:
    try:
        descriptor = os.open(path, os.O_PATH | os.O_CLOEXEC)
    except OSError:
        return  # not on this system, or not for this user
    if not os.path.isdir(path):
        rights &= _LL_FILE
    rule = struct.pack("=Qi", rights, descriptor)
    libc.syscall(_LL_ADD, ruleset, _LL_PATH_BENEATH, rule, 0)
    os.close(descriptor)


def _filter_calls(libc: ctypes.CDLL) -> None:
    known = _SYSCALLS.get(platform.machine())
    if known is None:
        return
    program = _program(*known)
    instructions = ctypes.create_string_buffer(program, len(program))
    header = struct.pack("HxxxxxxP", len(program) // 8, ctypes.addressof(instructions))
    libc.prctl(_PR_SET_SECCOMP, _SECCOMP_MODE_FILTER, header, 0, 0)


def _program(arch: int, clone: int, refused: tuple[int, ...], missing: tuple[int, ...]) -> bytes:
    """The filter as classic BPF; the data it sees is {nr, arch, ip, args}."""
    load, equal, at_least, any_bit, give = 0x20, 0x15, 0x35, 0x45, 0x06

    def op(code: int, value: int, yes: int = 0, no: int = 0) -> bytes:
        return struct.pack("=HBBI", code, yes, no, value)

    code = [
        op(load, 4),
        op(equal, arch, 1, 0),
        op(give, _KILL),  # a call of another architecture has other numbers
        op(load, 0),
        op(at_least, 0x40000000, 0, 1),  # x32
        op(give, _ERRNO | _ENOSYS),
    ]
    for number in refused:
        code += [op(equal, number, 0, 1), op(give, _ERRNO | _EPERM)]
    for number in missing:
        code += [op(equal, number, 0, 1), op(give, _ERRNO | _ENOSYS)]
    code += [
        op(equal, clone, 0, 3),
        op(load, 16),  # the low half of the first argument
        op(any_bit, _CLONE_NAMESPACES, 0, 1),
        op(give, _ERRNO | _EPERM),
        op(give, _ALLOW),
    ]
    return b"".join(code)


def _write(path: str, text: str) -> None:
    with open(path, "w") as file:
        file.write(text)


def main() -> None:
    """Confine this process as ``argv[1]`` says, then exec ``argv[2:]``; exit 127 when there is none."""
    spec: Spec = json.loads(sys.argv[1])
    program = sys.argv[2:]
    if sys.platform == "linux":
        confine(spec)
    else:
        _set_limits(spec["limits"])
    try:
        os.execvp(program[0], program)
    except OSError as error:
        print(f"cannot start {program[0]}: {error.strerror}", file=sys.stderr)
        raise SystemExit(127) from None


if __name__ == "__main__":
    main()
