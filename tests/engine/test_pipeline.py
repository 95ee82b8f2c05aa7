"""From a video to an avatar and back to pictures."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import trimesh

from mass_engine import Avatar, BadArgumentError, EngineError
from mass_engine.evaluation.heldout import evaluate_run
from mass_engine.export.ply import read_ply, write_ply
from mass_engine.rendering import render_frames, render_to_file
from tests.engine.video.odd import PERSONAL


def test_run_directory_holds_what_is_promised(draft_run: Path) -> None:
    report = json.loads((draft_run / "report.json").read_text())
    assert report["frames"]["heldout"]
    assert all(index % 4 == 3 for index in report["frames"]["heldout"])
    assert not set(report["frames"]["heldout"]) & set(report["frames"]["fitted"])
    assert report["scored_frames"] == {"kind": "heldout", "count": len(report["frames"]["heldout"])}
    second = report["after_test_time_pose_refinement"]
    assert second["frames"] == report["frames"]["heldout"][:1]
    assert second["as_fitted"]["psnr_hand_on_black"] == report["per_frame"][0]["psnr_hand_on_black"]
    assert second["metrics"]["psnr_hand_on_black"] >= second["as_fitted"]["psnr_hand_on_black"]
    assert report["warnings"] == []
    assert report["frames"]["not_trusted"] == []
    choice = report["frames"]["choice"]
    assert choice["chosen"]["index"] == report["frames"]["fitted"]
    left_out = sum(part["count"] for part in choice["left_out"].values())
    assert choice["candidates"] == len(report["frames"]["fitted"]) + left_out
    assert report["surfels"]["kept"] > 1000
    assert report["peak_memory_bytes"] > 0
    assert {"track", "segment", "align", "fit"} <= report["seconds"].keys()
    assert {"torch", "numpy", "python"} <= report["versions"].keys()
    cloud = trimesh.load(draft_run / "surfels.ply")
    assert isinstance(cloud, trimesh.PointCloud)
    assert len(cloud.vertices) == report["surfels"]["kept"]
    tracks = json.loads((draft_run / "tracks.json").read_text())
    assert [frame["index"] for frame in tracks["frames"]] == sorted(
        report["frames"]["heldout"] + report["frames"]["fitted"]
    )
    assert len(tracks["frames"][0]["hands"][0]["hand_pose"]) == 45
    assert len(list((draft_run / "previews").iterdir())) >= 10


def test_an_evaluation_sees_the_masks_of_the_fit(demo_clip: Path, draft_run: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    shutil.copytree(draft_run, run)
    scores = evaluate_run(run, demo_clip, refine=False)
    report = json.loads((run / "report.json").read_text())
    found = {row["index"]: row["psnr_in_mask"] for row in scores.as_fitted}
    assert found == pytest.approx(
        {row["index"]: row["psnr_in_mask"] for row in report["per_frame"]}, abs=1e-3
    )
    assert (run / "evaluation.json").is_file()


def test_personal_tags_reach_no_output(demo_clip: Path, draft_run: Path) -> None:
    secrets = [value.encode() for value in PERSONAL.values()]
    assert all(secret in demo_clip.read_bytes() for secret in secrets)
    files = [path for path in draft_run.rglob("*") if path.is_file()]
    assert len(files) > 10
    for path in files:
        content = path.read_bytes()
        assert not [secret for secret in secrets if secret in content], path.name
        assert b"Exif" not in content


def test_the_hand_of_a_known_clip_is_found_again(draft_run: Path) -> None:
    metrics = json.loads((draft_run / "report.json").read_text())["metrics"]
    assert metrics["psnr_in_mask"] > 20
    assert metrics["silhouette_iou"] > 0.85
    assert metrics["psnr_hand_on_black"] > 22


def test_a_saved_avatar_renders_the_same_picture(draft_run: Path, tmp_path: Path) -> None:
    avatar = Avatar.load(draft_run)
    avatar.save(tmp_path / "copy.safetensors")
    again = Avatar.load(tmp_path / "copy.safetensors")
    assert np.array_equal(avatar.render("fist", "orbit:30,10"), again.render("fist", "orbit:30,10"))


def test_poses_cameras_and_sizes_change_the_picture(draft_run: Path) -> None:
    avatar = Avatar.load(draft_run)
    pictures = [
        avatar.render("rest", "orbit:0,0", 96, 64),
        avatar.render("fist", "orbit:0,0", 96, 64),
        avatar.render("rest", "orbit:60,0", 96, 64),
        avatar.render("rest", "source", 96, 64),
        avatar.render(",".join(["0.1"] * 48), "orbit:0,0,0.4", 96, 64),
        avatar.render("frame:4", "source", 96, 64),
    ]
    assert all(picture.shape == (64, 96, 4) and picture.dtype == np.uint8 for picture in pictures)
    assert all(0.01 < (picture[..., 3] > 127).mean() < 0.9 for picture in pictures)
    flat = {picture.tobytes() for picture in pictures}
    assert len(flat) == len(pictures)


@pytest.mark.parametrize(
    ("pose", "camera", "code"),
    [
        ("dance", "source", "pose.invalid"),
        ("frame:9999", "source", "pose.no_such_frame"),
        ("frame:-1", "source", "pose.invalid"),
        ("1,2,3", "source", "pose.invalid"),
        (",".join(["nan"] * 48), "source", "pose.invalid"),
        ("rest", "orbit:1", "camera.invalid"),
        ("rest", "orbit:0,0,1e9", "camera.invalid"),
        ("rest", "orbit:inf,0", "camera.invalid"),
        ("rest", "/etc/passwd", "camera.invalid"),
        ("rest", '{"K": 3}', "camera.invalid"),
    ],
)
def test_a_bad_view_is_refused_with_its_code(draft_run: Path, pose: str, camera: str, code: str) -> None:
    with pytest.raises(BadArgumentError) as caught:
        Avatar.load(draft_run).render(pose, camera, 32, 32)
    assert caught.value.code == code
    assert caught.value.advice


def test_frames_are_rendered_at_the_videos_size(draft_run: Path, tmp_path: Path) -> None:
    count = render_frames(draft_run, "holdout", tmp_path / "frames")
    files = sorted((tmp_path / "frames").iterdir())
    assert len(files) == count > 0
    assert files[0].name == f"{int(files[0].stem):06d}.png"
    picture = cv2.imread(str(files[0]), cv2.IMREAD_UNCHANGED)
    assert picture is not None
    assert picture.shape == (360, 480, 4)
    with pytest.raises(BadArgumentError):
        render_frames(draft_run, "some", tmp_path)


def test_a_camera_file_is_read(draft_run: Path, tmp_path: Path) -> None:
    avatar = Avatar.load(draft_run)
    camera = {
        "K": avatar.camera.K.tolist(),
        "world_to_camera": avatar.camera.world_to_camera.tolist(),
        "width": 480,
        "height": 360,
    }
    (tmp_path / "camera.json").write_text(json.dumps(camera))
    render_to_file(draft_run, "frame:4", str(tmp_path / "camera.json"), "480x360", tmp_path / "a.png")
    render_to_file(draft_run, "frame:4", "source", "480x360", tmp_path / "b.png")
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_exported_surfels_read_back(draft_run: Path, tmp_path: Path) -> None:
    cloud = Avatar.load(draft_run).cloud("fist")
    write_ply(cloud, tmp_path / "fist.ply", "3dgs")
    again = read_ply(tmp_path / "fist.ply")
    torch.testing.assert_close(again.means, cloud.means)
    torch.testing.assert_close(again.scales, cloud.scales)


def test_damaged_and_missing_avatars_are_named(draft_run: Path, tmp_path: Path) -> None:
    with pytest.raises(EngineError, match=r"avatar\.not_found"):
        Avatar.load(tmp_path)
    data = (draft_run / "avatar.safetensors").read_bytes()
    for damaged in (data[: len(data) // 2], b"", b"junk" * 100):
        (tmp_path / "avatar.safetensors").write_bytes(damaged)
        with pytest.raises(EngineError, match=r"avatar\.corrupt"):
            Avatar.load(tmp_path)
