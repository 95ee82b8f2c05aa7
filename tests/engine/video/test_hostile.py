"""What a bad video gives: its own stable code, one sentence of advice, nothing else. More in test_corpus."""

from __future__ import annotations

import subprocess
import sys
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

from mass_engine.errors import EngineError
from mass_engine.video.container import sniff
from mass_engine.video.limits import VideoLimits
from mass_engine.video.reader import probe, read_frames
from tests.engine.video.clips import make_clip, moving, picture, quadrants


def code_of(path: Path, limits: VideoLimits | None = None) -> str:
    with pytest.raises(EngineError) as caught:
        for _ in read_frames(path, limits):
            pass
    assert caught.value.advice.endswith(".")
    assert str(path.parent) not in caught.value.message or caught.value.code == "video.not_found"
    return caught.value.code


def test_a_missing_file_a_folder_and_a_device(tmp_path: Path) -> None:
    (tmp_path / "device.mp4").symlink_to("/dev/zero")
    assert code_of(tmp_path / "device.mp4") == "video.not_found"
    assert code_of(tmp_path / "nothing.mp4") == "video.not_found"
    assert code_of(tmp_path) == "video.not_found"


def test_a_file_named_like_a_protocol_is_only_a_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make_clip(tmp_path / "whole.mp4", [quadrants()] * 3)
    (tmp_path / "whole.mp4").rename(tmp_path / "concat:a|b.mp4")
    monkeypatch.chdir(tmp_path)
    assert len(list(read_frames("concat:a|b.mp4"))) == 3


def test_a_pixel_bomb_is_refused_before_it_is_decoded(tmp_path: Path) -> None:
    black = np.zeros((4096, 4096, 3), np.uint8)
    path = make_clip(tmp_path / "bomb.mp4", [black] * 2, preset="ultrafast")
    assert path.stat().st_size < 300_000
    assert code_of(path) == "video.too_many_pixels"
    with pytest.raises(EngineError, match=r"video\.too_many_pixels"):
        probe(path)


@pytest.mark.parametrize(
    ("limits", "code"),
    [
        (VideoLimits(max_pixels=2000), "video.too_many_pixels"),
        (VideoLimits(max_pixels=48 * 64 - 1), "video.too_many_pixels"),
        (VideoLimits(max_frames=10), "video.too_long"),
        (VideoLimits(max_seconds=0.3), "video.too_long"),
        (VideoLimits(max_bytes=1000), "video.too_large"),
    ],
)
@pytest.mark.parametrize("name", ["clip.mp4", "clip.webm"])
def test_every_cap_is_enforced(tmp_path: Path, name: str, limits: VideoLimits, code: str) -> None:
    codec = "libx264" if name.endswith("mp4") else "libvpx-vp9"
    clip = make_clip(tmp_path / name, moving(12), codec=codec)
    assert code_of(clip, limits) == code


def test_caps_count_what_is_decoded_not_what_is_declared(tmp_path: Path) -> None:
    """A webm declares no number of frames, and this one claims to last no time at all."""
    clip = make_clip(tmp_path / "clip.webm", moving(40), codec="libvpx-vp9")
    content = clip.read_bytes()
    at = content.index(b"\x44\x89\x88")  # Duration, an 8-byte float
    clip.write_bytes(content[: at + 3] + bytes(8) + content[at + 11 :])
    frames = read_frames(clip, VideoLimits(max_frames=20))
    assert [next(frames).index for _ in range(20)] == list(range(20))
    with pytest.raises(EngineError, match=r"video\.too_long"):
        next(frames)
    assert code_of(clip, VideoLimits(max_seconds=0.5)) == "video.too_long"


def test_a_size_that_changes_on_the_way(tmp_path: Path) -> None:
    path = tmp_path / "clip.webm"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libvpx", rate=25)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        stream.codec_context.time_base = Fraction(1, 1000)
        other = av.CodecContext.create("libvpx", "w")
        other.width, other.height, other.pix_fmt = 32, 32, "yuv420p"
        other.time_base = Fraction(1, 1000)
        for i in range(3):
            container.mux(stream.encode(picture(quadrants(), 40 * i)))
        container.mux(stream.encode(None))
        for packet in [
            *(packet for i in range(3) for packet in other.encode(picture(quadrants(32, 32), 200 + 40 * i))),
            *other.encode(None),
        ]:
            packet.stream = stream
            container.mux(packet)
    assert code_of(path) == "video.size_changes"


_FUZZ = """
import sys, numpy as np
from pathlib import Path
from mass_engine.errors import EngineError
from mass_engine.video.limits import VideoLimits
from mass_engine.video.reader import read_frames
folder, outcomes = Path(sys.argv[1]), {}
for source in sorted(folder.glob("source.*")):
    content = np.frombuffer(source.read_bytes(), np.uint8)
    for seed in range(30):
        rng = np.random.default_rng(seed)
        fuzzed = content.copy()
        where = rng.integers(0, fuzzed.size if seed % 2 else min(600, fuzzed.size), 1 + seed % 12)
        fuzzed[where] = rng.integers(0, 256, where.size)
        if seed % 5 == 0:
            fuzzed = fuzzed[: rng.integers(20, fuzzed.size)]
        path = folder / ("fuzzed" + source.suffix)
        path.write_bytes(fuzzed.tobytes())
        try:
            outcome = "frames" if sum(1 for _ in read_frames(path, VideoLimits(max_frames=200))) else "none"
        except EngineError as error:
            outcome = error.code
        outcomes[outcome] = outcomes.get(outcome, 0) + 1
print(sorted(outcomes))
"""


def test_fuzzed_files_end_in_frames_or_a_code(tmp_path: Path) -> None:
    """In a child process, for a crash inside the decoder must fail this test, not end the run."""
    make_clip(tmp_path / "source.mp4", moving(12), movflags="+faststart")
    make_clip(tmp_path / "source.webm", moving(12), codec="libvpx-vp9")
    done = subprocess.run(
        [sys.executable, "-c", _FUZZ, str(tmp_path)], capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert "frames" in done.stdout
    assert "video.corrupt" in done.stdout
    assert "none" not in done.stdout


def test_sniffing() -> None:
    assert sniff(b"\0\0\0\x20ftypqt  ") == "mov"
    assert sniff(b"\0\0\0\x08wide\0\0\0\0mdat") == "mov"
    assert sniff(b"\x1a\x45\xdf\xa3\x9f\x42\x86\x81") == "matroska"
    assert sniff(b"ffconcat version 1.0") is None
    assert sniff(b"#EXTM3U\n") is None
    assert sniff(b"") is None
