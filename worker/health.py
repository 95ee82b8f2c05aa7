"""``python -m worker.health``: exit 0 while a worker of this machine (or container) can take jobs, else 1."""

from __future__ import annotations

import socket
import sys

from service.pulse import live_workers
from service.settings import Settings


def main() -> int:
    """Print the live workers; returns the exit code."""
    alive = live_workers(Settings().data_dir, host=socket.gethostname())
    print(", ".join(alive) or "no live worker")
    return 0 if alive else 1


if __name__ == "__main__":
    sys.exit(main())
