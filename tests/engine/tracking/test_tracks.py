"""tracks.json: round trip and everything that can be wrong with it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from mass_engine.errors import EngineError
from mass_engine.hand.pose import HandPose
from mass_engine.tracking.tracks import Tracks, read_tracks, write_tracks


def tracks() -> Tracks:
    random = torch.Generator().manual_seed(1)
    betas, orient, fingers, transl = (torch.randn(3, n, generator=random) for n in (10, 3, 45, 3))
    pose = HandPose(betas, orient, fingers, transl, "left")
    points = torch.randn(3, 21, 3, generator=random).numpy()
    pixels = (torch.rand(3, 21, 2, generator=random) * 100).numpy()
    K = torch.tensor([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
    return Tracks(
        "clip.mp4", 29.97, (640, 480), K, [0, 2, 5], [0.0, 0.07, 0.17], pose, points, pixels, [0.9, 1.0, 0.5]
    )


def test_what_is_written_is_read_again(tmp_path: Path) -> None:
    made = tracks()
    write_tracks([made], tmp_path / "tracks.json")
    again = read_tracks(tmp_path / "tracks.json", "auto", (640, 480))
    assert again.indices == made.indices
    assert again.pose.side == "left"
    for name in ("betas", "global_orient", "hand_pose", "transl"):
        torch.testing.assert_close(getattr(again.pose, name), getattr(made.pose, name), atol=1e-5, rtol=0)
    np.testing.assert_allclose(again.joints3d, made.joints3d, atol=1e-5)
    np.testing.assert_allclose(again.landmarks2d, made.landmarks2d, atol=1e-2)


def spoil(change: str) -> Any:
    def apply(data: dict[str, Any]) -> None:
        hand = data["frames"][0]["hands"][0]
        if change == "short pose":
            hand["hand_pose"] = hand["hand_pose"][:44]
        elif change == "nan":
            hand["transl"][0] = float("nan")
        elif change == "no betas":
            del hand["betas"]
        elif change == "text":
            hand["score"] = "high"
        elif change == "no frames":
            del data["frames"]
        else:
            data["frames"] = 3

    return apply


@pytest.mark.parametrize(
    "change", ["short pose", "nan", "no betas", "text", "no frames", "frames are a number"]
)
def test_incomplete_tracks_are_refused(tmp_path: Path, change: str) -> None:
    path = tmp_path / "tracks.json"
    write_tracks([tracks()], path)
    data = json.loads(path.read_text())
    spoil(change)(data)
    path.write_text(json.dumps(data))
    with pytest.raises(EngineError) as caught:
        read_tracks(path, "auto", (640, 480))
    assert caught.value.code == "tracks.invalid"


def test_tracks_of_another_size_side_or_no_file_are_named(tmp_path: Path) -> None:
    path = tmp_path / "tracks.json"
    with pytest.raises(EngineError, match=r"tracks\.not_found"):
        read_tracks(path, "auto", (640, 480))
    write_tracks([tracks()], path)
    with pytest.raises(EngineError, match=r"tracks\.other_video"):
        read_tracks(path, "auto", (480, 640))
    with pytest.raises(EngineError, match=r"tracks\.no_hand"):
        read_tracks(path, "right", (640, 480))
    path.write_text("{")
    with pytest.raises(EngineError, match=r"tracks\.invalid"):
        read_tracks(path, "auto", (640, 480))
