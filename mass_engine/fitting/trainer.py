"""The fit of one hand: stage one, conversion at the final resolution, stage two, held-out poses."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from mass_engine.avatar import Avatar, SourceFrames
from mass_engine.camera import Camera
from mass_engine.deform.static import StaticResiduals
from mass_engine.device import Precision
from mass_engine.fitting.components import Components
from mass_engine.fitting.conversion import convert, deform_surfels, finish, may_settle
from mass_engine.fitting.covered import LOOKS, CoveredMasks
from mass_engine.fitting.evidence import Evidence, Scene, colors_of, fill_unseen, gather, spread
from mass_engine.fitting.exposure import find_drift
from mass_engine.fitting.gauss_newton import Registrar, Round
from mass_engine.fitting.geometry import GeometryFit, GeometryPass
from mass_engine.fitting.heldout_poses import place_heldout
from mass_engine.fitting.looks import Looks, Show
from mass_engine.fitting.poses import PoseTable
from mass_engine.fitting.schedule import SWEEP, Schedule
from mass_engine.fitting.skin import Skin
from mass_engine.fitting.state import FitState, fingerprint_of
from mass_engine.fitting.steadying import jitter, steadied
from mass_engine.fitting.subject import Appearance, Shape
from mass_engine.fitting.surfel_fit import SurfelFit, SurfelPass, SurfelWeights
from mass_engine.fitting.sweep import sweep
from mass_engine.fitting.views import View
from mass_engine.hand.model import HandModel
from mass_engine.hand.pose import HandPose
from mass_engine.raster import RasterOptions
from mass_engine.surfel.binding import MeshBinding
from mass_engine.surfel.shading import white_light
from mass_engine.threads import one_thread

#: Frames whose mean texture the others are registered against.
REGISTRATION_FRAMES = 100
#: Registration ends when the validation frames' pull falls by less than this share in two rounds.
LEAST_FALL = 0.01

#: Loop levels and fractal depth of the surfels that texture is registered with.
REGISTERED = (1, 1)
#: Rounds in which the surface settles under surfels of another resolution.
SETTLING = 2

Progressed = Callable[[float], None]


@dataclass(frozen=True)
class FitResult:
    """The avatar and what the fit knows about itself; ``views`` are those given, with what covers the hand
    ignored."""

    avatar: Avatar
    state: FitState
    evidence: Evidence
    trimmed: int
    unseen: int
    views: list[View]


@dataclass
class Trainer:
    """Runs the steps of a schedule over one state; between two steps the state is all there is.

    The state is always on the CPU, and so is the registration, whose solver and contours are NumPy's and
    OpenCV's. Passes that draw surfels to gather their colours, or that move surfels, run on ``device``.
    """

    views: list[View]
    state: FitState
    camera: Camera
    schedule: Schedule
    components: Components
    seed: int
    start: HandPose
    show: Show | None = None
    device: torch.device = field(default_factory=lambda: torch.device("cpu"))
    precision: Precision = "float32"
    _bindings: dict[tuple[int, int, bool], MeshBinding] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.raster = RasterOptions(cull_backfaces=True)
        state = self.state
        self.views = list(self.views)  # what covers the hand is ignored in them, not in the caller's
        self.geometry = GeometryFit(self.views, state.table, state.shape, self.camera, self.seed, self.raster)
        self.registrar = Registrar(
            self.views, state.table, state.shape, self.camera, self.raster, shading=self.components.shading
        )
        trained = [row for row, view in enumerate(self.views) if not view.heldout]
        every = self.schedule.validate_every
        # Too few frames to give any away: then nothing is validated, and nothing stops early.
        validation = trained[every // 2 :: every] if len(trained) >= 3 * every else []
        self.scene = Scene(
            self.views, state.table, state.shape, self.raster, state.gains, validation, self.device
        )
        self.geometry.gains = self.registrar.gains = state.gains
        self.covered = CoveredMasks(self.scene, state, self.camera)

    def bind(self, levels: int, depth: int, widened: bool = False) -> MeshBinding:
        """A binding of the hand's mesh (kept for the next call)."""
        key = levels, depth, widened
        if key not in self._bindings:
            self._bindings[key] = MeshBinding.build(self.state.shape.model, *key)
        return self._bindings[key]

    def steps(self) -> list[tuple[str, float, Callable[[Progressed], None]]]:
        """Name, usual share of the time and work of every step, in order."""
        s = self.schedule
        steps: list[tuple[str, float, Callable[[Progressed], None]]] = [
            (
                f"stage 1, {early.side} px",
                early.visits * (60.0**2 + early.side**2),
                lambda p, turn=early: self._geometry(turn, p),  # type: ignore[misc]
            )
            for early in s.geometry
        ]
        if s.outline:
            cost = sum(_cost(turn) for turn in s.outline)
            steps.append(("stage 1, outline", cost, self._outline))
        if s.texture:
            steps.append(("stage 1, sweep", 3 * _cost(SWEEP[-1]), self._sweep))
        for number, turn in enumerate(s.texture):
            name = f"stage 1, texture {number + 1}"
            steps.append((name, 2 * _cost(turn), lambda p, turn=turn: self._texture(turn, p)))  # type: ignore[misc]
        steps.append(("conversion", 4.0 * s.gather_side**2, self._convert))
        if s.deforming:
            cost = sum(_visit_cost(turn) for turn in s.deforming)
            steps.append(("stage 1, deformation", cost, self._deform))
        for number, part in enumerate(s.appearance):
            name = f"stage 2, {part.side} px"
            steps.append(
                (name, _visit_cost(part), lambda p, part=part, n=number: self._appearance(part, n, p))  # type: ignore[misc]
            )
        if self.scene.validation and s.appearance:
            steps.append(("stage 2, all frames", 0.3 * _visit_cost(s.appearance[-1]), self._fold_back))
        if any(view.heldout for view in self.views):
            steps.append(("held-out poses", sum(_cost(turn) for turn in s.heldout) / 7, self._heldout))
        return steps

    def run(self, progress: Callable[[float, str], None], checkpoint: Path | None) -> None:
        """Every step that the state has not behind it."""
        steps = self.steps()
        prints = self._fingerprints() if checkpoint is not None else ("", "")
        if checkpoint is not None and self.state.load(checkpoint, prints):
            self.registrar.light = self.state.light
            self.scene.gains = self.registrar.gains = self.geometry.gains = self.state.gains
            self.registrar.memory = self.state.memory or self.registrar.memory
            self.state.notes["resumed_after"] = self.state.steps[-1]
            self.covered.take_up()
        total, done = sum(share for _, share, _ in steps), 0.0
        seconds = self.state.notes.setdefault("seconds", {})
        for number, (name, share, work) in enumerate(steps):
            if number >= len(self.state.steps):
                begin, started, undone = done / total, time.perf_counter(), self.registrar.undone
                progress(begin, name)
                self.registrar.forget(self.covered.before(name, self.bind))
                work(lambda f, b=begin, s=share, n=name: progress(b + s / total * f, n))  # type: ignore[misc]
                seconds[name] = round(seconds.get(name, 0.0) + time.perf_counter() - started, 2)
                taken_back = self.state.notes.get("poses_taken_back", 0) + self.registrar.undone - undone
                self.state.notes["poses_taken_back"] = taken_back
                self.state.steps.append(name)
                if checkpoint is not None:
                    self.state.light, self.state.gains = self.registrar.light, self.scene.gains
                    self.state.memory = self.registrar.memory
                    self.state.save(checkpoint, prints)
            done += share

    def _fingerprints(self) -> tuple[str, str]:
        """Of what the registration depends on, and of everything."""
        s, parts = self.schedule, self.components
        early = f"{s.geometry} {s.outline} {s.texture} {s.validate_every} {parts.shading} {self.seed} "
        early += f"{parts.exposure} {LOOKS}"
        start = fingerprint_of(self.views, self.start.hand_pose, early)
        return start, fingerprint_of([], self.start.hand_pose, f"{start} {s} {parts}")

    def _count(self, undone: int) -> None:
        self.state.notes["undone_steps"] = self.state.notes.get("undone_steps", 0) + undone

    def _geometry(self, turn: GeometryPass, progress: Progressed) -> None:
        coarse = self.bind(turn.levels, turn.depth)
        look = Appearance.plain(coarse.count, white_light())
        if turn.color:
            skin = Skin.attached(coarse)
            seen = gather(self.scene, skin, look.light, turn.side, spread(self.scene.trained, 40))
            look.albedo = fill_unseen(seen, skin, 0.5)
        before = self.geometry.undone
        self.geometry.run(turn, coarse, look, progress)
        self._count(self.geometry.undone - before)

    def _outline(self, progress: Progressed) -> None:
        coarse = self.bind(1, 0)
        for done, turn in enumerate(self.schedule.outline):
            self.registrar.step(turn, coarse, Appearance.plain(coarse.count, self.registrar.light))
            progress((done + 1) / len(self.schedule.outline))

    def _sweep(self, progress: Progressed) -> None:
        skin = Skin.attached(self.bind(*REGISTERED))
        look = Appearance.plain(skin.count, white_light())
        sweep(
            self.registrar,
            SWEEP,
            skin.binding,
            lambda row: colors_of(self.scene, skin, row),
            lambda rows: self.scene.overlaps(skin, look, rows),
            progress,
        )

    def _texture(self, turn: Round, progress: Progressed) -> None:
        pulls = self.state.notes.setdefault("pull_pixels", [])
        same = [entry for entry in pulls if entry["side"] == turn.side]
        if len(same) >= 3 and same[-1]["validation"] > (1 - LEAST_FALL) * same[-3]["validation"]:
            return  # it has stopped falling
        pull = self._register(turn, Skin.attached(self.bind(*REGISTERED)), progress)
        trained = [row for row, view in enumerate(self.views) if not view.heldout]
        watched = [trained.index(row) for row in self.scene.validation] or list(range(len(trained)))
        pulls.append(
            {
                "side": turn.side,
                "training": round(float(pull.mean()), 4),
                "validation": round(float(pull[watched].mean()), 4),
            }
        )

    def _register(self, turn: Round, skin: Skin, progress: Progressed) -> Tensor:
        """One round against the texture as it is now; the pull of every training row [B]."""
        fit = self.registrar
        rows = spread(self.scene.trained, REGISTRATION_FRAMES)
        look = Appearance.plain(skin.count, fit.light)
        seen = gather(self.scene, skin, fit.light, turn.side, rows, lambda f: progress(0.5 * f))
        look.albedo = fill_unseen(seen, skin, 0.5)
        return fit.step(turn, skin.binding, look)

    def _convert(self, progress: Progressed) -> None:
        final = self.bind(self.schedule.levels, self.schedule.depth)
        if self.schedule.texture and (final.levels, final.depth) != REGISTERED:
            # Other surfels stand otherwise over the mesh's outline: the surface settles under them.
            skin = Skin.attached(final)
            for turn in self.schedule.texture[-SETTLING:]:
                self._register(turn, skin, lambda _: None)
        convert(
            self.state, self.scene, self.schedule, self.components, self.bind, self.registrar.light, progress
        )

    def _fitter(self) -> SurfelFit:
        weights = SurfelWeights(binding=self.components.binding)
        return SurfelFit(self.scene, weights, self.components.shading, precision=self.precision)

    def _deform(self, progress: Progressed) -> None:
        fitter = self._fitter()
        deform_surfels(self.state, fitter, self.schedule, self.seed, progress)
        self._count(fitter.undone)

    def _appearance(self, part: SurfelPass, number: int, progress: Progressed) -> None:
        fitter = self._fitter()
        skin, appearance = self.state.surfels()
        if part.settle and skin.static is None and self.state.evidence is not None:
            skin.static = StaticResiduals.none(may_settle(self.state.evidence, skin))
        best = _best_frame(self.views)
        row = next(row for row, view in enumerate(self.views) if view.index == best)
        looks = Looks(self.scene, row, skin, appearance, self.show)
        seed = self.seed * 1009 + number + 1
        result = fitter.run(skin, appearance, part, seed, looks.beside(progress))
        self._count(fitter.undone)
        self.state.notes.setdefault("stage_two", []).append(result.summary(part.side))

    def _fold_back(self, progress: Progressed) -> None:
        """The validation frames, and as many others, once more at the last pass's final rate."""
        fitter = self._fitter()
        skin, appearance = self.state.surfels()
        rows = [*self.scene.validation, *spread(self.scene.trained, len(self.scene.validation))]
        last = self.schedule.appearance[-1].folded()
        fitter.run(skin, appearance, last, self.seed * 1009 + 99, progress, rows)
        self._count(fitter.undone)

    def _heldout(self, progress: Progressed) -> None:
        evidence = self.state.evidence
        if self.schedule.heldout and evidence is not None:  # otherwise poses are the tracker's, all of them
            # The finished hand ends at the wrist: one that a wrong pose shows from behind is open there.
            (skin, look), _ = finish(self.state, evidence, self.scene)
            place_heldout(
                self.registrar,
                self.schedule.heldout,
                self.bind(1, 0),
                self.start,
                lambda rows: self.scene.overlaps(skin, look, rows, 320),
            )
        progress(1.0)


