"""The whole fit on a made-up clip: it finds the hand, and held-out pixels never reach the avatar."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from mass_engine.avatar import row_pose
from mass_engine.evaluation.scores import score_view
from mass_engine.fitting.gauss_newton import Round
from mass_engine.fitting.trainer import LOOK_SIDE, FitResult, Schedule, Show, fit_hand, schedule_for
from mass_engine.fitting.views import View
from mass_engine.hand.builtin import load_builtin
from tests.engine.fitting.clips import CAMERA, make_views, true_poses
from tests.engine.fitting.test_registration import perturbed

HELDOUT = frozenset({3, 7})


def small_schedule() -> Schedule:
    """The steps of the default preset, a few of each."""
    whole = schedule_for("auto")
    return replace(
        whole,
        geometry=tuple(replace(stage, visits=4) for stage in whole.geometry),
        outline=whole.outline[3:5],
        texture=(Round(200, offsets=False), Round(200, betas=False)),
        appearance=tuple(replace(stage, side=200) for stage in whole.appearance),
        heldout=whole.heldout[:2],
    )


def fitted(views: list[View], show: Show | None = None) -> FitResult:
    start = perturbed(true_poses(len(views)), 11, 0.05)
    return fit_hand(views, start, load_builtin("right"), CAMERA, small_schedule(), 0, lambda *_: None, show)


def test_changing_heldout_pixels_changes_no_bit_of_the_avatar() -> None:
    views = make_views(true_poses(9), HELDOUT)
    other = make_views(true_poses(9), HELDOUT)
    for row in HELDOUT:
        random = np.random.default_rng(row)
        other[row].rgb = random.integers(0, 255, other[row].rgb.shape, np.uint8)
    looks: list[NDArray[np.uint8]] = []
    one, two = fitted(views, looks.append).avatar, fitted(other).avatar
    assert 2 < len(looks) <= 11 * len(small_schedule().appearance)
    assert max(looks[-1].shape) <= LOOK_SIDE
    assert np.asarray((looks[-1] < 250).mean()) > 0.1  # the hand is there, on white
    for name in ("albedo", "opacity_logits", "sh", "light"):
        assert torch.equal(getattr(one.appearance, name), getattr(two.appearance, name)), name
    assert torch.equal(one.kept, two.kept)
    assert torch.equal(one.shape.betas, two.shape.betas)
    assert torch.equal(one.shape.displacement, two.shape.displacement)
    for name in ("global_orient", "hand_pose", "transl"):
        assert torch.equal(getattr(one.frames.pose, name), getattr(two.frames.pose, name)), name


def test_changing_a_training_pixel_does_change_it() -> None:
    views, other = make_views(true_poses(9), HELDOUT), make_views(true_poses(9), HELDOUT)
    other[4].rgb = 255 - other[4].rgb
    one, two = fitted(views).avatar, fitted(other).avatar
    assert not torch.equal(one.appearance.albedo, two.appearance.albedo)


def test_heldout_frames_look_like_the_video() -> None:
    views = make_views(true_poses(9), HELDOUT)
    avatar = fitted(views).avatar
    scores = [score_view(avatar, views[row], row_pose(avatar.frames.pose, row)) for row in sorted(HELDOUT)]
    assert min(score["psnr_in_mask"] for score in scores) > 22
    assert min(score["silhouette_iou"] for score in scores) > 0.95
