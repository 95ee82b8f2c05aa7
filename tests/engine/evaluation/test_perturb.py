"""Every perturbation does what its axis says, to training frames alone, and leaves the clip itself alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from mass_engine.avatar import SourceFrames
from mass_engine.camera import Camera
from mass_engine.evaluation.perturb import axes
from mass_engine.evaluation.stability import score
from mass_engine.fitting.subject import Shape, pose_surfels, render_row
from mass_engine.frame_choice import FrameChoice
from mass_engine.hand.builtin import load_builtin
from mass_engine.hand.pose import HandPose
from mass_engine.preprocess import Clip
from mass_engine.raster import RasterOptions, RenderOutput
from mass_engine.surfel.binding import MeshBinding
from mass_engine.tracking.segmentation import BACKGROUND, HAND, IGNORE
from mass_engine.video.reader import VideoInfo
from tests.engine.fitting.clips import CAMERA, make_views, painted, true_poses

FRAMES, HELD = 12, frozenset({3, 7})


@pytest.fixture(scope="module")
def clip() -> Clip:
    poses = true_poses(FRAMES)
    views = make_views(poses, heldout=HELD)
    info = VideoInfo(CAMERA.width, CAMERA.height, FRAMES, 30.0, FRAMES / 30, "h264", 0, None)
    choice = FrameChoice([], [], [], [], {})
    model = load_builtin("right")
    return Clip(info, CAMERA, "given", "builtin", model, views, poses, FRAMES, FRAMES, [], [], choice)


@pytest.mark.parametrize("axis", list(axes()))
def test_held_out_pictures_and_masks_stay_clean(clip: Clip, axis: str) -> None:
    before = [view.rgb.copy() for view in clip.views], [view.labels.copy() for view in clip.views]
    levels = axes()[axis]
    assert levels[0].value == 0.0
    assert levels[0].change(clip, np.random.default_rng(0)) is clip
    for level in levels[1:]:
        changed, again = (level.change(clip, np.random.default_rng(1)) for _ in range(2))
        held = {view.index: view for view in changed.views if view.heldout}
        assert held.keys() == HELD
        for index, view in held.items():
            np.testing.assert_array_equal(view.rgb, clip.views[index].rgb)
            np.testing.assert_array_equal(view.labels, clip.views[index].labels)
        assert len(changed.views) == len(changed.start.transl)
        assert bool(changed.start.transl.isfinite().all())
        for one, two in zip(changed.views, again.views, strict=True):  # the same seed, the same harm
            np.testing.assert_array_equal(one.rgb, two.rgb)
            np.testing.assert_array_equal(one.labels, two.labels)
    for view, rgb, labels in zip(clip.views, *before, strict=True):
        np.testing.assert_array_equal(view.rgb, rgb)
        np.testing.assert_array_equal(view.labels, labels)


def changed(clip: Clip, axis: str, level: str) -> Clip:
    one = next(one for one in axes()[axis] if one.name == level)
    return one.change(clip, np.random.default_rng(2))


def areas(clip: Clip) -> list[int]:
    return [int((view.labels == HAND).sum()) for view in clip.views if not view.heldout]


def test_masks(clip: Clip) -> None:
    for axis, level, smaller in (
        ("masks eroded, px", "2", True),
        ("masks dilated, px", "2", False),
        ("masks punched, holes", "5", True),
        ("occluders", "2", True),
    ):
        new = areas(changed(clip, axis, level))
        pairs = list(zip(new, areas(clip), strict=True))
        assert sum((a < b) if smaller else (a > b) for a, b in pairs) >= 0.9 * len(pairs), axis
    lost = [
        bool((view.labels == IGNORE).all()) for view in changed(clip, "masks missing, share", "0.5").views
    ]
    assert sum(lost) == 5
    labels = {int(v) for view in clip.views for v in np.unique(view.labels)}
    assert labels == {HAND, BACKGROUND}


def test_pictures(clip: Clip) -> None:
    blurred = changed(clip, "blur, px", "4").views[1].rgb
    assert (
        np.abs(np.diff(blurred.astype(float), axis=1)).mean()
        < 0.5 * np.abs(np.diff(clip.views[1].rgb.astype(float), axis=1)).mean()
    )
    drift = changed(clip, "exposure drift, stops", "2").views
    light = [view.rgb.mean() / old.rgb.mean() for view, old in zip(drift, clip.views, strict=True)]
    assert abs(light[0] - 1) < 0.01
    assert light[6] < 0.6
    given = next(level for level in axes()["exposure drift, stops"] if level.name == "2").gains(FRAMES)
    known = [row for row in range(FRAMES) if row not in HELD]
    np.testing.assert_allclose(np.array(light)[known], given[known], atol=0.01)
    assert all((level.gains(FRAMES) == 1).all() for level in axes()["blur, px"])


class Painted:
    """The clip's own hand, a little too dark."""

    camera = CAMERA

    def render_pose(self, pose: HandPose, camera: Camera) -> RenderOutput:
        binding = MeshBinding.build(load_builtin("right"), 1, 1)
        surfels = pose_surfels(Shape.mean(load_builtin("right"), torch.zeros(10)), binding, pose)
        options = RasterOptions(cull_backfaces=True)
        with torch.no_grad():
            out = render_row(painted(binding), surfels, 0, binding.bones, camera, options)
        return replace(out, rgb=0.97 * out.rgb)


