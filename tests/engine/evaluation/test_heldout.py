"""Scoring a finished run, and what test-time refinement may and may not do."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from mass_engine.avatar import Avatar, SourceFrames
from mass_engine.cli import main
from mass_engine.evaluation.heldout import FILE_NAME, REFINED, score_refined
from mass_engine.evaluation.refine import RefineOptions, refine_pose
from mass_engine.evaluation.scores import Frame, frames_of, mean_scores, score_view, score_view_fully
from mass_engine.fitting.kinematics import turned
from mass_engine.hand.pose import HandPose
from tests.engine.avatars import small_avatar
from tests.engine.fitting.clips import CAMERA, joint_error, make_views, painted, true_poses


def painted_avatar() -> Avatar:
    """The avatar that the views of ``make_views`` are pictures of."""
    from mass_engine.fitting.skin import Skin
    from mass_engine.hand.builtin import load_builtin
    from mass_engine.surfel.binding import MeshBinding

    binding = MeshBinding.build(load_builtin("right"), 1, 1)
    return replace(
        small_avatar(),
        skin=Skin.attached(binding),
        appearance=painted(binding),
        camera=CAMERA,
    )


def one(poses: HandPose, row: int) -> HandPose:
    rows = slice(row, row + 1)
    return HandPose(
        poses.betas[rows], poses.global_orient[rows], poses.hand_pose[rows], poses.transl[rows], poses.side
    )


def test_refinement_finds_the_pose_again_and_leaves_a_right_one_alone() -> None:
    poses = true_poses(3)
    view, truth, avatar = make_views(poses)[1], one(poses, 1), painted_avatar()
    random = torch.Generator().manual_seed(0)
    step = torch.cat([0.06 * torch.randn(48, generator=random), 0.002 * torch.randn(3, generator=random)])
    wrong = turned(truth, step[None])
    before = score_view(avatar, view, wrong)
    found = refine_pose(avatar, view, wrong)
    after = score_view(avatar, view, found)
    assert after["psnr_hand_on_black"] > before["psnr_hand_on_black"] + 3
    assert after["silhouette_iou"] > before["silhouette_iou"]
    assert float(joint_error(found, truth)) < 0.9 * float(joint_error(wrong, truth))
    right = refine_pose(avatar, view, truth, RefineOptions(sides=(128,), steps=1))
    assert score_view(avatar, view, right)["psnr_hand_on_black"] >= (
        score_view(avatar, view, truth)["psnr_hand_on_black"] - 1e-6
    )
    nothing = refine_pose(avatar, view, wrong, RefineOptions(steps=0))
    torch.testing.assert_close(nothing.hand_pose, wrong.hand_pose)


def test_a_look_at_a_small_picture_is_not_misled_by_the_renderers_filter() -> None:
    poses = true_poses(3)
    view, truth, avatar = make_views(poses)[1], one(poses, 1), painted_avatar()
    wrong = turned(truth, torch.full((1, 51), 0.004))
    found = refine_pose(avatar, view, wrong, RefineOptions(sides=(64,)))
    before, after = (score_view(avatar, view, pose)["psnr_hand_on_black"] for pose in (wrong, found))
    assert after > before + 1.0


def test_a_few_frames_have_a_second_figure() -> None:
    poses = true_poses(3)
    views, avatar = make_views(poses), painted_avatar()
    frames: list[Frame] = []
    for row, view in enumerate(views):
        wrong = turned(one(poses, row), torch.full((1, 51), 0.01))
        frames.append((avatar, view, wrong))
    told: list[float] = []
    found = score_refined(frames, 1, told.append)
    assert found.frames == [views[0].index]
    assert found.as_fitted == mean_scores([score_view(*frames[0])])
    before, after = found.as_fitted["psnr_hand_on_black"], found.metrics["psnr_hand_on_black"]
    assert before is not None
    assert after is not None
    assert after > before + 1
    assert found.cell() == f"{before:.2f} to {after:.2f}"
    assert told == [1.0]
    nothing = score_refined(frames, 0)
    assert nothing.frames == []
    assert nothing.cell() == ""
    assert score_refined([], 4) == nothing


def test_a_frame_is_compared_in_its_own_exposure() -> None:
    poses = true_poses(2)
    views, avatar = make_views(poses), painted_avatar()
    frames = SourceFrames(
        torch.tensor([view.index for view in views]),
        torch.zeros(2, dtype=torch.bool),
        poses,
        torch.tensor([[1.0, 1.0, 1.0], [0.5, 0.5, 0.5]]),
    )
    dimmed = replace(avatar, frames=frames)
    first, second = frames_of(dimmed, views)
    assert score_view(*first) == pytest.approx(score_view(avatar, views[0], one(poses, 0)), nan_ok=True)
    dark = replace(views[1], rgb=(views[1].rgb * 0.5).round().astype(np.uint8), _levels={})
    assert score_view(second[0], dark, second[2])["psnr_in_mask"] > 25
    assert score_view(avatar, dark, second[2])["psnr_in_mask"] < 20


def test_full_scores_hold_the_plain_ones_and_say_what_is_not_computed() -> None:
    poses = true_poses(2)
    view, avatar = make_views(poses)[0], painted_avatar()
    plain, full = (score(avatar, view, one(poses, 0)) for score in (score_view, score_view_fully))
    assert {name: full[name] for name in plain} == pytest.approx(plain, nan_ok=True)
    assert full["psnr_in_mask"] is not None
    assert full["psnr_in_mask"] > 25
    assert full["flip_hand_on_black"] is not None
    assert 0 < full["flip_hand_on_black"] < 0.05
    assert [name for name, value in full.items() if value is None] == [
        "lpips_alex_01_hand_on_black",
        "lpips_vgg_01_hand_on_black",
        "lpips_vgg_11_hand_on_black",
    ]


def test_a_reduced_crop_lies_where_it_belongs_in_the_whole_picture() -> None:
    poses = true_poses(2)
    view, avatar = make_views(poses)[0], painted_avatar()
    # The same view as a crop of a picture of twice the size, reduced to a half.
    large = CAMERA.resized(2 * CAMERA.width, 2 * CAMERA.height)
    whole = replace(avatar, camera=large)
    expected, found = (score_view(subject, view, one(poses, 0)) for subject in (avatar, whole))
    assert found == pytest.approx(expected, nan_ok=True)


def test_a_run_is_scored_from_its_folder_and_video(
    demo_clip: Path, draft_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    run.mkdir()
    for name in ("avatar.safetensors", "report.json", "tracks.json"):
        (run / name).write_bytes((draft_run / name).read_bytes())
    assert main(["eval", str(run)]) == 2
    assert main(["eval", str(tmp_path), "--video", str(demo_clip)]) == 2
    capsys.readouterr()
    assert main(["eval", str(run), "--video", str(demo_clip)]) == 0
    shown = capsys.readouterr().out
    assert "| metric | held out | after test-time pose refinement |" in shown
    assert "| lpips_vgg_11_hand_on_black | not computed | not computed |" in shown
    found = json.loads((run / FILE_NAME).read_text())
    report = json.loads((run / "report.json").read_text())
    assert [row["index"] for row in found["per_frame"]] == report["frames"]["heldout"]
    # The masks are made again: nearly the report's own figures.
    for name, value in report["metrics"].items():
        if value is not None:
            assert math.isclose(found["metrics"][name], value, rel_tol=0.02), name
    second = found[REFINED]["metrics"]
    assert second["psnr_hand_on_black"] > found["metrics"]["psnr_hand_on_black"]
