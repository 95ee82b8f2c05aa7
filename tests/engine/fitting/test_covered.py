"""Masks that call background what covers the hand: found, ignored, and told apart from a pose's faults."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from mass_engine.evaluation.scores import score_view
from mass_engine.fitting.covered import CoveredMasks, covered_pixels, ignoring
from mass_engine.fitting.evidence import Scene
from mass_engine.fitting.poses import PoseTable
from mass_engine.fitting.state import FitState
from mass_engine.fitting.subject import Shape
from mass_engine.fitting.trainer import FitResult, fit_hand
from mass_engine.fitting.views import Level, View
from mass_engine.hand.builtin import load_builtin
from mass_engine.raster import RasterOptions
from mass_engine.surfel.binding import MeshBinding
from mass_engine.surfel.shading import white_light
from mass_engine.tracking.segmentation import BACKGROUND, HAND, IGNORE
from tests.engine.fitting.clips import CAMERA, make_views, true_poses
from tests.engine.fitting.test_registration import perturbed
from tests.engine.fitting.test_trainer import HELDOUT, small_schedule

SIDE = 120
Mask = NDArray[np.bool_]


def level_of(hand: Mask) -> Level:
    camera = replace(CAMERA, width=SIDE, height=SIDE)
    cover = torch.from_numpy(hand).float()
    return Level(torch.zeros(SIDE, SIDE, 3), cover, torch.ones_like(cover), torch.ones_like(cover), camera)


def box(left: int, top: int, right: int, bottom: int) -> Mask:
    found = np.zeros((SIDE, SIDE), bool)
    found[top:bottom, left:right] = True
    return found


PALM = box(20, 20, 100, 100)
KNOWN = np.ones((SIDE, SIDE), bool)
NONE = np.zeros((0, 2), np.float32)


def test_a_thing_before_the_hand_is_covered_hand() -> None:
    thing = box(50, 50, 75, 70)
    marked = covered_pixels(level_of(PALM & ~thing), PALM, KNOWN, NONE, 5.0, 160.0)
    assert (marked & thing).sum() > 0.97 * thing.sum()
    assert not (marked & ~thing).any()  # what the mask calls hand is hand


def test_a_thing_over_the_rim_is_ignored_a_little_beyond_it() -> None:
    thing = box(80, 40, 115, 60)
    marked = covered_pixels(level_of(PALM & ~thing), PALM, KNOWN, NONE, 5.0, 160.0)
    assert (marked & thing & PALM).sum() > 0.95 * (thing & PALM).sum()
    assert marked[:, 101].any()
    assert not marked[:, 103:].any()


@pytest.mark.parametrize(
    ("mask", "drawn", "known"),
    [
        (PALM & ~box(55, 20, 63, 80), PALM, KNOWN),  # a gap between fingers that the render has closed
        (box(28, 20, 100, 100), PALM, KNOWN),  # an outline somewhat too far out
        (PALM & ~box(50, 50, 75, 70), PALM, ~KNOWN),  # what no other frame says is hand
        (PALM & ~box(50, 50, 75, 70), PALM & ~box(50, 50, 75, 70), KNOWN),  # the ring of thumb and finger
        (PALM | box(60, 0, 72, 20), PALM | box(40, 0, 52, 20), KNOWN),  # a finger beside its place
    ],
    ids=["gap", "rim", "unknown", "ring", "finger"],
)
def test_what_a_pose_may_have_wrong_stays(mask: Mask, drawn: Mask, known: Mask) -> None:
    assert not covered_pixels(level_of(mask), drawn, known, NONE, 5.0, 160.0).any()


def test_a_finger_elsewhere_is_told_from_a_finger_covered() -> None:
    palm, here, there = box(20, 50, 100, 110), box(30, 10, 50, 50), box(60, 10, 80, 50)
    known = KNOWN
    assert not covered_pixels(level_of(palm | there), palm | here, known, NONE, 5.0, 160.0).any()
    assert covered_pixels(level_of(palm), palm | here, known, NONE, 5.0, 160.0).any()
    joints = np.array([[40.0, 14.0], [40.0, 28.0], [40.0, 42.0]], np.float32)  # landmarks are elsewhere
    assert not covered_pixels(level_of(palm), palm | here, known, joints, 5.0, 160.0).any()
    assert covered_pixels(level_of(palm), palm | here, known, joints[:1], 5.0, 160.0).any()
    slim = box(30, 38, 50, 50)  # a finger that is bent: the render's is longer by less than its width
    assert not covered_pixels(level_of(palm), palm | slim, known, NONE, 5.0, 160.0).any()
    assert covered_pixels(level_of(palm), palm | slim, known, NONE, 3.5, 160.0).any()
    inner = np.array([[62.0, 60.0]], np.float32)  # no outline could hide that one
    assert covered_pixels(level_of(PALM & ~box(50, 50, 75, 70)), PALM, known, inner, 5.0, 160.0).any()
    far = np.array([[90.0, 90.0], [500.0, -3.0]], np.float32)
    assert covered_pixels(level_of(palm), palm | here, known, far, 5.0, 160.0).any()


def things_before(view: View, seed: int) -> View:
    """Two bars before the hand, in the picture's own colours: the mask alone tells of them."""
    random = np.random.default_rng(seed)
    labels = view.labels.copy()
    inside = np.argwhere(labels == HAND)
    for row, column in inside[random.integers(len(inside), size=2)]:
        corners = cv2.boxPoints(((float(column), float(row)), (30.0, 16.0), float(random.uniform(0, 180))))
        cv2.fillPoly(labels, [corners.astype(np.int32)], BACKGROUND)
    return replace(view, labels=labels, _levels={}, _outline=None)