def test_a_drift_is_scored_at_the_exposure_that_the_fit_found(clip: Clip) -> None:
    level = next(level for level in axes()["exposure drift, stops"] if level.name == "2")
    drifted = level.change(clip, np.random.default_rng(0))
    true = torch.from_numpy(level.gains(FRAMES)).float().unsqueeze(-1).expand(-1, 3)
    held = torch.tensor([view.heldout for view in clip.views])
    frames = SourceFrames(torch.arange(FRAMES), held, clip.start, true)
    steady = replace(frames, gains=torch.ones(FRAMES, 3))
    best = score(Painted(), steady, clip, axes()["exposure drift, stops"][0], 0)
    right = score(Painted(), frames, drifted, level, 0)
    wrong = score(Painted(), steady, drifted, level, 0)
    assert best[0] is not None
    assert best[0] > 25
    assert right == pytest.approx(best)
    assert wrong[0] is not None
    assert wrong[0] < best[0] - 10


def test_frames_and_poses(clip: Clip) -> None:
    assert len(changed(clip, "frames fitted", "5").views) == 5 + len(HELD)
    assert len(changed(clip, "frames dropped, share", "0.6").views) < FRAMES - 3
    fists = changed(clip, "only fists, share of frames", "0.25").views
    assert [view.index for view in fists if not view.heldout] == [10, 11]  # the clip closes its hand
    noisy = changed(clip, "pose noise, rad", "0.2")
    step = (noisy.start.hand_pose - clip.start.hand_pose).std()
    assert 0.15 < float(step) < 0.25
    assert all(view.at_joints for view in noisy.views)
    with torch.no_grad():
        pixels = clip.camera.project(clip.model.joints(noisy.start))
    np.testing.assert_allclose(noisy.views[4].points, pixels[4], atol=1e-3)


def test_camera_and_side(clip: Clip) -> None:
    wide = changed(clip, "field of view, factor", "1.6")
    with torch.no_grad():
        before = clip.camera.project(clip.model.joints(clip.start))
        after = wide.camera.project(wide.model.joints(wide.start))
    assert float((before - after).norm(dim=-1).mean()) < 3
    assert float(wide.start.transl[0, 2] / clip.start.transl[0, 2]) < 0.75
    wrong = changed(clip, "hand side", "wrong")
    assert wrong.model.side == wrong.start.side == "left"
    back, palm = (
        {view.index for view in changed(clip, "only one side seen", name).views if not view.heldout}
        for name in ("back", "palm")
    )
    assert not back & palm
    assert replace(clip).views is clip.views
