"""What a bad video gives: its own stable code, one sentence of advice, nothing else."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

from mass_engine.errors import EngineError
from mass_engine.video.container import sniff
from mass_engine.video.limits import VideoLimits
from mass_engine.video.reader import probe, read_frames
from tests.engine.video.clips import make_audio, make_clip, moving, picture, quadrants


def code_of(path: Path, limits: VideoLimits | None = None) -> str:
    with pytest.raises(EngineError) as caught:
        for _ in read_frames(path, limits):
            pass
    assert caught.value.advice.endswith(".")
    assert str(path.parent) not in caught.value.message or caught.value.code == "video.not_found"
    return caught.value.code


def _text(path: Path) -> None:
    path.write_text("not a video\n" * 100)


def _empty(path: Path) -> None:
    path.touch()


def _short(path: Path) -> None:
    path.write_bytes(b"\0\0")


def _avi(path: Path) -> None:
    path.write_bytes(b"RIFF\x00\x10\x00\x00AVI LIST" + bytes(500))


def _only_magic(path: Path) -> None:
    path.write_bytes(b"\0\0\0\x18ftypisom" + bytes(12))


def _only_ebml(path: Path) -> None:
    path.write_bytes(b"\x1a\x45\xdf\xa3" + bytes(200))


def _magic_and_noise(path: Path) -> None:
    noise = np.random.default_rng(1).integers(0, 256, 20_000, dtype=np.uint8).tobytes()
    path.write_bytes(b"\0\0\0\x18ftypisom" + noise)


def _without_index(path: Path) -> None:
    whole = make_clip(path.with_name("whole.mp4"), moving(30)).read_bytes()  # its index is at the end
    path.write_bytes(whole[: len(whole) // 2])


def _single(path: Path) -> None:
    make_clip(path, [quadrants()])


def _audio(path: Path) -> None:
    make_audio(path)


def _playlist(path: Path) -> None:
    make_clip(path.with_name("secret.mp4"), [quadrants()] * 3)
    path.write_text("ffconcat version 1.0\nfile secret.mp4\n")


def _hls(path: Path) -> None:
    make_clip(path.with_name("secret.mp4"), [quadrants()] * 3)
    path.write_text("#EXTM3U\n#EXT-X-TARGETDURATION:3\n#EXTINF:3,\nsecret.mp4\n#EXT-X-ENDLIST\n")


@pytest.mark.parametrize(
    ("make", "code"),
    [
        (_text, "video.unsupported_container"),
        (_empty, "video.empty"),
        (_short, "video.unsupported_container"),
        (_avi, "video.unsupported_container"),
        (_only_magic, "video.corrupt"),
        (_only_ebml, "video.corrupt"),
        (_magic_and_noise, "video.corrupt"),
        (_without_index, "video.corrupt"),
        (_single, "video.too_short"),
        (_audio, "video.no_video_track"),
        (_playlist, "video.unsupported_container"),
        (_hls, "video.unsupported_container"),
    ],
)
def test_each_bad_file_has_its_code(tmp_path: Path, make: Callable[[Path], None], code: str) -> None:
    path = tmp_path / "clip.mp4"
    make(path)
    assert code_of(path) == code


def test_a_missing_file_and_a_folder(tmp_path: Path) -> None:
    assert code_of(tmp_path / "nothing.mp4") == "video.not_found"
    assert code_of(tmp_path) == "video.not_found"


def test_a_playlist_behind_a_magic_number_opens_no_other_file(tmp_path: Path) -> None:
    make_clip(tmp_path / "secret.mp4", [quadrants()] * 3)
    path = tmp_path / "clip.mp4"
    path.write_bytes(b"\0\0\0\x18ftypisom\nffconcat version 1.0\nfile secret.mp4\n")
    assert code_of(path) == "video.corrupt"


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
