"""What is written reads back; what cannot be written leaves nothing behind."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from mass_engine.video.reader import probe, read_frames
from mass_engine.video.writer import write_video
from tests.engine.video.clips import quadrants


def test_round_trip_keeps_number_times_and_colours(tmp_path: Path) -> None:
    path = tmp_path / "new" / "clip.mp4"
    images = [np.roll(quadrants(96, 128), 2 * i, axis=1) for i in range(10)]
    assert write_video(path, iter(images), fps=24) == 10
    frames = list(read_frames(path))
    np.testing.assert_allclose([frame.time for frame in frames], np.arange(10) / 24, atol=1e-3)
    assert probe(path).codec == "h264"
    for frame, image in zip(frames, images, strict=True):
        assert np.median(np.abs(frame.rgb.astype(int) - image)) <= 2


def test_odd_sizes_are_padded(tmp_path: Path) -> None:
    path = tmp_path / "odd.mp4"
    write_video(path, [quadrants(37, 51)] * 2, fps=30)
    assert next(iter(read_frames(path))).rgb.shape == (38, 52, 3)


def test_no_frames_or_unequal_frames_leave_nothing(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="at least one"):
        write_video(tmp_path / "a.mp4", [], fps=30)
    with pytest.raises(ValueError, match="frame 1"):
        write_video(tmp_path / "a.mp4", [quadrants(), quadrants(32, 32)], fps=30)
    assert list(tmp_path.iterdir()) == []


def test_a_source_that_fails_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "clip.mp4"
    write_video(path, [quadrants()] * 2, fps=30)
    before = path.read_bytes()

    def failing() -> Iterator[NDArray[np.uint8]]:
        yield quadrants()
        raise RuntimeError("render failed")

    with pytest.raises(RuntimeError, match="render failed"):
        write_video(path, failing(), fps=30)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]
