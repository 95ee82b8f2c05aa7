"""How many threads torch's own operators use, for a while."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch


@contextmanager
def one_thread() -> Iterator[None]:
    """Run torch's operators in the calling thread alone.

    For many small operators in a row: their threads wait for one another by spinning, and where other work
    runs on the machine each wait costs a time slice of the scheduler, milliseconds instead of microseconds.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
