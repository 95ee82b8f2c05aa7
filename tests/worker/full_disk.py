"""Run in a mount namespace: worker and API on a disk of 24 MB that fills up. Exits 0 when all was right."""

from __future__ import annotations

import ctypes
import os
import sys
import tempfile
from pathlib import Path

import httpx

from service.jobs.model import JobState
from tests.worker.api_process import MP4, api
from tests.worker.harness import Bench, wait_for

_DISK = 24 << 20


def main() -> int:
    root = Path(tempfile.mkdtemp(prefix="mass-full-", dir="/tmp"))
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mount(b"none", str(root).encode(), b"tmpfs", 0, f"size={_DISK}".encode()) != 0:
        raise OSError(ctypes.get_errno(), "cannot mount")
    try:
        _engines(root)
        _uploads(root)
    finally:
        libc.umount2(str(root).encode(), 2)
        root.rmdir()
    print("a full disk: all as expected")
    return 0


def _engines(root: Path) -> None:
    data = root / "engines"
    data.mkdir()
    bench = Bench(data_dir=data, min_free_bytes=4 << 20)
    try:
        bench.worker().ready()
        # An engine that fills the disk: three attempts, then a failure that says so, and nothing published.
        greedy = bench.submit("fill")
        job = bench.until(greedy, "failed")
        assert (job.error_code, job.attempt, job.artifact) == ("storage.full", 3, None), job.error_code
        assert len(bench.starts(greedy)) == 3
        wait_for("its files are gone", lambda: not [*(data / "jobs" / greedy).iterdir()])
        # A disk that is full before: the job is not started, costs no attempt, and runs once there is room.
        filler = _fill(root, 2 << 20)
        waiting = bench.submit()
        wait_for("it was left alone", lambda: f"job {waiting}: not started" in bench.workers[0].log)
        assert (bench.row(waiting).state, bench.row(waiting).attempt) == (JobState.QUEUED, 0)
        filler.unlink()
        assert bench.until(waiting, "succeeded").attempt == 1
        assert len(bench.starts(waiting)) == 1
    finally:
        bench.close()


def _uploads(root: Path) -> None:
    """Videos of four megabytes for a disk with two left, which nothing announced to the API."""
    data = root / "uploads"
    data.mkdir()
    bench = Bench(data_dir=data, min_free_bytes=0)
    tus = {"Tus-Resumable": "1.0.0"}
    try:
        with api(bench) as running:
            http = running.http
            video = MP4 + bytes(4 << 20) + running.video("full").removeprefix(MP4)
            upload = http.post("/uploads", headers={**tus, "Upload-Length": str(len(video))})
            path = upload.headers["Location"]
            assert http.post("/jobs", json={"upload": path.rpartition("/")[2]}).status_code == 202
            before = _files(data)

            def send(start: int, end: int) -> httpx.Response:
                part = {"Content-Type": "application/offset+octet-stream", "Upload-Offset": str(start)}
                return http.patch(path, headers={**tus, **part}, content=video[start:end])

            def offset() -> int:
                return int(http.head(path, headers=tus).headers["Upload-Offset"])

            assert send(0, 5000).status_code == 204
            filler = _fill(root, 2 << 20)
            # In parts: what was promised before is still there, nothing more.
            _is_full(send(5000, len(video)))
            assert offset() == 5000
            # In one form, in chunks that do not say how many will come.
            form = b'--b\r\nContent-Disposition: form-data; name="video"\r\n\r\n' + video + b"\r\n--b--\r\n"
            kind = {"Content-Type": "multipart/form-data; boundary=b"}
            _is_full(http.post("/jobs", content=iter([form]), headers=kind))
            # And what can be seen to be hopeless.
            _is_full(http.post("/uploads", headers={**tus, "Upload-Length": str(len(video))}))
            assert _files(data) == before
            (job,) = http.get("/jobs").json()["jobs"]
            assert job["state"] == "awaiting_upload"
            filler.unlink()
            assert send(5000, len(video)).status_code == 204
            bench.worker()
            bench.until(job["id"], "succeeded")
            assert running.starts("full") == 1
    finally:
        bench.close()


def _fill(root: Path, left: int) -> Path:
    """A file that leaves so many bytes free."""
    filler = root / "filler"
    with filler.open("wb") as file:
        free = os.statvfs(root).f_bavail * os.statvfs(root).f_frsize
        file.write(bytes(free - left))
    return filler


def _files(data: Path) -> list[Path]:
    return sorted(path for name in ("uploads", "jobs") for path in (data / name).rglob("*"))


def _is_full(answer: httpx.Response) -> None:
    assert (answer.status_code, answer.json()["code"]) == (507, "storage.full"), answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    assert int(answer.headers["Retry-After"]) > 0


if __name__ == "__main__":
    sys.exit(main())
