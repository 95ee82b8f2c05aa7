"""From the registered mesh to the surfels of the avatar: how many, what of them moves, which stay."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from mass_engine.deform.hashgrid import HashGridConfig
from mass_engine.deform.network import DeformationConfig
from mass_engine.fitting import capacity
from mass_engine.fitting.components import Components
from mass_engine.fitting.evidence import Evidence, Scene, fill_unseen, frame_gains, gather, spread
from mass_engine.fitting.schedule import Schedule
from mass_engine.fitting.skin import Skin
from mass_engine.fitting.state import FitState
from mass_engine.fitting.subject import Appearance
from mass_engine.fitting.surfel_fit import SurfelFit, rounded
from mass_engine.surfel.binding import MeshBinding

#: How far into the hand from its wrist joint it may be cut, metres at the mean size.
WRIST_REACH = 0.03
#: What a pixel of background, and of forearm, counts against one of hand when the wrist is cut. A sleeve
#: that slides shows in one frame what it hides in another: the hand ends where it was never seen.
BACKGROUND_WEIGHT, FOREARM_WEIGHT = 0.2, 0.004
#: Hash levels tried, fewest first; each more only if it gains.
HASH_LEVELS = (2, 6)
#: Rounds of frame gains and the colours under them.
GAIN_ROUNDS = 2
#: Of what is seen of a surfel that may settle, this share at most is ignored.
MOST_IGNORED = 0.05
#: Surfels under this opacity in every frame are nothing.
LEAST_OPACITY = 0.02

Bind = Callable[[int, int, bool], MeshBinding]


def convert(
    state: FitState,
    scene: Scene,
    schedule: Schedule,
    components: Components,
    bind: Bind,
    light: Tensor,
    progress: Callable[[float], None],
) -> None:
    """Surfels and their first colours into ``state``; ``light`` [9,3] is the clip's."""
    thinned = schedule.adaptive and schedule.depth > 0
    skin = Skin.attached(bind(schedule.levels, schedule.depth, thinned))
    rows = spread(scene.trained, schedule.gather_frames)
    evidence = gather(scene, skin, light, schedule.gather_side, rows, progress)
    if components.exposure == "on" or bool((scene.gains != 1).any()):
        for _ in range(GAIN_ROUNDS):
            look = Appearance.plain(skin.count, light)
            look.albedo = fill_unseen(evidence, skin, capacity.UNSEEN)
            scene.gains = scene.gains * frame_gains(scene, skin, look, 320)
            evidence = gather(scene, skin, light, schedule.gather_side, rows)
    harmonics = schedule.harmonics
    chosen: dict[str, object] = {"levels": schedule.levels, "depth": schedule.depth}
    if thinned:
        pixels = capacity.best_pixels(scene, skin, schedule.gather_side)
        skin, evidence, chosen["faces_thinned"] = capacity.thin(skin, evidence, pixels)
    if schedule.adaptive:
        degrees = capacity.view_spread(scene)
        harmonics = capacity.harmonics_for(degrees, schedule.harmonics)
        chosen["view_spread_degrees"] = round(degrees, 1)
    chosen["harmonics"] = harmonics
    chosen["attached"] = skin.count
    if schedule.detached:
        # The inellipses of whole faces; those in the corners fill gaps that detached surfels do not leave.
        place = skin.sources % skin.binding.per_face
        whole = place == 0
        if thinned:
            whole |= place == skin.binding.per_face - 1
        if schedule.adaptive:
            whole &= evidence.hand >= capacity.UNSEEN
        evidence = _extended(evidence, whole)
        skin = skin.with_detached(skin.sources[whole])
    chosen["detached"] = len(skin.detached)
    appearance = Appearance.plain(skin.count, light, harmonics)
    appearance.albedo = fill_unseen(evidence, skin, capacity.UNSEEN)
    state.skin, state.appearance, state.evidence = skin, appearance, evidence
    state.notes["capacity"] = chosen


def deform_surfels(
    state: FitState,
    fitter: SurfelFit,
    schedule: Schedule,
    seed: int,
    progress: Callable[[float], None],
) -> None:
    """Stage one's last part: the detached surfels leave the mesh, if the validation frames gain by it.

    An adaptive schedule tries without them, then with ever more hash levels, and takes the least that gains:
    none, where there are no validation frames to show a gain. Others take the finest.
    """
    skin, appearance = state.surfels()
    levels = _hash_levels(schedule, fitter)
    tried: list[dict[str, float | None]] = []
    best = (-math.inf, 0, skin, appearance)
    for number, count in enumerate(levels):
        moved, look = _candidate(state, skin, appearance, count, seed)
        reached = math.nan
        for turn, stage in enumerate(schedule.deforming):
            reached = fitter.run(moved, look, stage, seed * 1009 + 50 + turn).after
        progress((number + 1) / len(levels))
        tried.append({"hash_levels": count, "validation": rounded(reached)})
        if number and not reached >= best[0] + capacity.DEFORMATION_GAIN:
            break
        best = (reached, count, moved, look)
    _, count, state.skin, state.appearance = best
    if count == 0 and state.evidence is not None:
        state.evidence = _rows(state.evidence, torch.arange(state.skin.count))
    state.notes["deformation"] = {"tried": tried, "hash_levels": count}
    state.notes["capacity"]["detached"] = len(state.skin.detached)


