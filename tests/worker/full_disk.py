"""Run in a mount namespace: a bench on a disk of 24 MB that fills up. Exits 0 when all was as it should."""

from __future__ import annotations

import ctypes
import os
import sys
import tempfile
from pathlib import Path

from service.jobs.model import JobState
from tests.worker.harness import Bench, wait_for

_DISK = 24 << 20


def main() -> int:
    root = Path(tempfile.mkdtemp(prefix="mass-full-", dir="/tmp"))
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mount(b"none", str(root).encode(), b"tmpfs", 0, f"size={_DISK}".encode()) != 0:
        raise OSError(ctypes.get_errno(), "cannot mount")
    try:
        _scenario(root)
    finally:
        libc.umount2(str(root).encode(), 2)
        root.rmdir()
    print("a full disk: all as expected")
    return 0


def _scenario(root: Path) -> None:
    data = root / "data"
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
        filler = root / "filler"
        with filler.open("wb") as file:
            free = os.statvfs(root).f_bavail * os.statvfs(root).f_frsize
            file.write(bytes(free - (2 << 20)))
        waiting = bench.submit()
        wait_for("it was left alone", lambda: f"job {waiting}: not started" in bench.workers[0].log)
        assert (bench.row(waiting).state, bench.row(waiting).attempt) == (JobState.QUEUED, 0)
        filler.unlink()
        assert bench.until(waiting, "succeeded").attempt == 1
        assert len(bench.starts(waiting)) == 1
    finally:
        bench.close()


if __name__ == "__main__":
    sys.exit(main())
