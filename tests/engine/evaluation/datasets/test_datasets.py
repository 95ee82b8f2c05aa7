"""Every data set's loader and protocol on a small tree in its true layout, up to the table."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from mass_engine.cli import main
from mass_engine.errors import EngineError
from mass_engine.evaluation.datasets import arctic, hand_appearance, interhand
from mass_engine.evaluation.datasets.outcome import EvalOptions
from mass_engine.evaluation.heldout import REFINED
from mass_engine.evaluation.lossless import write_lossless
from mass_engine.hand.mano import read_mano
from mass_engine.video.reader import read_frames
from tests.engine.evaluation.datasets.trees import arctic_tree, hand_appearance_tree, interhand_tree


def run(name: str, root: Path, mano: Path, *more: str) -> dict[str, Any]:
    out = root / "out"
    code = main(
        [
            "eval",
            name,
            "--root",
            str(root),
            "--mano",
            str(mano),
            "--preset",
            "draft",
            "--out",
            str(out),
            *more,
        ]
    )
    assert code == 0
    result: dict[str, Any] = json.loads((out / "results.json").read_text())
    table = (out / "results.md").read_text()
    assert "MASS (paper)" in table
    assert "| ours |" in table
    assert "| ours, after test-time pose refinement |" in table
    for row in result["ours"]:
        first, second = row["metrics"], row[REFINED]["metrics"]
        assert first["lpips_vgg_11_hand_on_black"] is None
        # The frame's own colours may only help.
        assert second["psnr_hand_on_black"] > first["psnr_hand_on_black"] - 0.1
    return result


def test_a_lossless_video_is_lossless(tmp_path: Path) -> None:
    random = np.random.default_rng(0)
    frames = [random.integers(0, 256, (37, 52, 3)).astype(np.uint8) for _ in range(3)]
    assert write_lossless(tmp_path / "a.mkv", frames, 30.0) == 3
    for frame, read in zip(frames, read_frames(tmp_path / "a.mkv"), strict=True):
        np.testing.assert_array_equal(frame, read.rgb)
    with pytest.raises(ValueError, match="at least one"):
        write_lossless(tmp_path / "b.mkv", [], 30.0)
    with pytest.raises(ValueError, match="not"):
        write_lossless(tmp_path / "c.mkv", [frames[0], frames[1][:20]], 30.0)


def test_arctic(tmp_path: Path) -> None:
    mano = arctic_tree(tmp_path)
    result = run("arctic", tmp_path, mano)
    row = result["ours"][0]
    assert row["clip"] == "s01/box_grab_01"
    assert [frame["index"] for frame in row["per_frame"]] == [4, 9]
    # The poses are exact: through the lens, the offset and the cameras the hand must lie on the hand.
    assert row["metrics"]["silhouette_iou"] > 0.86  # preset draft, ten frames
    assert row["metrics"]["psnr_hand_on_black"] > 25


def test_hand_appearance(tmp_path: Path) -> None:
    mano = hand_appearance_tree(tmp_path)
    result = run("hand-appearance", tmp_path, mano)
    row = result["ours"][0]
    assert row["clip"] == "subject_1/1"
    assert [frame["index"] for frame in row["per_frame"]] == [4, 9]
    assert row["metrics"]["silhouette_iou"] > 0.9
    # The arm is ignored, the hand is not.
    mask = cv2.imread(str(tmp_path / "out" / "subject_1-1" / "masks" / "000004.png"), cv2.IMREAD_GRAYSCALE)
    assert mask is not None
    assert (mask == 128).sum() > 500
    assert (mask == 255).sum() > 5000


def test_interhand(tmp_path: Path) -> None:
    mano = interhand_tree(tmp_path)
    data = interhand.InterHand(tmp_path, read_mano(mano))
    names = data.pictures(interhand.TEST)
    assert len(names) == 12
    accepted = [sample for name in names if (sample := data.sample(name)) is not None]
    assert len(accepted) == 9  # the grey camera is left out
    result = run("interhand", tmp_path, mano, "--views", "2", "--max-frames", "6")
    row = result["ours"][0]
    assert (row["views"], row["fitted"], row["frames"]) == (2, 6, 1)
    assert row["metrics"]["silhouette_iou"] > 0.9
    assert row["metrics"]["psnr_hand_on_black"] > 20


def test_what_is_not_the_data_set_is_told(tmp_path: Path) -> None:
    mano = interhand_tree(tmp_path / "inter")
    for module in (arctic, hand_appearance, interhand):
        for options, code in (
            (EvalOptions(tmp_path / "empty", tmp_path / "out", mano), "eval.dataset"),
            (EvalOptions(tmp_path, tmp_path / "out"), "eval.needs_mano"),
        ):
            with pytest.raises(EngineError) as caught:
                module.evaluate(options, lambda _: None)
            assert caught.value.code == code
    assert main(["eval", "arctic"]) == 2
    assert main(["eval", str(tmp_path)]) == 2
