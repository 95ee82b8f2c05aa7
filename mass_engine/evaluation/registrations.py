"""Stage one once for many fits: up to the conversion it is the same whatever surfels come after it."""

from __future__ import annotations

import contextlib
import hashlib
import shutil
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

from mass_engine.fitting.schedule import Schedule
from mass_engine.fitting.trainer import FitResult, fit_hand
from mass_engine.preprocess import Clip

_CONVERSION = "conversion"


class _RegisteredError(Exception):
    """Everything before the conversion is on disk."""


@dataclass
class Registrations:
    """Fits of one prepared clip with one seed that go on from the same registration.

    ``folder`` holds one checkpoint for every way to register. What lies there from an earlier run of the same
    clip is taken up, anything else is written over.
    """

    clip: Clip
    seed: int
    folder: Path
    _ready: set[Path] = field(default_factory=set)

    def fit(self, schedule: Schedule) -> tuple[FitResult, float]:
        """A fit, and the seconds it would have taken alone: those of the registration and its own."""
        base = self._base(schedule)
        with tempfile.TemporaryDirectory() as folder:
            own = Path(folder) / "fit"
            if base.is_file():
                shutil.copy(base, own)
            started = time.perf_counter()
            result = self._run(schedule, own)
            seconds = time.perf_counter() - started
        steps, spent = result.state.steps, result.state.notes["seconds"]
        early = steps[: steps.index(_CONVERSION)]
        return result, seconds + sum(spent[name] for name in early)

    def _base(self, schedule: Schedule) -> Path:
        """The checkpoint after the registration (no file if the schedule has none)."""
        way = f"{schedule.geometry} {schedule.outline} {schedule.texture} {schedule.validate_every}"
        file = self.folder / f"{hashlib.sha256(way.encode()).hexdigest()[:16]}-{self.seed}"
        if file not in self._ready:
            self.folder.mkdir(parents=True, exist_ok=True)
            with contextlib.suppress(_RegisteredError):
                self._run(schedule, file, stop=True)
            self._ready.add(file)
        return file

    def _run(self, schedule: Schedule, checkpoint: Path, stop: bool = False) -> FitResult:
        def progress(_: float, name: str) -> None:
            if stop and name == _CONVERSION:
                raise _RegisteredError

        clip = self.clip
        return fit_hand(
            clip.views, clip.start, clip.model, clip.camera, schedule, self.seed, progress, None, checkpoint
        )
