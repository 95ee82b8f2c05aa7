"""Resumable uploads: what is left when the network, the disk or a writer fails, and when time is up."""

from __future__ import annotations

import errno
import socket
import threading
from pathlib import Path
from typing import Any

import pytest

from service.access.quotas import Quota
from service.jobs.housekeeping import sweep_uploads
from service.jobs.store import create_store
from service.settings import Settings
from service.storage import Storage
from service.tus import lifecycle
from service.tus.receive import Appender
from service.tus.rows import LOCK_SECONDS, Lock, TooManyUploadsError, UploadStore
from tests.service.conftest import VIDEO, Live, problem
from tests.service.tus import TUS, begin, checksum, name, offset, patch


class Raw:
    """A PATCH over a socket of one's own, to be cut where one likes."""

    def __init__(self, live: Live, path: str, start: int, length: int, extra: str = "") -> None:
        self.socket = socket.create_connection((live.host, live.port), timeout=30)
        self.socket.sendall(
            f"PATCH {path} HTTP/1.1\r\nHost: localhost\r\nTus-Resumable: 1.0.0\r\n{extra}"
            f"Content-Type: application/offset+octet-stream\r\nUpload-Offset: {start}\r\n"
            f"Content-Length: {length}\r\n\r\n".encode()
        )

    def cut(self, live: Live, path: str) -> None:
        """Hang up, and wait until the service has noticed."""
        self.socket.close()
        until(lambda: (found := live.services.uploads.get(name(path))) is not None and found.token is None)


def until(condition: Any) -> None:
    """Wait, generously, for something that happens in another thread."""
    event = threading.Event()
    for _ in range(3000):
        if condition():
            return
        event.wait(0.01)
    raise AssertionError("it did not happen")


@pytest.mark.parametrize("sent", [0, 1, 11, 12, 5000])
def test_a_broken_connection_keeps_what_arrived(live: Live, sent: int) -> None:
    path = begin(live)
    raw = Raw(live, path, 0, len(VIDEO))
    raw.socket.sendall(VIDEO[:sent])
    part = live.services.storage.upload_part(name(path))
    until(lambda: live.services.uploads.get(name(path)).token is not None)  # type: ignore[union-attr]
    raw.cut(live, path)
    kept = offset(live, path)
    assert kept <= sent
    assert part.read_bytes() == VIDEO[:kept]
    assert patch(live, path, kept, VIDEO[kept:]).status_code == 204
    assert live.http.post("/jobs", json={"upload": name(path)}).json()["state"] == "queued"


def test_a_broken_part_with_a_checksum_leaves_nothing(live: Live) -> None:
    path = begin(live)
    raw = Raw(live, path, 0, len(VIDEO), f"Upload-Checksum: {checksum(VIDEO)}\r\n")
    raw.socket.sendall(VIDEO[:5000])
    until(lambda: live.services.uploads.get(name(path)).token is not None)  # type: ignore[union-attr]
    raw.cut(live, path)
    assert offset(live, path) == 0
    assert live.services.storage.upload_part(name(path)).read_bytes() == b""


def test_one_writer_at_a_time(live: Live) -> None:
    path = begin(live)
    raw = Raw(live, path, 0, len(VIDEO))
    until(lambda: live.services.uploads.get(name(path)).token is not None)  # type: ignore[union-attr]
    problem(patch(live, path, 0, VIDEO), 423, "upload.locked")
    raw.socket.sendall(VIDEO)
    assert raw.socket.recv(4096).startswith(b"HTTP/1.1 204")
    raw.socket.close()
    assert offset(live, path) == len(VIDEO)


def test_a_sender_that_goes_silent_is_given_up(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.receiving.STALL_SECONDS", 0.3)
    path = begin(live)
    raw = Raw(live, path, 0, len(VIDEO))
    raw.socket.sendall(VIDEO[:2000])
    assert raw.socket.recv(4096).startswith(b"HTTP/1.1 408")
    raw.socket.close()
    assert offset(live, path) == 2000


def test_a_full_disk_says_so_and_keeps_what_was_promised(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    path = begin(live)
    assert patch(live, path, 0, VIDEO[:1000]).status_code == 204

    def full(self: Appender, chunk: bytes) -> None:
        self._file.write(chunk[:100])
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(Appender, "feed", full)
        answer = patch(live, path, 1000, VIDEO[1000:])
    problem(answer, 507, "storage.full")
    assert int(answer.headers["Retry-After"]) > 0
    assert live.services.storage.upload_part(name(path)).read_bytes() == VIDEO[:1000]
    assert patch(live, path, 1000, VIDEO[1000:]).status_code == 204
    with monkeypatch.context() as patched:
        patched.setattr(Storage, "has_room", lambda self, incoming=0: False)
        before = live.files()
        refused = live.http.post("/uploads", headers={**TUS, "Upload-Length": "5"})
        problem(refused, 507, "storage.full")
        assert live.files() == before


class Clock:
    def __init__(self) -> None:
        self.now = 1_000_000.0

    def __call__(self) -> float:
        return self.now


def test_uploads_expire_and_take_their_jobs_with_them(tmp_path: Path) -> None:
    clock, settings = Clock(), Settings(data_dir=tmp_path)
    store, storage = create_store(settings, clock), Storage(tmp_path)
    uploads = UploadStore(store.engine, 100, clock=clock)
    kept, late = (uploads.create("ann", 10, Quota()) for _ in range(2))
    for upload in (kept, late):
        storage.begin_upload(upload.id).write_bytes(b"12345")
        store.create({}, "v", job_id=upload.id, owner="ann", awaits_upload=True)
    clock.now += 90
    lock = uploads.lock(kept.id)
    assert lock is not None
    assert uploads.commit(lock, 5)
    assert uploads.get(late.id) is not None
    clock.now += 20
    assert uploads.get(late.id) is None
    swept = UploadStore(store.engine, 100, clock=clock)
    assert lifecycle.sweep(swept, store, storage) == [late.id]
    assert {job.id: str(job.state) for job in store.page()[0]} == {
        kept.id: "awaiting_upload",
        late.id: "expired",
    }
    assert [path.name for path in (tmp_path / "uploads").iterdir()] == [kept.id]
    # As after a crash between the end of the upload and the job's being told.
    storage.finish_upload(kept.id)
    assert uploads.finish(lock)
    assert lifecycle.sweep(swept, store, storage) == []
    job = store.get(kept.id)
    assert job is not None
    assert job.state == "queued"
    assert uploads.get(kept.id) is None
    store.close()


def test_open_uploads_are_not_taken_for_orphans(live: Live) -> None:
    path = begin(live)
    patch(live, path, 0, VIDEO[:50])
    assert name(path) not in sweep_uploads(live.services.store, live.services.storage, older_than=-60)
    assert offset(live, path) == 50


def test_a_dead_writers_lock_runs_out_and_it_can_write_no_more(tmp_path: Path) -> None:
    clock, store = Clock(), create_store(Settings(data_dir=tmp_path))
    uploads = UploadStore(store.engine, 1000, most=2, clock=clock)
    upload = uploads.create("ann", 10, Quota())
    dead = uploads.lock(upload.id)
    assert isinstance(dead, Lock)
    assert uploads.lock(upload.id) is None
    clock.now += LOCK_SECONDS + 1
    alive = uploads.lock(upload.id)
    assert alive is not None
    assert not uploads.commit(dead, 5)
    assert uploads.commit(alive, 3)
    uploads.create("ann", 10, Quota())
    with pytest.raises(TooManyUploadsError):
        uploads.create("ann", 10, Quota())
    uploads.create("bob", 10, Quota())
    store.close()
