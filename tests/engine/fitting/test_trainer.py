"""The whole fit on a made-up clip: it finds the hand, and held-out pixels never reach the avatar."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from mass_engine.avatar import Avatar, row_pose
from mass_engine.deform.network import DeformationConfig
from mass_engine.evaluation.scores import score_view
from mass_engine.fitting.components import Components
from mass_engine.fitting.gauss_newton import Round
from mass_engine.fitting.looks import LOOK_SIDE, Show
from mass_engine.fitting.schedule import Schedule, schedule_for
from mass_engine.fitting.subject import Appearance, render_row
from mass_engine.fitting.trainer import FitResult, fit_hand
from mass_engine.fitting.views import View
from mass_engine.hand.builtin import load_builtin
from mass_engine.raster import RasterOptions
from mass_engine.surfel.shading import white_light
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
        deforming=tuple(replace(stage, side=200) for stage in whole.deforming),
        appearance=tuple(replace(stage, side=200, visits=2) for stage in whole.appearance),
        heldout=whole.heldout[:2],
    )


def fitted(views: list[View], show: Show | None = None) -> FitResult:
    start = perturbed(true_poses(len(views)), 11, 0.05)
    model = load_builtin("right")
    return fit_hand(views, start, model, CAMERA, small_schedule(), 0, lambda *_: None, show=show)


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
    assert torch.equal(one.skin.sources, two.skin.sources)
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


class _KilledError(Exception):
    """The power is gone."""


def test_a_killed_fit_resumes_with_the_same_result(tmp_path: Path) -> None:
    schedule = replace(small_schedule(), validate_every=2)
    start = perturbed(true_poses(9), 11, 0.05)
    model = load_builtin("right")

    def run(checkpoint: Path, kill_at: str | None) -> FitResult:
        def progress(_: float, name: str) -> None:
            if name == kill_at:
                raise _KilledError

        views = make_views(true_poses(9), HELDOUT)
        return fit_hand(views, start, model, CAMERA, schedule, 0, progress, None, checkpoint)

    whole = run(tmp_path / "whole", None)
    for step in ("stage 1, outline", "stage 1, texture 2", "conversion", "stage 2, 200 px", "held-out poses"):
        with pytest.raises(_KilledError):
            run(tmp_path / "killed", step)
    again = run(tmp_path / "killed", None)
    assert again.state.notes["resumed_after"] == "stage 2, all frames"
    assert whole.state.steps == again.state.steps
    one, two = whole.avatar, again.avatar
    for name in ("albedo", "opacity_logits", "sh", "light"):
        assert torch.equal(getattr(one.appearance, name), getattr(two.appearance, name)), name
    assert torch.equal(one.skin.sources, two.skin.sources)
    assert torch.equal(one.frames.pose.hand_pose, two.frames.pose.hand_pose)
    assert one.skin.static is not None
    assert two.skin.static is not None
    assert bool(one.skin.static.offset.any())
    for name, value in one.skin.static.tensors().items():
        assert torch.equal(value, two.skin.static.tensors()[name]), name
    if one.skin.deformation is not None:
        assert two.skin.deformation is not None
        for name, value in one.skin.deformation.tensors().items():
            assert torch.equal(value, two.skin.deformation.tensors()[name]), name


def test_the_checkpoint_of_another_fit_is_not_taken(tmp_path: Path) -> None:
    file = tmp_path / "checkpoint"
    schedule = replace(small_schedule(), texture=(), deforming=(), detached=False)
    start = perturbed(true_poses(9), 11, 0.05)

    def run(seed: int) -> FitResult:
        views = make_views(true_poses(9), HELDOUT)
        return fit_hand(
            views, start, load_builtin("right"), CAMERA, schedule, seed, lambda *_: None, None, file
        )

    run(0)
    assert "resumed_after" not in run(1).state.notes
    assert "resumed_after" in run(1).state.notes
    file.write_bytes(b"torn")
    assert "resumed_after" not in run(1).state.notes


@pytest.mark.parametrize(
    "parts",
    [
        Components(densify=False),
        Components(detached=False),
        Components(deform=False),
        Components(binding="none"),
        Components(binding="paper"),
        Components(levels=0),
        Components(refine_pose=False),
        Components(exposure=True),
        Components(shading=False),
        Components(harmonics=False),
        Components(settle=False),
    ],
    ids=str,
)
def test_every_part_can_be_switched_off(parts: Components) -> None:
    whole = schedule_for("auto", parts)
    schedule = replace(
        whole,
        geometry=tuple(replace(stage, visits=1) for stage in whole.geometry),
        outline=whole.outline[:1],
        texture=(),
        deforming=tuple(replace(stage, side=200, visits=1) for stage in whole.deforming),
        appearance=tuple(replace(stage, side=200, visits=1) for stage in whole.appearance),
        heldout=whole.heldout[:1],
        validate_every=2,
        adaptive=False,
    )
    views = make_views(true_poses(6), frozenset({3}))
    start = perturbed(true_poses(6), 5, 0.02)
    result = fit_hand(views, start, load_builtin("right"), CAMERA, schedule, 0, lambda *_: None, parts)
    avatar, binding = result.avatar, result.avatar.skin.binding
    assert (binding.depth == 0) == (not parts.densify)
    assert binding.levels == (1 if parts.levels is None else parts.levels)
    assert (len(avatar.skin.detached) > 0) == parts.detached
    assert (avatar.skin.deformation is not None) == (parts.detached and parts.deform)
    assert torch.equal(avatar.frames.pose.hand_pose, start.hand_pose) == (not parts.refine_pose)
    assert bool((avatar.frames.gains != 1).any()) == (parts.exposure == "on")
    assert torch.equal(avatar.appearance.light, white_light()) == (not parts.shading)
    assert (avatar.appearance.sh.shape[1] > 0) == parts.harmonics
    assert (avatar.skin.static is not None and bool(avatar.skin.static.offset.any())) == parts.settle


def test_without_validation_frames_nothing_leaves_the_mesh() -> None:
    result = fitted(make_views(true_poses(9), HELDOUT))
    notes = result.state.notes
    assert notes["deformation"] == {"tried": [{"hash_levels": 0, "validation": None}], "hash_levels": 0}
    assert notes["capacity"]["detached"] == len(result.avatar.skin.detached) == 0
    assert result.avatar.skin.deformation is None
    json.dumps(notes, allow_nan=False)


def test_an_avatar_with_detached_surfels_survives_its_file(tmp_path: Path) -> None:
    avatar = fitted(make_views(true_poses(9), HELDOUT)).avatar
    assert avatar.skin.static is not None
    assert bool(avatar.skin.static.rotation.any())
    skin = avatar.skin.with_detached(avatar.skin.sources[:500])
    skin.static = avatar.skin.static
    skin.deformation = skin.new_deformation(avatar.shape.model, DeformationConfig(), 3)
    with torch.no_grad():
        skin.deformation.head.normal_(std=0.3, generator=torch.Generator().manual_seed(1))
    look = avatar.appearance
    rows = torch.cat([torch.arange(avatar.skin.detached_from), torch.arange(500)])
    changed = Appearance(look.albedo[rows], look.opacity_logits[rows], look.sh[rows], look.light)
    avatar = replace(avatar, skin=skin, appearance=changed)
    avatar.save(tmp_path / "avatar.safetensors")
    loaded = Avatar.load(tmp_path / "avatar.safetensors")
    pose = avatar.resolve_pose("fist")
    one, two = (a.render_pose(pose, CAMERA).rgb for a in (avatar, loaded))
    assert float((one - two).abs().max()) < 1e-5
    expected = render_row(
        changed, avatar.posed(pose), 0, skin.bones, CAMERA, RasterOptions(cull_backfaces=True)
    )
    assert float((one - expected.rgb).abs().mean()) < 1e-4
