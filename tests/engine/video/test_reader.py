"""What a good video gives: upright frames, true times, true colours."""

from __future__ import annotations

from pathlib import Path

import av
import numpy as np
import pytest

from mass_engine.video.orientation import Orientation
from mass_engine.video.reader import VideoWarning, probe, read_frames
from tests.engine.video.clips import (
    BLUE,
    GREEN,
    GREY,
    RED,
    corner_colors,
    encoder,
    make_clip,
    moving,
    picture,
    quadrants,
)


def test_frames_come_in_order_with_their_own_times(tmp_path: Path) -> None:
    times = [0, 33, 133, 166, 300, 340]
    clip = make_clip(tmp_path / "vfr.mp4", [quadrants()] * 6, times)
    frames = list(read_frames(clip))
    assert [frame.index for frame in frames] == list(range(6))
    np.testing.assert_allclose([frame.time for frame in frames], np.array(times) / 1000, atol=2e-3)
    assert frames[0].rgb.dtype == np.uint8
    assert frames[0].rgb.flags.c_contiguous


def test_time_starts_at_the_first_frame(tmp_path: Path) -> None:
    clip = make_clip(tmp_path / "late.webm", [quadrants()] * 3, [5000, 5100, 5150], codec="libvpx-vp9")
    np.testing.assert_allclose([frame.time for frame in read_frames(clip)], [0.0, 0.1, 0.15], atol=2e-3)


@pytest.mark.parametrize(
    ("name", "codec"),
    [("a.mp4", "libx264"), ("a.mov", "libx264"), ("a.mp4", "libx265"), ("a.webm", "libvpx-vp9"),
     ("a.webm", "libsvtav1"), ("a.mkv", "mpeg4")],
)  # fmt: skip
def test_containers_and_codecs(tmp_path: Path, name: str, codec: str) -> None:
    clip = make_clip(tmp_path / name, [quadrants(96, 128)] * 4, codec=codec)
    warnings: list[VideoWarning] = []
    frames = list(read_frames(clip, on_warning=warnings.append))
    assert len(frames) == 4
    assert not warnings
    assert corner_colors(frames[-1].rgb) == [RED, GREEN, BLUE, GREY]
    info = probe(clip)
    assert (info.width, info.height, info.rotation) == (128, 96, 0)
    assert info.fps == pytest.approx(25, rel=0.05)


def test_odd_sizes(tmp_path: Path) -> None:
    clip = make_clip(tmp_path / "odd.webm", [quadrants(37, 51)] * 2, codec="libvpx-vp9")
    assert [frame.rgb.shape for frame in read_frames(clip)] == [(37, 51, 3)] * 2


@pytest.mark.parametrize(
    ("turn", "mirror", "corners", "clockwise"),
    [
        (90, False, [GREEN, GREY, RED, BLUE], 270),
        (-90, False, [BLUE, RED, GREY, GREEN], 90),
        (180, False, [GREY, BLUE, GREEN, RED], 180),
        (0, True, [GREEN, RED, GREY, BLUE], 0),
    ],
)
def test_the_display_matrix_is_applied(
    tmp_path: Path, turn: int, mirror: bool, corners: list[tuple[int, int, int]], clockwise: int
) -> None:
    clip = tmp_path / "turned.mp4"
    with encoder(clip, "libx264", 48, 64) as (container, stream):
        stream.set_display_rotation(turn, hflip=mirror)
        for i in range(3):
            container.mux(stream.encode(picture(quadrants(), 40 * i)))
    frame = next(iter(read_frames(clip)))
    assert corner_colors(frame.rgb) == corners
    info = probe(clip)
    assert (info.height, info.width) == frame.rgb.shape[:2]
    assert info.rotation == clockwise


