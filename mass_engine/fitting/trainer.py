"""The fit of one hand: stage one, conversion at the final resolution, stage two, held-out poses."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mass_engine.avatar import Avatar, SourceFrames
from mass_engine.camera import Camera
from mass_engine.fitting.appearance import AppearanceFit, AppearancePass, Evidence, fill_unseen
from mass_engine.fitting.gauss_newton import Registrar, Round
from mass_engine.fitting.geometry import GeometryFit, GeometryPass, GeometryWeights
from mass_engine.fitting.poses import PoseTable
from mass_engine.fitting.registration import RegistrationWeights
from mass_engine.fitting.subject import Appearance, Shape, render_row
from mass_engine.fitting.views import View
from mass_engine.hand.model import HandModel
from mass_engine.hand.pose import HandPose
from mass_engine.raster import RasterOptions
from mass_engine.surfel.binding import MeshBinding
from mass_engine.surfel.shading import white_light
from mass_engine.threads import one_thread
from mass_engine.tracking.alignment import interpolate_pose

#: How far into the hand from its wrist joint it may be cut, metres at the mean size.
WRIST_REACH = 0.03
#: What a pixel of background, and of forearm, counts against one of hand when the wrist is cut. A sleeve
#: that slides shows in one frame what it hides in another: the hand ends where it was never seen.
BACKGROUND_WEIGHT, FOREARM_WEIGHT = 0.2, 0.004
#: How far the surface stands over the mask's outline, pixels: a hole shows the background, a rim only skin.
RIM_BIAS = 0.4
#: Frames whose mean texture the others are registered against.
REGISTRATION_FRAMES = 100
#: Longer side of a look at the hand during the fit, pixels.
LOOK_SIDE = 320
#: The steps of every frame in the sweep.
SWEEP = tuple(Round(side, betas=False, offsets=False) for side in (160, 320, 640))


@dataclass(frozen=True)
class Schedule:
    """How much work a preset does.

    ``levels`` and ``depth`` are the Loop levels and fractal depth of the final surfels; ``harmonics`` is the
    number of view-dependent coefficients a colour channel has (0, 3, 8, 15). Stage one is ``geometry`` (by
    gradient, from afar), ``outline`` (registration without texture), then, if there is any ``texture``, a
    sweep over the frames and registration with it.
    """

    levels: int
    depth: int
    harmonics: int
    geometry: tuple[GeometryPass, ...]
    outline: tuple[Round, ...]
    texture: tuple[Round, ...]
    appearance: tuple[AppearancePass, ...]
    heldout: tuple[Round, ...]
    gather_frames: int
    gather_side: int


def schedule_for(preset: str) -> Schedule:
    """The schedule of a preset (draft, auto, full)."""
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
            (AppearancePass(256, 2),),
            heldout,
            40,
            256,
        )
    pair = (Round(320, offsets=False), Round(320, betas=False))
    texture = (*pair * 3, *(Round(640, weights=standing),) * 5)
    appearance = (AppearancePass(320, 2), AppearancePass(640, 3, rate=0.7, view_dependent=True))
    outline = (*(pose,) * 4, *(surface,) * 2)
    if preset == "auto":
        return Schedule(1, 1, 3, (first, second), outline, texture, appearance, heldout, 60, 640)
    return Schedule(2, 1, 8, (first, second), outline, texture, appearance, heldout, 100, 640)


#: Told what the hand looks like now, uint8 [H,W,3].
Show = Callable[[NDArray[np.uint8]], None]


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
    show: Show | None = None,
) -> FitResult:
    """Fit one hand to ``views`` (in time order) from the poses ``start`` [F] with one shape.

    ``show`` gets a look at the hand now and then during stage two; the fit is the same with or without it.

    Held-out views give only their silhouette and landmarks, only to their own pose, and only after
    everything else is finished.
    """
    torch.manual_seed(seed)
    raster = RasterOptions(cull_backfaces=True)
    table = PoseTable(start)
    shape = Shape.mean(model, start.betas[0])
    shares = _shares(schedule)
    done = 0.0

    def part(share: float, note: str) -> Callable[[float], None]:
        begin = done
        return lambda fraction: progress(begin + share * fraction, note)

    geometry = GeometryFit(views, table, shape, camera, seed, raster)
    bindings: dict[tuple[int, int], MeshBinding] = {}

    def bind(levels: int, depth: int) -> MeshBinding:
        if (levels, depth) not in bindings:
            bindings[levels, depth] = MeshBinding.build(model, levels, depth)
        return bindings[levels, depth]

    for stage, share in zip(schedule.geometry, shares.geometry, strict=True):
        coarse = bind(stage.levels, stage.depth)
        look = Appearance.plain(coarse.count, white_light())
        if stage.color:
            gatherer = AppearanceFit(views, table, shape, coarse, seed, raster)
            look.albedo = fill_unseen(gatherer.gather(look.light, stage.side, 40), coarse, 0.5)
        geometry.run(stage, coarse, look, progress=part(share, f"stage 1 at {stage.side} px"))
        done += share
    registrar = Registrar(views, table, shape, camera, raster)
    with one_thread():  # many small products a frame
        _register(registrar, schedule, bind, seed, part(shares.registration, "stage 1, registration"))
    done += shares.registration
    light = registrar.light

    binding = bind(schedule.levels, schedule.depth)
    second = AppearanceFit(views, table, shape, binding, seed, raster)
    evidence = second.gather(light, schedule.gather_side, schedule.gather_frames)
    appearance = Appearance.plain(binding.count, light, schedule.harmonics)
    appearance.albedo = fill_unseen(evidence, binding, 0.5)
    looks = _Looks(second, appearance, show)
    for step, share in zip(schedule.appearance, shares.appearance, strict=True):
        second.run(appearance, step, progress=looks.beside(part(share, f"stage 2 at {step.side} px")))
        done += share

    _place_heldout(views, table, start)
    heldout = [row for row, view in enumerate(views) if view.heldout]
    if heldout:
        outline = bind(1, 0)
        for turn in schedule.heldout:
            registrar.step(turn, outline, Appearance.plain(outline.count, light), heldout)

    kept = _keep(evidence, binding, model)
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


def _register(
    registrar: Registrar,
    schedule: Schedule,
    bind: Callable[[int, int], MeshBinding],
    seed: int,
    progress: Callable[[float], None],
) -> None:
    """Registration by outline, then, when texture takes part, a sweep and registration with it."""
    total = len(schedule.outline) + 2 * len(schedule.texture) + 4
    fit = registrar
    coarse = bind(1, 0)
    for done, turn in enumerate(schedule.outline):
        fit.step(turn, coarse, Appearance.plain(coarse.count, fit.light))
        progress((done + 1) / total)
    if not schedule.texture:
        return
    fine = bind(1, 1)
    gatherer = AppearanceFit(fit.views, fit.table, fit.shape, fine, seed, fit.raster)
    fit.sweep(SWEEP, fine, gatherer.colors_of)
    for done, turn in enumerate(schedule.texture):
        progress((len(schedule.outline) + 4 + 2 * done) / total)
        look = Appearance.plain(fine.count, fit.light)
        look.albedo = fill_unseen(gatherer.gather(fit.light, turn.side, REGISTRATION_FRAMES), fine, 0.5)
        fit.step(turn, fine, look)


class _Looks:
    """Small pictures of the clearest frame on white, a tenth of a pass apart."""

    def __init__(self, fit: AppearanceFit, appearance: Appearance, show: Show | None) -> None:
        self._fit, self._appearance, self._show = fit, appearance, show
        best = _best_frame(fit.views)
        self._row = next(row for row, view in enumerate(fit.views) if view.index == best)

    def beside(self, progress: Callable[[float], None]) -> Callable[[float], None]:
        """``progress``, with a look whenever the next one is due."""
        due = 0.0

        def report(fraction: float) -> None:
            nonlocal due
            progress(fraction)
            if self._show is not None and fraction >= due:
                due = fraction + 0.1
                self._show(self._picture())

        return report

    def _picture(self) -> NDArray[np.uint8]:
        fit, camera = self._fit, self._fit.views[self._row].level(LOOK_SIDE).camera
        with torch.no_grad():
            surfels = fit.surfels(self._row)
            white = torch.ones(3)
            out = render_row(self._appearance, surfels, 0, fit.binding.bones, camera, fit.raster, white)
            picture: NDArray[np.uint8] = (255 * out.rgb.clamp(0, 1)).round().to(torch.uint8).numpy()
        return picture


@dataclass(frozen=True)
class _Shares:
    geometry: list[float]
    registration: float
    appearance: list[float]


def _shares(schedule: Schedule) -> _Shares:
    """How the time divides over the passes: by pixels and visits, with a constant part a step."""
    first = [stage.visits * (60.0**2 + stage.side**2) for stage in schedule.geometry]
    turns = [3.0 * (60.0**2 + turn.side**2) for turn in (*schedule.outline, *schedule.texture)]
    second = [stage.visits * 2 * (60.0**2 + stage.side**2) for stage in schedule.appearance]
    total = sum(first) + sum(turns) + sum(second)
    return _Shares(
        [value / total for value in first], sum(turns) / total, [value / total for value in second]
    )


def _keep(evidence: Evidence, binding: MeshBinding, model: HandModel) -> Tensor:
    """Surfels to keep: the hand ends where the clip shows it to end (a sleeve, a watch, the frame).

    Around the wrist a plane is put between what was seen as hand and what was seen as forearm or background
    (logistic regression on rest positions, weighted by evidence); all beyond it goes, seen or not.
    """
    with torch.no_grad():
        places = binding.surfels(model.template).means
    along = places[:, 0] - model.joint_template[0, 0]
    along = along if model.side == "right" else -along  # the forearm's axis, outward
    wrist = along > -WRIST_REACH
    hand = evidence.hand[wrist]
    other = (FOREARM_WEIGHT * evidence.ignored + BACKGROUND_WEIGHT * evidence.background)[wrist]
    if float(other.sum()) < 0.01 * float(hand.sum()):
        return torch.arange(binding.count)
    centered = (places[wrist] - places[wrist].mean(0)) / (2 * WRIST_REACH)
    plane = torch.zeros(4, requires_grad=True)
    optimizer = torch.optim.LBFGS([plane], max_iter=60, line_search_fn="strong_wolfe")
    total = (hand + other).sum()

    def closure() -> Tensor:
        optimizer.zero_grad()
        score = 20 * (centered @ plane[:3] + plane[3])
        softplus = torch.nn.functional.softplus
        loss = (hand * softplus(-score) + other * softplus(score)).sum() / total + 1e-3 * plane.square().sum()
        loss.backward()
        return loss

    optimizer.step(closure)
    with torch.no_grad():
        keep = torch.ones(binding.count, dtype=torch.bool)
        keep[wrist] = centered @ plane[:3] + plane[3] > 0
    return keep.nonzero()[:, 0]


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