def _hash_levels(schedule: Schedule, fitter: SurfelFit) -> tuple[int, ...]:
    """What to try, in order; 0 is without detached surfels."""
    if not schedule.adaptive:
        return HASH_LEVELS[-1:]
    return (0, *HASH_LEVELS) if fitter.scene.validation else (0,)


def _candidate(
    state: FitState, skin: Skin, appearance: Appearance, levels: int, seed: int
) -> tuple[Skin, Appearance]:
    """Copies to try: with a deformation of so many hash levels, or (0) without detached surfels."""
    if levels == 0:
        return _without_detached(skin, appearance)
    config = DeformationConfig(HashGridConfig(levels=levels))
    moved = replace(skin, deformation=skin.new_deformation(state.shape.model, config, seed * 1009 + levels))
    return moved, _copy(appearance)


def finish(state: FitState, evidence: Evidence, scene: Scene) -> tuple[tuple[Skin, Appearance], int]:
    """Cut the hand at the wrist and drop surfels that never show; also returns how many were cut."""
    skin, appearance = state.surfels()
    with torch.no_grad():
        places = skin.binding.surfels(state.shape.model.template).means[skin.sources]
    kept = inside_wrist(evidence, places, state.shape.model.joint_template[0, 0], state.shape.model.side)
    trimmed = int((~kept).sum())
    opacity = torch.sigmoid(appearance.opacity_logits)
    if skin.deformation is not None:
        most = torch.zeros(len(skin.detached))
        for row in spread(scene.trained, capacity.SAMPLED_FRAMES):
            with torch.no_grad():
                mask = scene.surfels(skin, row).mask
            if mask is not None:
                most = torch.maximum(most, mask[0, skin.detached_from :])
        opacity = torch.cat([opacity[: skin.detached_from], opacity[skin.detached_from :] * most])
    kept &= opacity >= LEAST_OPACITY
    state.notes.setdefault("capacity", {})["transparent_dropped"] = int(len(kept) - trimmed - kept.sum())
    final = Appearance(
        appearance.albedo[kept], appearance.opacity_logits[kept], appearance.sh[kept], appearance.light
    )
    return (skin.pick(kept, state.shape.model), final), trimmed


def may_settle(evidence: Evidence, skin: Skin) -> Tensor:
    """Which attached surfels (bool [A]) may leave the mesh a little: not those beside what is ignored.

    There (a sleeve, the forearm) one frame sees as hand what another does not: surfels would turn away.
    """
    hand, ignored = evidence.hand[: skin.detached_from], evidence.ignored[: skin.detached_from]
    return ignored <= MOST_IGNORED * (hand + ignored)


def inside_wrist(evidence: Evidence, places: Tensor, wrist_x: Tensor, side: str) -> Tensor:
    """Which surfels (bool [N]) to keep: the hand ends where the clip shows it to end (a sleeve, a watch, the
    frame).

    Around the wrist a plane is put between what was seen as hand and what was seen as forearm or background
    (logistic regression on rest positions ``places`` [N,3], weighted by evidence); all beyond it goes, seen
    or not.
    """
    along = places[:, 0] - wrist_x
    along = along if side == "right" else -along  # the forearm's axis, outward
    wrist = along > -WRIST_REACH
    hand = evidence.hand[wrist]
    other = (FOREARM_WEIGHT * evidence.ignored + BACKGROUND_WEIGHT * evidence.background)[wrist]
    keep = torch.ones(len(places), dtype=torch.bool)
    if float(other.sum()) < 0.01 * float(hand.sum()):
        return keep
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
        keep[wrist] = centered @ plane[:3] + plane[3] > 0
    return keep


def _without_detached(skin: Skin, appearance: Appearance) -> tuple[Skin, Appearance]:
    count = skin.detached_from
    look = Appearance(
        appearance.albedo[:count].clone(),
        appearance.opacity_logits[:count].clone(),
        appearance.sh[:count].clone(),
        appearance.light.clone(),
    )
    return Skin(skin.binding, skin.sources[:count], count, static=skin.static), look


def _copy(appearance: Appearance) -> Appearance:
    look = appearance
    return Appearance(look.albedo.clone(), look.opacity_logits.clone(), look.sh.clone(), look.light.clone())


def _extended(evidence: Evidence, copied: Tensor) -> Evidence:
    """The evidence of the surfels, then of copies of those ``copied`` (bool [N])."""
    return _rows(evidence, torch.cat([torch.arange(len(copied)), copied.nonzero()[:, 0]]))


def _rows(evidence: Evidence, rows: Tensor) -> Evidence:
    return Evidence(
        evidence.hand[rows], evidence.ignored[rows], evidence.background[rows], evidence.albedo[rows]
    )
