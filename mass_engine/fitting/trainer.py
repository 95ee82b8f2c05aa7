"""The fit of one hand: stage one, conversion at the final resolution, stage two, held-out poses."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from mass_engine.avatar import Avatar, SourceFrames
from mass_engine.camera import Camera
from mass_engine.fitting.appearance import START_OPACITY, AppearanceFit, AppearancePass, Evidence, fill_unseen
from mass_engine.fitting.geometry import GeometryFit, GeometryPass, GeometryWeights
from mass_engine.fitting.poses import PoseTable
from mass_engine.fitting.subject import Appearance, Shape
from mass_engine.fitting.views import View
from mass_engine.hand.model import HandModel
from mass_engine.hand.pose import HandPose
from mass_engine.raster import RasterOptions
from mass_engine.surfel.binding import MeshBinding
from mass_engine.surfel.shading import white_light
from mass_engine.tracking.alignment import interpolate_pose


@dataclass(frozen=True)
class Schedule:
    """How much work a preset does: stage-one passes on a coarse binding, stage-two passes on the final one.

    ``levels`` and ``depth`` are Loop levels and fractal depth; ``harmonics`` the number of view-dependent
    coefficients a colour channel has (0, 3, 8, 15).
    """

    coarse_levels: int
    coarse_depth: int
    levels: int
    depth: int
    harmonics: int
    geometry: tuple[GeometryPass, ...]
    appearance: tuple[AppearancePass, ...]
    heldout: tuple[GeometryPass, ...]
    gather_frames: int
    gather_side: int


def schedule_for(preset: str) -> Schedule:
    """The schedule of a preset (draft, auto, full)."""
    rough = GeometryWeights(landmarks=2.0)
    heldout = (
        GeometryPass(96, 12, rate=0.7, color=False, shared=False, weights=rough),
        GeometryPass(192, 8, rate=0.4, color=False, shared=False),
    )
    if preset == "draft":
        return Schedule(
            0, 0, 1, 0, 0,
            (GeometryPass(80, 8, color=False, weights=rough), GeometryPass(128, 6, rate=0.7)),
            (AppearancePass(256, 2),),
            heldout[:1], 40, 256,
        )  # fmt: skip
    geometry = (
        GeometryPass(96, 12, color=False, weights=rough),
        GeometryPass(96, 8, rate=0.8),
        GeometryPass(192, 10, rate=0.6),
        GeometryPass(320, 6, rate=0.3),
    )
    appearance = (AppearancePass(320, 2), AppearancePass(640, 3, rate=0.7, view_dependent=True))
    if preset == "auto":
        return Schedule(0, 1, 1, 1, 3, geometry, appearance, heldout, 60, 640)
    return Schedule(1, 1, 2, 1, 8, geometry, appearance, heldout, 100, 640)


@dataclass(frozen=True)
class FitResult:
    """The avatar and what the fit knows about itself. ``table`` rows follow the views given."""

    avatar: Avatar
    table: PoseTable
    evidence: Evidence
    rejected_steps: int
    trimmed: int
    unseen: int


def fit_hand(
    views: list[View],
    start: HandPose,
    model: HandModel,
    camera: Camera,
    schedule: Schedule,
    seed: int,
    progress: Callable[[float, str], None],
) -> FitResult:
    """Fit one hand to ``views`` (in time order) from the poses ``start`` [F] with one shape.

    Held-out views give only their silhouette and landmarks, only to their own pose, and only after
    everything else is finished.
    """
    torch.manual_seed(seed)
    raster = RasterOptions(cull_backfaces=True)
    table = PoseTable(start)
    shape = Shape.mean(model, start.betas[0])
    coarse = MeshBinding.build(model, schedule.coarse_levels, schedule.coarse_depth)
    rough_look = Appearance(
        torch.full((coarse.count, 3), 0.5),
        torch.full((coarse.count,), _logit(START_OPACITY)),
        torch.zeros(coarse.count, 0, 3),
        white_light(),
    )
    shares = _shares(schedule, views)
    done = 0.0

    def part(share: float, note: str) -> Callable[[float], None]:
        begin = done
        return lambda fraction: progress(begin + share * fraction, note)

    geometry = GeometryFit(views, table, shape, rough_look, coarse, camera, seed, raster)
    colored = False
    for stage, share in zip(schedule.geometry, shares.geometry, strict=True):
        if stage.color and not colored:
            evidence = AppearanceFit(views, table, shape, coarse, seed, raster).gather(
                rough_look.light, stage.side, 40
            )
            rough_look.albedo = fill_unseen(evidence, coarse, 0.5)
            colored = True
        geometry.run(stage, progress=part(share, f"stage 1 at {stage.side} px"))
        done += share

    binding = MeshBinding.build(model, schedule.levels, schedule.depth)
    second = AppearanceFit(views, table, shape, binding, seed, raster)
    evidence = second.gather(rough_look.light, schedule.gather_side, schedule.gather_frames)
    appearance = Appearance(
        fill_unseen(evidence, binding, 0.5),
        torch.full((binding.count,), _logit(START_OPACITY)),
        torch.zeros(binding.count, schedule.harmonics, 3),
        rough_look.light.clone(),
    )
    for step, share in zip(schedule.appearance, shares.appearance, strict=True):
        second.run(appearance, step, progress=part(share, f"stage 2 at {step.side} px"))
        done += share

    _place_heldout(views, table, start)
    heldout = torch.tensor([row for row, view in enumerate(views) if view.heldout], dtype=torch.long)
    if len(heldout) > 0:
        for stage in schedule.heldout:
            geometry.run(stage, heldout)

    kept = _keep(evidence)
    avatar = Avatar(
        shape,
        binding,
        kept,
        Appearance(
            appearance.albedo[kept], appearance.opacity_logits[kept], appearance.sh[kept], appearance.light
        ),
        camera,
        SourceFrames(
            torch.tensor([view.index for view in views]),
            torch.tensor([view.heldout for view in views]),
            table.pose(shape.betas),
        ),
        _best_frame(views),
    )
    return FitResult(
        avatar,
        table,
        evidence,
        geometry.rejected_steps + second.rejected_steps,
        binding.count - len(kept),
        int((evidence.hand < 0.5).sum()),
    )


@dataclass(frozen=True)
class _Shares:
    geometry: list[float]
    appearance: list[float]


def _shares(schedule: Schedule, views: list[View]) -> _Shares:
    """How the time divides over the passes: by pixels and visits, with a constant part a step."""
    first = [stage.visits * (60.0**2 + stage.side**2) for stage in schedule.geometry]
    second = [stage.visits * 2 * (60.0**2 + stage.side**2) for stage in schedule.appearance]
    total = sum(first) + sum(second)
    return _Shares([value / total for value in first], [value / total for value in second])


def _logit(probability: float) -> float:
    return float(torch.logit(torch.tensor(probability)))


def _keep(evidence: Evidence) -> Tensor:
    """Surfels to keep: the avatar ends where the hand was seen to end.

    What the clip shows mostly as ignored (forearm) or background is cut; what it never shows stays, so
    that the hand is whole from every side.
    """
    seen = evidence.hand + evidence.ignored + evidence.background
    return ((seen < 0.5) | (evidence.hand > 0.3 * seen)).nonzero()[:, 0]


def _place_heldout(views: list[View], table: PoseTable, start: HandPose) -> None:
    """Start each held-out pose between its neighbours' refined poses."""
    trained = [row for row, view in enumerate(views) if not view.heldout]
    heldout = [row for row, view in enumerate(views) if view.heldout]
    if not heldout:
        return
    rows = torch.tensor(trained)
    known = HandPose(
        start.betas[rows],
        table.values["global_orient"][rows],
        table.values["hand_pose"][rows],
        table.values["transl"][rows],
        start.side,
    )
    between = interpolate_pose(
        known, [views[row].time for row in trained], [views[row].time for row in heldout]
    )
    table.put(torch.tensor(heldout), between)


def _best_frame(views: list[View]) -> int:
    """The training frame whose hand covers most of the picture, at full confidence."""
    trained = [view for view in views if not view.heldout]
    return max(trained, key=lambda view: float((view.labels == 255).sum()) * view.score).index


