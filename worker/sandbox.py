"""What the engine may do, and the proof of it.

The engine decodes files that strangers made, so it runs with as little as possible: a session and process
group of its own, resource limits, an allow-list for its environment, no network, no files but the system's
libraries, its program, its video (all read only) and its run directory, no capabilities, and another user
where the worker may change users. Not every system has every measure: :func:`self_test` tries them all from
inside, and the worker says at its start what could not be had.
"""

from __future__ import annotations

import json
import logging
import os
import pwd
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import platformdirs

from service.processes import launch, stop_group
from service.settings import Settings
from worker import confine, sandbox_probe

log = logging.getLogger(__name__)

#: All that the engine sees of our environment; passwords and URLs of the service are not in it.
_ENVIRONMENT = frozenset(
    {
        *("PATH", "LANG", "LC_ALL", "LC_CTYPE", "TZ", "OMP_NUM_THREADS"),
        *("LD_LIBRARY_PATH", "DYLD_LIBRARY_PATH", "SYSTEMROOT"),
        *("CUDA_VISIBLE_DEVICES", "NVIDIA_VISIBLE_DEVICES", "NVIDIA_DRIVER_CAPABILITIES"),
    }
)

#: Of the system, the engine reads libraries and what the machine is; /etc/passwd and the like are not there.
_SYSTEM = (
    *("/usr", "/lib", "/lib32", "/lib64", "/bin", "/etc/ld.so.cache", "/etc/localtime"),
    *("/proc/self", "/proc/cpuinfo", "/proc/meminfo", "/proc/stat", "/proc/filesystems", "/proc/devices"),
    *("/proc/sys/vm", "/proc/driver", "/sys"),
)
_DEVICES = ("/dev/null", "/dev/zero", "/dev/full", "/dev/random", "/dev/urandom", "/dev/dri")
#: The engine's temporary files, inside its run directory.
SCRATCH = "tmp"
_PROBE_SECONDS = 60.0


@dataclass(frozen=True)
class Account:
    """A user to become."""

    name: str
    uid: int
    gid: int


class Sandbox:
    """Wraps the engine's command line for one machine's settings."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self.models = Path(
            os.environ.get("MASS_MODEL_DIR")
            or Path(platformdirs.user_cache_dir("mass", appauthor=False)) / "models"
        )
        self._read = [str(path) for path in (*map(Path, _SYSTEM), *self._program(), self.models)]
        self.account, self.account_note = self._choose_account()

    def environment(self, run: Path, source: Mapping[str, str] | None = None) -> dict[str, str]:
        """The environment of the engine: the harmless part of ours, and what makes its output prompt."""
        ours = os.environ if source is None else source
        kept = {name: value for name, value in ours.items() if name in _ENVIRONMENT}
        scratch = str(run / SCRATCH)
        return {
            **kept,
            "HOME": scratch,
            "TMPDIR": scratch,
            "USER": "mass",
            "MASS_MODEL_DIR": str(self.models),
            "PYTHONUNBUFFERED": "1",
            "PYTHONFAULTHANDLER": "1",
        }

    def open(self, run: Path, video: Path) -> None:
        """Prepare ``run`` for writing and ``video`` for reading by the engine's user."""
        (run / SCRATCH).mkdir(mode=0o700, exist_ok=True)
        if self.account is not None:
            for path in (run, *run.rglob("*")):
                os.chown(path, self.account.uid, self.account.gid, follow_symlinks=False)
            os.chown(video, -1, self.account.gid)
            video.chmod(0o640)
            for folder in (run.parent, video.parent):
                folder.chmod(0o751)

    def close(self, run: Path) -> None:
        """Remove the temporary files."""
        shutil.rmtree(run / SCRATCH, ignore_errors=True)

    def command(self, command: Sequence[str], run: Path, video: Path) -> list[str]:
        """``command``, confined to reading ``video`` and writing ``run``. Start it with ``launch``."""
        spec = confine.Spec(
            parent=os.getpid(),
            user=None if self.account is None else [self.account.uid, self.account.gid],
            limits=self.limits(),
            read=[*self._read, str(video)],
            device=[*_DEVICES, *map(str, Path("/dev").glob("nvidia*"))],
            write=[str(run), *map(str, self._settings.engine_paths)],
        )
        return [sys.executable, "-I", "-S", confine.__file__, json.dumps(spec), *command]

    def limits(self) -> dict[str, int]:
        """Resource limits by name; seconds of processor time are those of all processors."""
        uid = os.getuid() if self.account is None else self.account.uid
        cores = os.cpu_count() or 1
        limits = {
            "core": 0,
            "cpu": int(self._settings.job_timeout * cores) + 60,
            "fsize": self._settings.engine_file_bytes,
            "nofile": 1024,
            # It counts all threads of a user, so those that run already come on top.
            "nproc": _threads_of(uid) + 256 + 16 * cores,
        }
        if self._settings.engine_memory_bytes:
            limits["as"] = self._settings.engine_memory_bytes
        return limits

    def _program(self) -> list[Path]:
        """Where the interpreter and the engine lie, and every file that its command line names."""
        found = [Path(sys.prefix), Path(sys.base_prefix), Path(sys.executable).resolve().parent]
        engine = find_spec("mass_engine")
        found += [Path(place) for place in (engine.submodule_search_locations or ())] if engine else []
        return found + [Path(word) for word in self._settings.engine if os.path.isabs(word)]

    def _choose_account(self) -> tuple[Account | None, str]:
        if os.geteuid() != 0:
            return None, f"the worker's own user (uid {os.geteuid()}), which is not root"
        try:
            entry = pwd.getpwnam(self._settings.engine_user)
        except KeyError:
            return None, f"root without capabilities: there is no user {self._settings.engine_user!r}"
        data = self._settings.data_dir
        for place in (*self._program(), self.models, data / "jobs", data / "uploads"):
            closed = next((p for p in (place, *place.parents) if p.is_dir() and not _is_open(p)), None)
            if closed is not None:
                return None, f"root without capabilities: {closed} is closed to other users"
        return Account(entry.pw_name, entry.pw_uid, entry.pw_gid), f"{entry.pw_name} (uid {entry.pw_uid})"


