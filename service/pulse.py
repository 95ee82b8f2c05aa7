"""Signs of life of workers: a small file each in the data directory, touched while they can take jobs."""

from __future__ import annotations

import os
import socket
import time
from pathlib import Path

#: A worker touches its file this often, seconds.
PULSE_SECONDS = 2.0
#: Older than this, the worker counts as gone or stuck.
PULSE_MAX_AGE = 30.0


def pulse_path(data_dir: Path, pid: int | None = None, host: str | None = None) -> Path:
    """The file of the worker with process id ``pid`` on ``host`` (default: this process, this machine)."""
    name = f"worker-{host or socket.gethostname()}-{pid or os.getpid()}.alive"
    return data_dir / "run" / name


def sweep_pulses(data_dir: Path, older_than: float = 24 * 3600.0) -> None:
    """Remove the files of workers long dead (in containers, every start has a new name)."""
    for path in (data_dir / "run").glob("worker-*.alive"):
        if not is_fresh(path, older_than):
            path.unlink(missing_ok=True)


def is_fresh(path: Path, max_age: float = PULSE_MAX_AGE) -> bool:
    """Whether the file was touched in the last ``max_age`` seconds."""
    try:
        return time.time() - path.stat().st_mtime <= max_age
    except FileNotFoundError:
        return False


def live_workers(data_dir: Path, max_age: float = PULSE_MAX_AGE, host: str | None = None) -> list[str]:
    """Names (host-pid) of the workers that are alive, on ``host`` or everywhere the directory is shared."""
    pattern = "worker-*.alive" if host is None else f"worker-{host}-*.alive"
    found = sorted((data_dir / "run").glob(pattern))
    return [path.stem.removeprefix("worker-") for path in found if is_fresh(path, max_age)]
