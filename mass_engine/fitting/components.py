"""The parts of the method that can be switched off or changed, one field each."""

from __future__ import annotations

from dataclasses import dataclass

from mass_engine.errors import BadArgumentError

BINDINGS = ("none", "paper", "additive")
EXPOSURES = ("auto", "on", "off")


@dataclass(frozen=True)
class Components:
    """What a fit is made of; the command line has a flag for each.

    ``densify``: fractal surfels in the corners of the faces. ``detached``: surfels that leave the mesh,
    beside the attached ones; ``deform``: the network that moves and masks them. ``binding``: the loss that
    keeps them near it. ``levels`` of Loop subdivision (None: the preset's). ``refine_pose``: poses,
    shape and surface of stage one. ``exposure``: a gain per frame and colour channel: "on", "off", or "auto"
    where the clip's frames disagree clearly (True and False mean on and off). ``shading``: the clip's light.
    ``harmonics``: view-dependent colour. ``settle``: stage two moves and sizes attached surfels a little.
    """

    densify: bool = True
    detached: bool = True
    deform: bool = True
    binding: str = "additive"
    levels: int | None = None
    refine_pose: bool = True
    exposure: str | bool = "auto"
    shading: bool = True
    harmonics: bool = True
    settle: bool = True

    def __post_init__(self) -> None:
        if isinstance(self.exposure, bool):
            object.__setattr__(self, "exposure", "on" if self.exposure else "off")
        if self.exposure not in EXPOSURES:
            raise BadArgumentError(
                "options.invalid",
                f"exposure cannot be {self.exposure!r}.",
                f"Use one of {', '.join(EXPOSURES)}.",
            )
        if self.binding not in BINDINGS:
            raise BadArgumentError(
                "options.invalid",
                f"binding cannot be {self.binding!r}.",
                f"Use one of {', '.join(BINDINGS)}.",
            )
        if self.levels is not None and not 0 <= self.levels <= 2:
            raise BadArgumentError("options.invalid", f"levels cannot be {self.levels!r}.", "Use 0, 1 or 2.")