@pytest.mark.parametrize("a_b_c_d", [
    (1, 0, 0, 1), (0, 1, -1, 0), (-1, 0, 0, -1), (0, -1, 1, 0),
    (-1, 0, 0, 1), (1, 0, 0, -1), (0, 1, 1, 0), (0, -1, -1, 0),
])  # fmt: skip
def test_all_eight_orientations_move_every_pixel_as_the_matrix_says(
    a_b_c_d: tuple[int, int, int, int],
) -> None:
    a, b, c, d = a_b_c_d
    matrix = np.array([a, b, 0, c, d, 0, 0, 0, 1 << 14], np.int32) * 65536
    image = np.arange(3 * 5, dtype=np.uint8).reshape(3, 5, 1)
    shown = Orientation.from_matrix(matrix).apply(image)
    y, x = np.mgrid[0:3, 0:5]
    to_x, to_y = a * x + c * y, b * x + d * y
    to_x, to_y = to_x - to_x.min(), to_y - to_y.min()
    expected = np.zeros((to_y.max() + 1, to_x.max() + 1, 1), np.uint8)
    expected[to_y, to_x] = image
    np.testing.assert_array_equal(shown, expected)
    assert Orientation.from_matrix(matrix).size(3, 5) == expected.shape[:2]


def test_anamorphic_pixels_become_square(tmp_path: Path) -> None:
    clip = tmp_path / "wide.mp4"
    with encoder(clip, "libx264", 48, 64) as (container, stream):
        stream.codec_context.sample_aspect_ratio = 2  # type: ignore[assignment]
        for i in range(2):
            container.mux(stream.encode(picture(quadrants(), 40 * i)))
    assert next(iter(read_frames(clip))).rgb.shape == (48, 128, 3)
    assert probe(clip).width == 128


def test_the_main_track_is_the_largest_of_equal_rank(tmp_path: Path) -> None:
    clip = tmp_path / "two.mkv"
    with av.open(str(clip), "w") as container:
        streams = []
        for height, width in ((32, 32), (48, 64)):
            stream = container.add_stream("libx264", rate=25)
            stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
            stream.disposition = av.stream.Disposition.default
            streams.append(stream)
        for i in range(3):
            for stream in streams:
                container.mux(stream.encode(picture(quadrants(stream.height, stream.width), 40 * i)))
        for stream in streams:
            container.mux(stream.encode(None))
    assert next(iter(read_frames(clip))).rgb.shape == (48, 64, 3)


def _levels(path: Path, transfer: int, primaries: int) -> list[int]:
    """Grey bars of rising 10-bit luma, encoded with the given tags, read back as 8-bit green."""
    luma = np.repeat(np.linspace(64, 940, 8).astype(np.uint16), 16)
    bars = np.full((64 + 32, 128), 512, np.uint16)
    bars[:64] = luma
    with encoder(path, "libx265", 64, 128, pix_fmt="yuv420p10le", crf="4") as (container, stream):
        context = stream.codec_context
        context.color_trc, context.color_primaries, context.color_range = transfer, primaries, 1
        context.colorspace = 9 if primaries == 9 else 1
        for i in range(2):
            container.mux(stream.encode(picture(bars, 40 * i, "yuv420p10le")))
    rgb = next(iter(read_frames(path))).rgb
    assert rgb.shape == (64, 128, 3)
    assert np.abs(rgb.astype(int) - rgb[..., 1:2]).max() <= 4, "grey stays grey"
    return [int(rgb[32, 16 * i + 8, 1]) for i in range(8)]


def test_ten_bit_sdr_becomes_eight_bit(tmp_path: Path) -> None:
    np.testing.assert_allclose(_levels(tmp_path / "sdr.mp4", 1, 1), np.linspace(0, 255, 8), atol=3)


@pytest.mark.parametrize(("transfer", "white"), [(18, 0.75), (16, 0.58)])
def test_high_dynamic_range_is_tone_mapped(tmp_path: Path, transfer: int, white: float) -> None:
    levels = _levels(tmp_path / "hdr.mov", transfer, 9)
    assert levels == sorted(levels)
    assert levels[0] <= 2
    assert levels[-1] >= 253
    # Diffuse white (75 % of HLG's signal, 58 % of PQ's) must come out light, and what is above still fits in.
    at_white = float(np.interp(white * 7, range(8), levels))
    assert 225 <= at_white <= 253


def test_a_file_cut_short_still_gives_its_frames_and_says_so(tmp_path: Path) -> None:
    whole = make_clip(tmp_path / "whole.mp4", moving(40), movflags="+faststart")
    cut = tmp_path / "cut.mp4"
    content = whole.read_bytes()
    cut.write_bytes(content[: len(content) * 6 // 10])
    warnings: list[VideoWarning] = []
    frames = list(read_frames(cut, on_warning=warnings.append))
    assert 5 < len(frames) < 36
    assert [warning.code for warning in warnings] == ["video.truncated"]
    assert "of 40" in warnings[0].message
