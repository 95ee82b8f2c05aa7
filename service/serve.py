"""``mass serve``: broker (unless there is one), API and workers of one machine, under one supervisor.

Each is a child process that is started again when it dies. The listening socket belongs to the supervisor, so
requests wait, rather than fail, while the API is restarted.
"""

from __future__ import annotations

import errno
import logging
import os
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from types import FrameType, TracebackType
from typing import Self

import httpx

from service.access.gate import asks_for_keys
from service.embedded import DataDirLock, EmbeddedBroker
from service.processes import Backoff, launch, stop_group
from service.pulse import is_fresh, pulse_path
from service.settings import Settings

log = logging.getLogger(__name__)

#: Importing everything on a busy small machine takes a while; a child that dies ends the wait at once.
_START_SECONDS = 120.0
#: A worker gives its job back within this time, an API finishes its answers.
_STOP_SECONDS = 30.0
_LOOK_SECONDS = 1.0


class ServeError(Exception):
    """The service cannot be started. ``advice`` says what to do about it."""

    def __init__(self, message: str, advice: str) -> None:
        super().__init__(message)
        self.message = message
        self.advice = advice


def listen(host: str, port: int) -> socket.socket:
    """The listening socket; port 0 takes a free one. Raises ServeError when the address cannot be had."""
    try:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        return socket.create_server((host, port), family=family, backlog=512)
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            raise ServeError(
                f"Port {port} on {host} is in use.", "Stop what uses it, or choose another with --port."
            ) from None
        raise ServeError(
            f"Cannot listen on {host} port {port}: {error.strerror or error}.",
            "Choose another address with --host and --port.",
        ) from None


