"""``--side both``: two hands of one person, kept apart, an avatar each."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from mass_engine import Avatar, BadArgumentError, EngineError, FitOptions, fit
from mass_engine.cli import main
from mass_engine.pipeline import fit_hands_to_directory
from mass_engine.preprocess import prepare
from mass_engine.progress import Progress, ProgressMeter
from mass_engine.survey import survey
from mass_engine.tracking.tracks import read_tracks
from mass_engine.video.reader import read_frames
from mass_engine.video.writer import write_video


@pytest.fixture(scope="module")
def two_hands(demo_clip: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The clip beside its mirror image: a left hand in the left half, a right one in the right half."""
    path = tmp_path_factory.mktemp("two") / "hands.mp4"
    frames = (np.concatenate([f.rgb[:, ::-1], f.rgb], 1) for f in read_frames(demo_clip))
    write_video(path, frames, 16)
    return path


@pytest.fixture(scope="module")
def both_run(two_hands: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Progress]]:
    """A draft fit of both hands."""
    out = tmp_path_factory.mktemp("both")
    steps: list[Progress] = []
    options = FitOptions(side="both", preset="draft", max_frames=8)
    fit_hands_to_directory(two_hands, out, options, steps.append)
    return out, steps


def silent() -> ProgressMeter:
    return ProgressMeter(lambda _: None)


def test_each_hand_gets_a_run_of_its_own(both_run: tuple[Path, list[Progress]]) -> None:
    out, _ = both_run
    top = json.loads((out / "report.json").read_text())
    assert set(top["hands"]) == {"right", "left"}
    for side in ("right", "left"):
        report = json.loads((out / side / "report.json").read_text())
        assert top["hands"][side] == report
        assert report["side"] == side
        assert report["fov"] == {"degrees": 60.0, "source": "assumed", "assumed": True}
        assert report["metrics"]["silhouette_iou"] > 0.8
        assert Avatar.load(out / side).shape.model.side == side
        assert (out / side / "surfels.ply").is_file()
        half = range(480) if side == "left" else range(480, 960)
        tracks = read_tracks(out / side / "tracks.json", "auto", (960, 360))
        assert tracks.pose.side == side
        assert all(round(x) in half for x in tracks.landmarks2d[..., 0].mean(1))
        again = read_tracks(out / "tracks.json", side, (960, 360))
        np.testing.assert_array_equal(again.landmarks2d, tracks.landmarks2d)
    assert not (out / "avatar.safetensors").exists()
    assert top["seconds"]["fit"] > top["hands"]["right"]["seconds"]["fit"]
    assert top["seconds"]["track"] == top["hands"]["left"]["seconds"]["track"]


def test_progress_runs_once_through_both(both_run: tuple[Path, list[Progress]]) -> None:
    _, steps = both_run
    fractions = [step.fraction for step in steps]
    assert fractions == sorted(fractions)
    assert 0.95 < fractions[-1] <= 1
    assert {step.message.split(":")[0] for step in steps if step.stage == "fit"} == {
        "right hand",
        "left hand",
    }


def test_a_run_of_two_hands_says_where_the_avatars_are(both_run: tuple[Path, list[Progress]]) -> None:
    with pytest.raises(EngineError, match=r"avatar\.not_found") as caught:
        Avatar.load(both_run[0])
    assert str(both_run[0] / "left") in caught.value.advice


def test_the_tracks_of_both_hands_start_another_fit(
    two_hands: Path, both_run: tuple[Path, list[Progress]]
) -> None:
    options = FitOptions(side="both", tracks=both_run[0] / "tracks.json")
    found = survey(two_hands, options, silent(), lambda *_: None)
    assert [hand.side for hand in found.hands] == ["right", "left"]
    assert [len(hand.marks) for hand in found.hands] == [8, 8]
    assert all(hand.fov_source == "tracks" for hand in found.hands)


@pytest.mark.parametrize("side", ["left", "right"])
def test_of_two_hands_the_one_asked_for_is_taken(two_hands: Path, side: str) -> None:
    found = survey(two_hands, FitOptions(side=side), silent(), lambda *_: None)
    assert [hand.side for hand in found.hands] == [side]
    places = np.array([mark.points[:, 0].mean() for mark in found.hands[0].marks])
    assert ((places < 480) == (side == "left")).all()
    assert found.hands[0].others, "the other hand is known, for the masks"


def test_one_hand_gives_one_avatar_and_a_warning(demo_clip: Path, tmp_path: Path) -> None:
    arguments = ["fit", str(demo_clip), "--out", str(tmp_path / "run"), "--side", "both"]
    (tmp_path / "run" / "left").mkdir(parents=True)
    (tmp_path / "run" / "left" / "avatar.safetensors").write_text("of an earlier run")
    assert main([*arguments, "--preset", "draft", "--max-frames", "4"]) == 0
    top = json.loads((tmp_path / "run" / "report.json").read_text())
    assert set(top["hands"]) == {"right"}
    assert [warning["code"] for warning in top["warnings"]] == ["video.one_hand"]
    assert not (tmp_path / "run" / "left").exists()


def test_masks_of_both_hands_lie_in_two_folders(two_hands: Path, tmp_path: Path) -> None:
    with pytest.raises(EngineError, match=r"masks\.missing"):
        prepare(two_hands, FitOptions(side="both", masks=tmp_path), silent(), lambda *_: None)
    (tmp_path / "right").mkdir()
    for index in range(32):
        cv2.imwrite(str(tmp_path / "right" / f"{index:06d}.png"), np.full((360, 960), 255, np.uint8))
    clip = prepare(two_hands, FitOptions(side="both", masks=tmp_path), silent(), lambda *_: None)
    assert all((view.labels == 255).all() for view in clip.views)


def test_one_avatar_cannot_be_of_two_hands(two_hands: Path) -> None:
    with pytest.raises(BadArgumentError, match="fit_hands"):
        fit(two_hands, FitOptions(side="both"))