def _is_open(folder: Path) -> bool:
    """Whether any user may pass through."""
    return bool(folder.stat().st_mode & 0o001)


def _threads_of(uid: int) -> int:
    count = 0
    for status in Path("/proc").glob("[0-9]*/status"):
        with suppress(OSError, ValueError, KeyError):
            fields = dict(line.split(":", 1) for line in status.read_text().splitlines() if ":" in line)
            if int(fields["Uid"].split()[0]) == uid:
                count += int(fields["Threads"])
    return count


@dataclass(frozen=True)
class Report:
    """What the self-test found: per measure an empty text when it holds, else why it does not."""

    faults: dict[str, str]
    user: str

    #: Without these a hostile video that takes over the decoder could do harm beyond its own job.
    ESSENTIAL = ("network", "files", "environment", "capabilities", "other processes")

    @property
    def held(self) -> list[str]:
        """The measures that hold."""
        return [name for name, fault in self.faults.items() if not fault]

    @property
    def missing(self) -> dict[str, str]:
        """Those that do not, and why."""
        return {name: fault for name, fault in self.faults.items() if fault}

    @property
    def is_sound(self) -> bool:
        """Whether every essential measure holds."""
        return all(self.faults.get(name, "not tested") == "" for name in self.ESSENTIAL)


def self_test(settings: Settings) -> Report:
    """Run a program in the sandbox that tries to get out by every way there is.

    It is given an address, a socket, a secret file and our process id to try; whatever it reaches counts,
    and so does what we see of it. Raises OSError when the data directory cannot be written.
    """
    with tempfile.TemporaryDirectory(prefix="mass-probe-", dir="/tmp") as outside:
        jobs = settings.data_dir / "jobs"
        jobs.mkdir(parents=True, exist_ok=True)
        run = Path(tempfile.mkdtemp(prefix=".probe-", dir=jobs))
        try:
            return _probe(Sandbox(settings), run, Path(outside))
        finally:
            shutil.rmtree(run, ignore_errors=True)


def _probe(sandbox: Sandbox, run: Path, outside: Path) -> Report:
    inside = run / "run"
    inside.mkdir()
    video = run / "video" / "source"
    video.parent.mkdir()
    video.write_bytes(b"video")
    secret = run / "secret"
    secret.write_text("canary")
    run.chmod(0o711)  # so that nothing but the sandbox keeps the probe from it
    secret.chmod(0o644)
    outside.chmod(0o777)
    with (
        closing(socket.create_server(("127.0.0.1", 0))) as tcp,
        closing(socket.socket(socket.AF_UNIX)) as local,
    ):
        local.bind(str(outside / "socket"))
        os.chmod(outside / "socket", 0o777)
        local.listen()
        target = sandbox_probe.Target(
            port=tcp.getsockname()[1],
            socket=str(outside / "socket"),
            secret=str(secret),
            outside=str(outside / "written"),
            inside=str(inside / "written"),
            video=str(video),
            parent=os.getpid(),
        )
        command = [sys.executable, "-I", "-S", sandbox_probe.__file__, json.dumps(target)]
        faults = _run(sandbox, command, inside, video)
        for listener, name in ((tcp, "TCP"), (local, "unix socket")):
            listener.setblocking(False)
            with suppress(BlockingIOError):
                listener.accept()
                faults["network"] = f"a {name} connection arrived"
    return Report(faults, sandbox.account_note)


def _run(sandbox: Sandbox, command: Sequence[str], run: Path, video: Path) -> dict[str, str]:
    sandbox.open(run, video)
    environment = {**sandbox.environment(run), "PATH": os.environ.get("PATH", os.defpath)}
    process = launch(
        # The probe's own file must be readable; the engine's sandbox has no business with it.
        sandbox_with(sandbox.command(command, run, video), sandbox_probe.__file__),
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        death_signal=signal.SIGKILL,
    )
    try:
        output, errors = process.communicate(timeout=_PROBE_SECONDS)
    except subprocess.TimeoutExpired:
        return {"self-test": "it did not end"}
    finally:
        stop_group(process, 0.0)
    try:
        answer: dict[str, str] = json.loads(output)
    except ValueError:
        words = errors.decode(errors="replace").strip().splitlines()
        return {"self-test": f"it ended with {process.returncode}: {words[-1] if words else 'no word'}"}
    return answer


def sandbox_with(command: list[str], path: str) -> list[str]:
    """The wrapped ``command`` with one more file that may be read."""
    spec = json.loads(command[4])
    spec["read"].append(path)
    return [*command[:4], json.dumps(spec), *command[5:]]


def announce(report: Report) -> None:
    """Say in the log what holds and what could not be had."""
    log.info("sandbox: %s; the engine runs as %s", ", ".join(report.held) or "nothing holds", report.user)
    for name, fault in report.missing.items():
        log.warning("sandbox: %s could not be had: %s", name, fault)