class Part:
    """A child that has to run: started, watched, started again with growing pauses."""

    def __init__(
        self,
        name: str,
        command: Sequence[str],
        environment: Mapping[str, str],
        is_ready: Callable[[int], bool],
        pass_fds: Sequence[int] = (),
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.name = name
        self._command, self._environment, self._pass_fds = command, environment, pass_fds
        self._is_ready, self._clock = is_ready, clock
        self._backoff = Backoff()
        self._restart_at: float | None = None
        self._started_at = 0.0
        self.process = self._start()

    def ready(self) -> bool:
        """Whether it does its work. Raises ServeError when it has died."""
        code = self.process.poll()
        if code is not None:
            raise ServeError(
                f"The {self.name} ended with code {code} while starting.", "See its output above."
            )
        return self._is_ready(self.process.pid)

    def check(self) -> None:
        """Start it again when it has died."""
        if self.process.poll() is None:
            return
        now = self._clock()
        if self._restart_at is None:
            stop_group(self.process, 0.0)  # what it left behind
            self._restart_at = now + self._backoff.next(now - self._started_at)
            log.warning("the %s ended with code %s; starting it again", self.name, self.process.returncode)
        if now >= self._restart_at:
            self.process = self._start()

    def _start(self) -> subprocess.Popen[bytes]:
        self._started_at, self._restart_at = self._clock(), None
        return launch(
            self._command, env=self._environment, death_signal=signal.SIGTERM, pass_fds=self._pass_fds
        )


class Signals:
    """Turns signals into something to wait for. Main thread only."""

    STOP = frozenset({signal.SIGINT, signal.SIGTERM, signal.SIGHUP})

    def __enter__(self) -> Self:
        self._reader, self._writer = socket.socketpair()
        self._reader.setblocking(False)
        self._writer.setblocking(False)
        watched = {*self.STOP, signal.SIGCHLD}
        self._previous = {number: signal.signal(number, _ignore) for number in watched}
        self._wakeup = signal.set_wakeup_fd(self._writer.fileno(), warn_on_full_buffer=False)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        signal.set_wakeup_fd(self._wakeup)
        for number, handler in self._previous.items():
            signal.signal(number, handler)
        self._reader.close()
        self._writer.close()

    def wait(self, seconds: float) -> bool:
        """Wait for a child to end or a signal to stop, ``seconds`` at most; whether it was one to stop."""
        readable, _, _ = select.select([self._reader], [], [], seconds)
        return bool(readable) and any(number in self.STOP for number in self._reader.recv(4096))


def _ignore(_number: int, _frame: FrameType | None) -> None:
    """A handler must exist for the wake-up to be written; the byte says it all."""


def serve(settings: Settings, workers: int = 1) -> int:
    """Run until SIGINT, SIGTERM or SIGHUP; returns the exit code. Raises ServeError and BrokerError."""
    with ExitStack() as stack:
        signals = stack.enter_context(Signals())
        stack.callback(DataDirLock(settings.data_dir).release)
        listener = stack.enter_context(listen(settings.host, settings.port))
        port: int = listener.getsockname()[1]
        broker = None
        if settings.redis_url is None:
            broker = stack.enter_context(EmbeddedBroker(settings.data_dir))
        environment = _environment(settings, port, broker)
        parts: list[Part] = []
        stack.callback(_stop, parts, signals)
        parts.append(_api(settings, port, listener.fileno(), environment))
        parts.extend(_worker(settings, number, environment) for number in range(1, workers + 1))
        deadline = time.monotonic() + _START_SECONDS
        while not all(part.ready() for part in parts):
            if signals.wait(0.05):
                return 0
            if time.monotonic() > deadline:
                raise ServeError(
                    f"The service was not ready within {_START_SECONDS:g} s.", "See its output above."
                )
        if asks_for_keys(settings.auth, settings.host):
            log.info("keys are asked for; `mass keys create OWNER` makes one")
        elif asks_for_keys("auto", settings.host):
            log.warning("anyone who can reach %s may use this service: MASS_AUTH is open", settings.host)
        print(
            f"MASS is ready on {_url(settings.host, port)} (data in {settings.data_dir}; Ctrl-C stops it)",
            flush=True,
        )
        while not signals.wait(_LOOK_SECONDS):
            if broker is not None:
                broker.check()
            for part in parts:
                part.check()
    return 0


def _environment(settings: Settings, port: int, broker: EmbeddedBroker | None) -> dict[str, str]:
    """Ours, with what the command line and the broker decided."""
    decided = {"DATA_DIR": settings.data_dir, "HOST": settings.host, "PORT": port}
    if broker is not None:
        decided["REDIS_URL"] = broker.url
    return {**os.environ, **{f"MASS_{name}": str(value) for name, value in decided.items()}}


def _api(settings: Settings, port: int, descriptor: int, environment: Mapping[str, str]) -> Part:
    address = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(settings.host, settings.host)
    health = f"{_url(address, port)}/healthz"

    def ready(_pid: int) -> bool:
        try:
            return httpx.get(health, timeout=2.0, trust_env=False).status_code == 200
        except httpx.HTTPError:
            return False

    command = [sys.executable, "-m", "service.cli", "api", "--fd", str(descriptor)]
    return Part("API", command, environment, ready, pass_fds=(descriptor,))


def _worker(settings: Settings, number: int, environment: Mapping[str, str]) -> Part:
    def ready(pid: int) -> bool:
        return is_fresh(pulse_path(settings.data_dir, pid))

    return Part(f"worker {number}", [sys.executable, "-m", "worker"], environment, ready)


def _stop(parts: Sequence[Part], signals: Signals) -> None:
    """Ask all at once, wait for all; a second signal from the user ends the wait."""
    for part in parts:
        if part.process.poll() is None:
            part.process.terminate()
    deadline = time.monotonic() + _STOP_SECONDS
    while any(part.process.poll() is None for part in parts) and time.monotonic() < deadline:
        if signals.wait(0.2):
            break
    for part in parts:
        stop_group(part.process, 0.0)


def _url(host: str, port: int) -> str:
    return f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"
