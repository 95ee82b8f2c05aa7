"""Progress of a long operation: which stage, how far, how long still."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

#: Stages of ``fit`` in order with their share of a typical run's time (fractions of 1).
FIT_STAGES: dict[str, float] = {
    "read": 0.01,
    "track": 0.12,
    "segment": 0.10,
    "align": 0.07,
    "convert": 0.01,
    "fit": 0.64,
    "evaluate": 0.04,
    "save": 0.01,
}


@dataclass(frozen=True)
class Progress:
    """One report: ``fraction`` is of the whole operation (0 to 1), ``time_left`` in seconds or None."""

    stage: str
    fraction: float
    time_left: float | None
    message: str = ""


class ProgressMeter:
    """Turns (stage, fraction of that stage) into monotonic :class:`Progress` reports."""

    def __init__(
        self,
        report: Callable[[Progress], None],
        stages: dict[str, float] | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._report = report
        self._stages = FIT_STAGES if stages is None else stages
        self._clock = clock
        self._start = clock()
        self._fraction = 0.0
        self.seconds: dict[str, float] = {}
        self._stage: str | None = None
        self._stage_start = self._start

    def update(self, stage: str, stage_fraction: float, message: str = "") -> None:
        """Report that ``stage`` is ``stage_fraction`` done (0 to 1)."""
        now = self._clock()
        if stage != self._stage:
            self.close()
            self._stage, self._stage_start = stage, now
        names = list(self._stages)
        before = sum(self._stages[name] for name in names[: names.index(stage)])
        total = sum(self._stages.values())
        fraction = (before + self._stages[stage] * min(max(stage_fraction, 0.0), 1.0)) / total
        self._fraction = max(self._fraction, min(fraction, 1.0))
        elapsed = now - self._start
        left = elapsed * (1 - self._fraction) / self._fraction if self._fraction > 0.02 else None
        self._report(Progress(stage, self._fraction, left, message))

    def close(self) -> None:
        """Book the seconds of the stage now running."""
        if self._stage is not None:
            spent = self._clock() - self._stage_start
            self.seconds[self._stage] = self.seconds.get(self._stage, 0.0) + spent
            self._stage = None
