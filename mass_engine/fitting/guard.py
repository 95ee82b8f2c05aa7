"""Watching a descent: when it makes a NaN or the loss leaps, it goes back and on at half the rate."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import torch
from torch import Tensor

#: A loss this many times the recent median is no step's fault but an outlier's, or the end of descent.
LEAP = 10.0
#: Leaps in a row that are a divergence; one alone (a bad frame) is left out.
IN_A_ROW = 3
#: Steps between copies of the values to go back to.
KEEP_EVERY = 25


class Guard:
    """Keeps recent good ``values``; ``rate`` is what the learning rates are to be multiplied by; ``undone``
    counts the times it went back, ``skipped`` the steps left out."""

    def __init__(self, values: Sequence[Tensor]) -> None:
        self._values = list(values)
        self._losses: deque[float] = deque(maxlen=41)
        self._steps = self._leaps = 0
        self.rate = 1.0
        self.undone = self.skipped = 0
        self._keep()

    def good(self, loss: Tensor, more: Sequence[Tensor | None] = ()) -> bool:
        """Whether to take the step of the values' gradients, and ``more`` of them."""
        grads = [grad for grad in (*(value.grad for value in self._values), *more) if grad is not None]
        finite = bool(torch.isfinite(loss)) and all(bool(torch.isfinite(grad).all()) for grad in grads)
        value = float(loss.detach())
        if finite and (len(self._losses) < 9 or value <= LEAP * self._median()):
            self._losses.append(value)
            if self._steps % KEEP_EVERY == 0:
                self._keep()
            self._steps += 1
            self._leaps = 0
            return True
        self._leaps += 1
        self.skipped += 1
        if not finite or self._leaps >= IN_A_ROW:
            self._go_back()
        return False

    def _go_back(self) -> None:
        with torch.no_grad():
            for current, kept in zip(self._values, self._kept, strict=True):
                current.copy_(kept)
        self.rate *= 0.5
        self.undone += 1
        self._leaps = 0

    def _median(self) -> float:
        return sorted(self._losses)[len(self._losses) // 2]

    def _keep(self) -> None:
        # What is in the values now came of good steps alone.
        self._kept = [value.detach().clone() for value in self._values]
