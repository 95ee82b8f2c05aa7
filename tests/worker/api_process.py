"""A real API process over a bench's data, to be killed."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx

from service.processes import launch, stop_group
from tests.worker.harness import DEADLINE, REPOSITORY, Bench, wait_for

#: The first bytes of an MP4 file, which is all the API looks at.
MP4 = b"\x00\x00\x00\x18ftypmp42\x00\x00\x00\x00mp42isom"


class Api:
    """``mass api`` on a free port of this test's own socket."""

    def __init__(self, bench: Bench) -> None:
        self._bench = bench
        self._log = bench.root / "api.log"
        listener = socket.create_server(("127.0.0.1", 0))
        self.url = f"http://127.0.0.1:{listener.getsockname()[1]}"
        with listener, self._log.open("ab") as output:
            self.process = launch(
                [sys.executable, "-m", "service.cli", "api", "--fd", str(listener.fileno())],
                cwd=REPOSITORY,
                env=bench.environment(),
                stdout=output,
                stderr=subprocess.STDOUT,
                pass_fds=(listener.fileno(),),
            )
        self.http = httpx.Client(base_url=self.url, timeout=2 * DEADLINE, trust_env=False)
        wait_for("the API answers", self._answers, 2 * DEADLINE)

    def _answers(self) -> bool:
        assert self.process.poll() is None, self._log.read_text(errors="replace")
        try:
            return self.http.get("/healthz").status_code == 200
        except httpx.TransportError:
            return False

    def video(self, name: str, mode: str = "succeed", **more: Any) -> bytes:
        """A video whose engines write their notes to ``name`` (see :meth:`words`)."""
        plan = {"mode": mode, "log": str(self._note(name)), **more}
        return MP4 + b"PLAN:" + json.dumps(plan).encode()

    def submit(self, name: str, mode: str = "succeed") -> httpx.Response:
        return self.http.post("/jobs", files={"video": ("clip.mp4", self.video(name, mode))})

    def starts(self, name: str) -> int:
        """How many engines were started for that video."""
        note = self._note(name)
        return note.read_text().count("start ") if note.exists() else 0

    def _note(self, name: str) -> Path:
        return self._bench.notebook / f"{name}.log"

    def kill(self) -> None:
        self.process.kill()
        self.process.wait(DEADLINE)

    def close(self) -> None:
        self.http.close()
        stop_group(self.process, 0.0)


@contextmanager
def api(bench: Bench) -> Iterator[Api]:
    """Start it, and end it however the block ends."""
    running = Api(bench)
    try:
        yield running
    finally:
        running.close()
