"""Motions: poses in between, a turn around the hand, as a video and as an animated picture."""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest

from mass_engine.cli import main
from mass_engine.errors import BadArgumentError
from mass_engine.motion import Motion, animate, frame_count, parse_motion, pictures
from tests.engine.avatars import small_avatar

SMALL: dict[str, Any] = {"width": 64, "height": 48, "fps": 10}


@pytest.fixture(scope="module")
def avatar_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("avatar")
    small_avatar().save(folder)
    return (folder / "avatar.safetensors").rename(folder / "source")


def test_poses_are_passed_through_and_joined_smoothly() -> None:
    motion = parse_motion({**SMALL, "kind": "poses", "poses": ["rest", "fist"], "between": 3, "loop": False})
    frames = [frame.astype(int) for frame in pictures(small_avatar(), motion)]
    assert len(frames) == frame_count(motion) == 5
    steps = [np.abs(one - two).mean() for one, two in pairwise(frames)]
    whole = np.abs(frames[0] - frames[-1]).mean()
    assert 0 < max(steps) < whole
    looped = parse_motion({**SMALL, "kind": "poses", "poses": ["rest", "fist"], "between": 3})
    again = [*pictures(small_avatar(), looped)]
    assert len(again) == 8
    assert np.array_equal(again[0], frames[0])
    assert np.array_equal(again[1], again[7])  # there and back the same way


def test_a_turntable_goes_once_around() -> None:
    motion = parse_motion({**SMALL, "seconds": 0.8})
    frames = [*pictures(small_avatar(), motion)]
    assert len(frames) == 8
    assert len({frame.tobytes() for frame in frames}) == 8
    assert all((frame[..., 3] > 128).mean() > 0.01 for frame in frames)


def test_an_mp4_has_every_picture_on_white(avatar_file: Path, tmp_path: Path) -> None:
    done: list[float] = []
    motion = parse_motion({**SMALL, "seconds": 0.7})
    file = animate(avatar_file, motion, tmp_path / "run", done.append)
    with av.open(str(file)) as container:
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
        assert container.streams.video[0].average_rate == 10
    assert len(frames) == 7
    assert frames[0][0, 0].min() > 240
    assert done == pytest.approx([(n + 1) / 7 for n in range(7)])
    assert [path.name for path in (tmp_path / "run").iterdir()] == ["motion.mp4"]


def test_a_webp_is_transparent_and_keeps_time(avatar_file: Path, tmp_path: Path) -> None:
    motion = parse_motion({**SMALL, "fps": 30, "seconds": 0.1, "format": "webp"})
    file = animate(avatar_file, motion, tmp_path)
    read, animation = cv2.imreadanimation(str(file))
    assert read
    assert len(animation.frames) == 3
    assert [int(value) for value in np.ravel(animation.durations)] == [33, 34, 33]
    assert animation.frames[0].shape == (48, 64, 4)
    assert animation.frames[0][0, 0, 3] == 0


@pytest.mark.parametrize(
    "values",
    [
        {"speed": 2},
        {"kind": "dance"},
        {"poses": []},
        {"poses": "rest"},
        {"poses": [1]},
        {"between": -1},
        {"between": 1.5},
        {"width": 0},
        {"fps": float("nan")},
        {"seconds": 1e9},
        {"format": "gif"},
        {"loop": 1},
        {"kind": "poses", "poses": ["rest"] * 100, "between": 100},
    ],
)
def test_bad_motions(values: dict[str, Any]) -> None:
    with pytest.raises(BadArgumentError):
        parse_motion(values)


def test_the_command(avatar_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    spec = tmp_path / "motion.json"
    spec.write_text(json.dumps({**SMALL, "seconds": 0.3}))
    command = ["animate", str(avatar_file), "--motion", str(spec), "--out", str(tmp_path), "--json"]
    assert main(command) == 0
    events = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [event["type"] for event in events] == ["progress"] * 3 + ["done"]
    assert (tmp_path / "motion.mp4").is_file()
    spec.write_text(json.dumps({"poses": ["nonsense"]}))
    assert main(command) == 2
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["type"] == "error"
    spec.write_text("[]")
    assert main(command) == 2
    assert Motion().kind == "turntable"
