"""Schedules: how much work a preset does, step by step."""

from __future__ import annotations

from dataclasses import dataclass, replace

from mass_engine.fitting.components import Components
from mass_engine.fitting.gauss_newton import Round
from mass_engine.fitting.geometry import GeometryPass, GeometryWeights
from mass_engine.fitting.registration import RegistrationWeights
from mass_engine.fitting.surfel_fit import SurfelPass

#: How far the surface stands over the mask's outline, pixels: a hole shows the background, a rim only skin.
RIM_BIAS = 0.4
#: The steps of every frame in the sweep.
SWEEP = tuple(Round(side, betas=False, offsets=False) for side in (160, 320, 640))


@dataclass(frozen=True)
class Schedule:
    """How much work a preset does.

    ``levels`` and ``depth`` are the Loop levels and fractal depth of the final surfels; ``harmonics`` is the
    number of view-dependent coefficients a colour channel may have (0, 3, 8, 15). Stage one is ``geometry``
    (by gradient, from afar), ``outline`` (registration without texture), then, if there is any ``texture``, a
    sweep over the frames and registration with it, then ``deforming``, where detached surfels leave the mesh.
    ``adaptive``: surfels, harmonics and the deformation only where the clip has a use for them.
    """

    levels: int
    depth: int
    harmonics: int
    geometry: tuple[GeometryPass, ...]
    outline: tuple[Round, ...]
    texture: tuple[Round, ...]
    deforming: tuple[SurfelPass, ...]
    appearance: tuple[SurfelPass, ...]
    heldout: tuple[Round, ...]
    gather_frames: int
    gather_side: int
    detached: bool
    adaptive: bool
    validate_every: int = 9  # one training frame in so many


def schedule_for(preset: str, components: Components | None = None) -> Schedule:
    """The schedule of a preset (draft, auto, full) without what ``components`` switches off."""
    parts = components or Components()
    schedule = _preset(preset)
    if not parts.refine_pose:
        schedule = replace(schedule, geometry=(), outline=(), texture=(), heldout=())
    if not (parts.detached and parts.deform):
        schedule = replace(schedule, deforming=())
    if not parts.detached:
        schedule = replace(schedule, detached=False)
    if not parts.densify:
        schedule = replace(schedule, depth=0)
    if not parts.harmonics:
        schedule = replace(schedule, harmonics=0)
    if not parts.settle:
        schedule = unsettled(schedule)
    if parts.levels is not None:
        schedule = replace(schedule, levels=parts.levels)
    return schedule


def unsettled(schedule: Schedule) -> Schedule:
    """The schedule with attached surfels where the mesh has them."""
    appearance = tuple(replace(step, settle=False) for step in schedule.appearance)
    return replace(schedule, appearance=appearance)


def _preset(preset: str) -> Schedule:
    rough = GeometryWeights(landmarks=1.0, outline=20.0, limits=1.0)
    middle = GeometryWeights(landmarks=0.1, outline=20.0)
    first = GeometryPass(96, 10, rate=2.0, color=False, weights=rough)
    second = GeometryPass(160, 14, levels=1, depth=0, rate=1.5, weights=middle)
    # Surface and shape answer to the same evidence: one at a time, or they overshoot together.
    pose = Round(160, texture=False, betas=False, offsets=False)
    surface = replace(pose, offsets=True)
    standing = RegistrationWeights(rim_bias=RIM_BIAS)
    heldout = (replace(pose, side=320), *(replace(pose, side=640, weights=standing),) * 2)
    if preset == "draft":
        return Schedule(
            1,
            0,
            0,
            (replace(first, visits=8), replace(second, visits=8)),
            (pose, surface, replace(surface, side=256, weights=standing)),
            (),
            (),
            (SurfelPass(256, 2, settle=True),),
            heldout,
            40,
            256,
            False,
            True,
        )
    pair = (Round(320, offsets=False), Round(320, betas=False))
    texture = (*pair * 3, *(Round(640, weights=standing),) * 5)
    deforming = (SurfelPass(320, 3, geometry=True),)
    appearance = (SurfelPass(320, 2, settle=True), SurfelPass(640, 4, rate=0.7, harmonics=True, settle=True))
    outline = (*(pose,) * 4, *(surface,) * 2)
    if preset == "auto":
        return Schedule(
            1, 1, 3, (first, second), outline, texture, deforming, appearance, heldout, 60, 640, True, True
        )
    return Schedule(
        2, 1, 8, (first, second), outline, texture, deforming, appearance, heldout, 100, 640, True, False
    )
