"""A real server on a free loopback port, with a fake renderer and no broker."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import httpx
import pytest
import uvicorn
from fastapi import FastAPI

from service.app import create_app
from service.services import Services
from service.settings import Settings
from tests.service.fakes import load

#: The first bytes of an MP4 file, then anything.
VIDEO = b"\x00\x00\x00\x18ftypmp42\x00\x00\x00\x00mp42isom" + bytes(range(256)) * 40

ASSETS = {
    "avatar.safetensors": b"an avatar",
    "report.json": b'{"psnr": 30.0}',
    "surfels.ply": bytes(range(256)) * 1200,
    "previews/rest.png": b"\x89PNG",
}


@dataclass
class Live:
    """A running service: over HTTP, and from inside."""

    http: httpx.Client
    services: Services
    host: str
    port: int
    app: FastAPI

    def files(self) -> list[str]:
        """Every file under the uploads and jobs directories."""
        root = self.services.storage.root
        folders = (root / "uploads", root / "jobs")
        return sorted(
            str(p.relative_to(root)) for folder in folders for p in folder.rglob("*") if p.is_file()
        )

    def submit(self, video: bytes = VIDEO) -> str:
        """The id of a new queued job."""
        answer = self.http.post("/jobs", files={"video": ("clip.mp4", video)})
        assert answer.status_code == 202, answer.text
        return str(answer.json()["id"])

    def finished(self, **assets: bytes) -> tuple[str, Path]:
        """The id of a job a worker has finished, and its result directory."""
        job_id = self.submit()
        claim = self.services.store.claim(job_id)
        assert claim is not None
        folder = self.services.storage.attempt_dir(job_id, claim.artifact)
        for name, content in {**ASSETS, **assets}.items():
            (folder / name).parent.mkdir(exist_ok=True)
            (folder / name).write_bytes(content)
        self.services.storage.publish(job_id, claim.artifact)
        assert self.services.store.succeed(job_id, claim.token, claim.artifact)
        return job_id, folder


@contextmanager
def serve(settings: Settings) -> Iterator[Live]:
    """Run the app under uvicorn in a thread until the block ends."""
    app = create_app(settings, loader=load)
    # The protocol is named because asyncio turns Nagle's delay off only where it is.
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    listener.bind(("127.0.0.1", 0))
    listener.listen()
    port = listener.getsockname()[1]
    config = uvicorn.Config(app, log_level="warning", lifespan="on", timeout_graceful_shutdown=2)
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
    thread.start()
    try:
        # The socket listens already: the first request waits there until the app has started.
        with httpx.Client(base_url=f"http://127.0.0.1:{port}", timeout=30.0) as http:
            assert http.get("/healthz").json() == {"status": "ok"}, "it has started"
            yield Live(http, app.state.services, "127.0.0.1", port, app)
    finally:
        server.should_exit = True
        thread.join(20.0)
        assert not thread.is_alive()


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Live]:
    settings = Settings(
        data_dir=tmp_path_factory.mktemp("data"),
        max_upload_bytes=1_000_000,
        min_free_bytes=0,
        max_open_uploads=0,
        render_queue=1,
        render_timeout=3.0,
        render_load_timeout=20.0,
        render_warm_avatars=2,
        max_render_pixels=600 * 600,
    )
    with serve(settings) as running:
        yield running


def problem(answer: httpx.Response, status: int, code: str) -> dict[str, object]:
    """Assert that the answer is this problem, whole; returns its body."""
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    assert answer.headers["x-content-type-options"] == "nosniff"
    body: dict[str, object] = answer.json()
    assert body["code"] == code
    assert body["status"] == status
    assert body["title"]
    assert body["detail"]
    assert body["advice"]
    return body
