"""How long a GPU works on something, by its own clock, and how fast its memory is."""

from __future__ import annotations

import statistics
from collections.abc import Callable

import torch

#: Bytes that a copy moves to find the memory's rate; large, so that no cache holds them.
_COPIED = 1 << 30


def device_times(action: Callable[[], object], repeat: int) -> tuple[float, float, float]:
    """Median, least and greatest milliseconds between events around ``action``, after three not counted.

    The GPU is idle before each, so the host's share counts only where it keeps the GPU waiting.
    """
    for _ in range(3):
        action()
    spent = []
    for _ in range(repeat):
        torch.cuda.synchronize()
        start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
        start.record()
        action()
        end.record()
        end.synchronize()
        spent.append(start.elapsed_time(end))
    return statistics.median(spent), min(spent), max(spent)


def copy_bandwidth(device: torch.device) -> float:
    """Bytes read and written a second by the device's own copy of a large tensor."""
    source = torch.empty(_COPIED, dtype=torch.uint8, device=device)
    target = torch.empty_like(source)
    median, _, _ = device_times(lambda: target.copy_(source), 10)
    return 2 * _COPIED / (median / 1000)
