"""What a user may choose about a fit."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import get_args

from mass_engine.device import DEVICES, Precision, choose_device
from mass_engine.errors import BadArgumentError
from mass_engine.fitting.components import Components
from mass_engine.progress import FIT_STAGES
from mass_engine.template_spec import parse_template
from mass_engine.tracks_spec import parse_tracks

PRESETS = ("draft", "auto", "full")
SIDES = ("auto", "left", "right", "both")
SEGMENTERS = ("colors", "sam-hq")
PRECISIONS: tuple[Precision, ...] = get_args(Precision)


@dataclass(frozen=True)
class FitOptions:
    """Options of :func:`mass_engine.fit`; the command line has a flag of the same name for each.

    ``template``: see :mod:`mass_engine.template_spec`; ``tracks``: :mod:`mass_engine.tracks_spec`.

    ``side`` of the hand to fit: ``auto`` the most prominent one, ``both`` a person's two hands, each of them
    an avatar of its own (``masks`` then has a folder ``right`` and a folder ``left``).

    ``masks`` is a folder of masks to use instead of made ones; ``segmenter`` says how masks are made, and
    ``segmenter_weights`` is the checkpoint that "sam-hq" needs.

    ``holdout`` N keeps the frames N-1, 2N-1, ... out of the fit (0: none). ``fov`` in degrees spans the
    longer image side; None takes what the file says or a phone-like default; the report says which.
    ``max_frames`` bounds the frames the fit sees; held-out frames do not count, of which at most 160 (or
    ``max_frames``, if that is more) are kept, evenly spread. A video of more than ``max_seconds`` is refused.

    ``refined_frames``: so many held-out frames, evenly spread, are scored once more after test-time pose
    refinement, which takes seconds a frame.

    ``precision`` of the deformation's matrix products on a GPU; a CPU's are always float32.

    ``resume``: go on after the last step that a killed fit of the same clip and options left in the run's
    directory; of that only what comes before ``from_stage`` (one of the report's stages). ``components``:
    parts of the method to switch off.
    """

    template: str = "builtin"
    tracks: Path | str | None = None
    masks: Path | None = None
    segmenter: str = "colors"
    segmenter_weights: Path | None = None
    side: str = "auto"
    preset: str = "auto"
    holdout: int = 0
    refined_frames: int = 0
    seed: int = 0
    device: str = "auto"
    precision: Precision = "float32"
    fov: float | None = None
    max_frames: int = 160
    resume: bool = False
    from_stage: str | None = None
    components: Components = field(default_factory=Components)
    max_seconds: float = 600.0

    def __post_init__(self) -> None:
        checks = (
            (self.preset in PRESETS, "preset", self.preset, f"Use one of {', '.join(PRESETS)}."),
            (self.side in SIDES, "side", self.side, f"Use one of {', '.join(SIDES)}."),
            (self.device in DEVICES, "device", self.device, f"Use one of {', '.join(DEVICES)}."),
            (
                self.precision in PRECISIONS,
                "precision",
                self.precision,
                f"Use one of {', '.join(PRECISIONS)}.",
            ),
            (
                self.segmenter in SEGMENTERS,
                "segmenter",
                self.segmenter,
                f"Use one of {', '.join(SEGMENTERS)}.",
            ),
            (
                (self.segmenter == "sam-hq") == (self.segmenter_weights is not None),
                "segmenter_weights",
                self.segmenter_weights,
                "Give a checkpoint with --segmenter sam-hq, and only with it.",
            ),
            (self.holdout == 0 or self.holdout >= 2, "holdout", self.holdout, "Use 0, or 2 and more."),
            (self.refined_frames >= 0, "refined_frames", self.refined_frames, "Use 0 or more."),
            (self.fov is None or 5 <= self.fov <= 150, "fov", self.fov, "Use 5 to 150 degrees."),
            (2 <= self.max_frames <= 10_000, "max_frames", self.max_frames, "Use 2 to 10000."),
            (
                0 < self.max_seconds < 1e6,
                "max_seconds",
                self.max_seconds,
                "Use a positive number of seconds.",
            ),
            (
                self.from_stage is None or self.from_stage in FIT_STAGES,
                "from_stage",
                self.from_stage,
                f"Use one of {', '.join(FIT_STAGES)}.",
            ),
            (0 <= self.seed < 2**63, "seed", self.seed, "Use a number from 0 on."),
        )
        for good, name, value, advice in checks:
            if not good:
                raise BadArgumentError("options.invalid", f"{name} cannot be {value!r}.", advice)
        if self.device == "cuda":
            choose_device(self.device)
        parse_template(self.template)
        if self.tracks is not None:
            parse_tracks(str(self.tracks))

    def is_heldout(self, index: int) -> bool:
        """Whether the frame with this index is kept out of the fit."""
        return self.holdout > 0 and index % self.holdout == self.holdout - 1