def fit_hand(
    views: list[View],
    start: HandPose,
    model: HandModel,
    camera: Camera,
    schedule: Schedule,
    seed: int,
    progress: Callable[[float, str], None],
    components: Components | None = None,
    checkpoint: Path | None = None,
    show: Show | None = None,
    device: torch.device | None = None,
    precision: Precision = "float32",
) -> FitResult:
    """Fit one hand to ``views`` (in time order) from the poses ``start`` [F] with one shape.

    ``show`` gets a look at the hand now and then during stage two; the fit is the same with or without it.

    Held-out views give only their silhouette and landmarks, only to their own pose, and only after
    everything else is finished. With a ``checkpoint`` file every step is saved there; if the file holds
    steps of the same fit, it goes on after them, with the same result as if it had never stopped.
    ``device``: where passes over the surfels run (None: the CPU), with which ``precision`` on a GPU.
    """
    torch.manual_seed(seed)
    components = components or Components()
    noise = float(jitter(start).max())
    if components.refine_pose:
        start = steadied(start)
    gains, exposure = _exposure(views, start, model, camera, components.exposure)
    state = FitState(PoseTable(start), Shape.mean(model, start.betas[0]), white_light(), gains)
    device = device or torch.device("cpu")
    trainer = Trainer(views, state, camera, schedule, components, seed, start, show, device, precision)
    state.notes["start_jitter_radians"] = round(noise, 4)
    state.notes["exposure"] = exposure
    with one_thread():  # thousands of small operators; the rasteriser has threads of its own
        trainer.run(progress, checkpoint)
    evidence = state.evidence
    if evidence is None:
        raise RuntimeError("the fit ended before the conversion")
    kept, trimmed = finish(state, evidence, trainer.scene)
    skin, appearance = kept
    pose = state.table.pose(state.shape.betas)
    frames = SourceFrames(
        torch.tensor([view.index for view in views]),
        torch.tensor([view.heldout for view in views]),
        pose,
        trainer.scene.gains,
    )
    avatar = Avatar(state.shape, skin, appearance, camera, frames, _best_frame(views))
    return FitResult(avatar, state, evidence, trimmed, int((evidence.hand < 0.5).sum()), trainer.views)


def _exposure(
    views: list[View], start: HandPose, model: HandModel, camera: Camera, wanted: str | bool
) -> tuple[Tensor, dict[str, Any]]:
    """The gains [F,3] that a fit begins with (ones in steady light), and what the report says of them."""
    drift = None
    if wanted != "off":
        with one_thread():
            drift = find_drift(views, start, model, camera)
    if drift is None:
        return torch.ones(len(views), 3), {"drift_stops": None, "seen_in": None, "gains": False}
    taken = drift.certain or wanted == "on"
    gains = drift.gains if taken else torch.ones(len(views), 3)
    return gains, {"drift_stops": round(drift.stops, 3), "seen_in": drift.seen_in, "gains": taken}


def _cost(turn: Round) -> float:
    return 3.0 * (60.0**2 + turn.side**2)


def _visit_cost(turn: SurfelPass) -> float:
    return turn.visits * 2 * (60.0**2 + turn.side**2)


def _best_frame(views: list[View]) -> int:
    """The training frame whose hand covers most of the picture, at full confidence."""
    trained = [view for view in views if not view.heldout]
    return max(trained, key=lambda view: float((view.labels == 255).sum()) * view.score).index