def spoilt_views() -> list[View]:
    """Held-out ones are left as they are."""
    return [view if view.heldout else things_before(view, row) for row, view in enumerate(clean_views())]


def clean_views() -> list[View]:
    return make_views(true_poses(9), HELDOUT)


def looked_at(views: list[View]) -> tuple[CoveredMasks, Scene, FitState]:
    start, model = true_poses(9), load_builtin("right")
    state = FitState(
        PoseTable(start), Shape.mean(model, torch.zeros(10)), white_light(), torch.ones(len(views), 3)
    )
    scene = Scene(views, state.table, state.shape, RasterOptions(cull_backfaces=True), state.gains)
    return CoveredMasks(scene, state, CAMERA), scene, state


def bind(levels: int, depth: int, widened: bool) -> MeshBinding:
    return MeshBinding.build(load_builtin("right"), levels, depth, widened)


def test_covered_hand_is_ignored_in_training_frames_alone() -> None:
    views = spoilt_views()
    covered, scene, state = looked_at(views.copy())
    changed = covered.before("stage 1, sweep", bind)
    assert covered.before("stage 1, sweep", bind) == []  # nothing has moved
    truth = clean_views()
    found = missed = elsewhere = 0
    for row, view in enumerate(scene.views):
        got = view.labels != views[row].labels
        assert (view.labels[got] == IGNORE).all()
        assert got.any() == (row in changed)
        hidden = (truth[row].labels == HAND) & (views[row].labels == BACKGROUND)
        found += int((got & hidden).sum())
        missed += int((~got & hidden).sum())
        elsewhere += int((got & ~hidden).sum())
    assert not set(changed) & HELDOUT
    assert found > 4 * missed
    assert found > 4 * elsewhere
    share = state.notes["covered"]["stage 1, sweep"]
    assert share["frames"] == len(changed) > 4
    assert share["share_of_hand"] > 0.02


def test_good_masks_stay_as_they_are() -> None:
    covered, _, state = looked_at(clean_views())
    for step in ("stage 1, 96 px", "stage 1, outline", "stage 1, sweep", "conversion"):
        assert covered.before(step, bind) == []
    nothing = {"frames": 0, "pixels": 0, "share_of_hand": 0.0}
    assert all(look == nothing for look in state.notes["covered"].values())


def test_a_wrongly_ignored_region_is_given_back() -> None:
    covered, scene, state = looked_at(clean_views())
    wrong = np.zeros(scene.views[0].labels.shape, bool)
    wrong[60:80, 80:120] = True
    state.covered[0] = torch.from_numpy(np.packbits(wrong))
    covered.take_up()
    assert (scene.views[0].labels[wrong] == IGNORE).all()
    assert covered.before("conversion", bind) == [0]
    assert not (scene.views[0].labels == IGNORE).any()


def test_what_is_ignored_has_no_coverage() -> None:
    view = replace(clean_views()[0], coverage=np.full(clean_views()[0].labels.shape, 0.4, np.float32))
    view.level(80)
    spot = np.zeros(view.labels.shape, bool)
    spot[40:80, 60:100] = True
    changed = ignoring(view, spot)
    assert changed.coverage is not None
    assert not changed.coverage[spot].any()
    assert float(changed.level(80).valid.min()) == 0.0
    assert float(view.level(80).valid.min()) == 1.0


class _KilledError(Exception):
    """The power is gone."""


def run(views: list[View], checkpoint: Path | None = None, kill_at: str | None = None) -> FitResult:
    def progress(_: float, name: str) -> None:
        if name == kill_at:
            raise _KilledError

    start, model = perturbed(true_poses(9), 11, 0.05), load_builtin("right")
    schedule = replace(small_schedule(), validate_every=2, deforming=(), detached=False)
    return fit_hand(views, start, model, CAMERA, schedule, 0, progress, None, checkpoint)


def test_a_killed_fit_remembers_what_is_covered(tmp_path: Path) -> None:
    views = spoilt_views()
    labels = [view.labels.copy() for view in views]
    whole = run(views, tmp_path / "whole")
    assert all((view.labels == before).all() for view, before in zip(views, labels, strict=True))
    for step in ("stage 1, 160 px", "stage 1, texture 1", "stage 2, 200 px"):
        with pytest.raises(_KilledError):
            run(spoilt_views(), tmp_path / "killed", step)
    again = run(spoilt_views(), tmp_path / "killed")
    assert again.state.notes["resumed_after"] != again.state.steps[-1]
    assert again.state.notes["covered"] == whole.state.notes["covered"]
    assert whole.state.covered.keys() == again.state.covered.keys() != set()
    for row, bits in whole.state.covered.items():
        assert torch.equal(bits, again.state.covered[row])
    for name in ("albedo", "opacity_logits"):
        assert torch.equal(getattr(whole.avatar.appearance, name), getattr(again.avatar.appearance, name))
    assert torch.equal(whole.avatar.frames.pose.hand_pose, again.avatar.frames.pose.hand_pose)


def test_a_covered_hand_is_fitted_nearly_as_well() -> None:
    held = sorted(HELDOUT)

    def score(views: list[View]) -> float:
        avatar = run(views).avatar
        rows = [score_view(avatar, views[row], avatar.frames.pose_of(views[row].index)) for row in held]
        return min(row["psnr_in_mask"] for row in rows)

    assert score(spoilt_views()) > score(clean_views()) - 1.5  # 3.0 when nothing is ignored
