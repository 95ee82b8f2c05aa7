"""Unusual videos that phones, editors and browsers do make: each must be read, and read right."""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from av.video.stream import VideoStream

from tests.engine.video.clips import encoder, make_clip, moving, picture, quadrants
from tests.engine.video.surgery import append_to, box, find, full_box, replace_box

TRAK = (b"moov", b"trak")
#: What a phone writes about its owner.
PERSONAL = {
    "location": "+48.8577+002.2950/",
    "com.apple.quicktime.location.ISO6709": "+48.8577+002.2950+035.000/",
    "com.apple.quicktime.make": "Examplephone",
    "author": "Erika Mustermann",
    "comment": "Serial 0123456789",
}


@dataclass(frozen=True)
class Odd:
    """How a file is made, and what must come out: frames, (height, width), seconds of the last one.

    ``frames`` None: some, how many depends on the encoder. With a ``code`` the file is refused.
    """

    make: Callable[[Path], object]
    name: str = "clip.mp4"
    frames: int | None = 12
    size: tuple[int, int] = (48, 64)
    last: float = 0.44
    warnings: list[str] = field(default_factory=list)
    code: str = ""


def coded(codec: str, height: int = 48, width: int = 64, **options: str) -> Callable[[Path], object]:
    """Twelve frames through one encoder."""
    return lambda path: make_clip(path, moving(12, height, width), None, codec, **options)


def timed(times: Sequence[int]) -> Callable[[Path], object]:
    """Frames shown at ``times`` in milliseconds."""
    return lambda path: make_clip(path, moving(len(times)), times)


def turned(degrees: int, mirror: bool = False) -> Callable[[Path], object]:
    """Frames with a display matrix."""

    def make(path: Path) -> None:
        with encoder(path, "libx264", 48, 64) as (container, stream):
            stream.set_display_rotation(degrees, hflip=mirror)
            for i, image in enumerate(moving(12)):
                container.mux(stream.encode(picture(image, 40 * i)))

    return make


def wide_range(transfer: int, tag: bytes = b"") -> Callable[[Path], object]:
    """10-bit HEVC as phones write it; ``tag`` renames its sample entry."""

    def make(path: Path) -> None:
        with encoder(path, "libx265", 64, 96, pix_fmt="yuv420p10le", **_QUIET) as (container, stream):
            context = stream.codec_context
            context.color_trc, context.color_primaries, context.colorspace = transfer, 9, 9
            if transfer == 2:
                context.color_primaries, context.colorspace = 2, 2
            for i, image in enumerate(moving(12, 64, 96)):
                frame = picture(image, 40 * i).reformat(format="yuv420p10le")
                container.mux(stream.encode(frame))
        if tag:
            path.write_bytes(path.read_bytes().replace(b"hev1", tag).replace(b"hvc1", tag))

    return make


_QUIET = {"x265-params": "log-level=none"}


def trimmed(path: Path) -> None:
    """An editor's cut: only 0.2 s from the middle are to be shown, all 40 frames are still there."""
    data = make_clip(path, moving(40), bf="0").read_bytes()
    at, _ = find(data, *TRAK, b"mdia", b"mdhd")
    ticks = struct.unpack_from(">I", data, at + 20)[0]
    cut = full_box(b"elst", struct.pack(">IIiHH", 1, 200, ticks * 4 // 5, 1, 0))
    path.write_bytes(replace_box(data, cut, *TRAK, b"edts", b"elst"))


def delayed(path: Path) -> None:
    """An empty edit first: the picture begins half a second after the sound."""
    data = make_clip(path, moving(12), bf="0").read_bytes()
    entries = struct.pack(">IIiHHIiHH", 2, 500, -1, 1, 0, 480, 0, 1, 0)
    path.write_bytes(replace_box(data, full_box(b"elst", entries), *TRAK, b"edts", b"elst"))


def _stream(container: av.container.OutputContainer, codec: str, height: int, width: int) -> VideoStream:
    stream = container.add_stream(codec, rate=25)
    assert isinstance(stream, VideoStream)
    stream.width, stream.height = width, height
    stream.pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
    stream.codec_context.time_base = Fraction(1, 1000)
    return stream


def with_sound(path: Path) -> None:
    """Picture and sound."""
    with av.open(str(path), "w") as container:
        video = _stream(container, "libx264", 48, 64)
        sound = container.add_stream("aac", rate=44100)
        for i, image in enumerate(moving(12)):
            container.mux(video.encode(picture(image, 40 * i)))
        for i in range(20):
            frame = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), format="fltp", layout="mono")
            frame.sample_rate, frame.pts = 44100, 1024 * i
            container.mux(sound.encode(frame))
        container.mux(video.encode(None))
        container.mux(sound.encode(None))


def with_plain_sound(path: Path) -> None:
    """Uncompressed sound: 1.2 million samples, each one counted in the index."""
    with av.open(str(path), "w") as container:
        video = _stream(container, "libx264", 48, 64)
        sound = container.add_stream("pcm_s16le", rate=96000)
        for i, image in enumerate(moving(12)):
            container.mux(video.encode(picture(image, 40 * i)))
        for i in range(75):
            frame = av.AudioFrame.from_ndarray(np.zeros((1, 16000), np.int16), format="s16", layout="mono")
            frame.sample_rate, frame.pts = 96000, 16000 * i
            container.mux(sound.encode(frame))
        container.mux(video.encode(None))
        container.mux(sound.encode(None))


def with_cover(path: Path) -> None:
    """A cover picture, larger than the video, as a second video track."""
    with av.open(str(path), "w") as container:
        video = _stream(container, "libx264", 48, 64)
        cover = _stream(container, "mjpeg", 240, 320)
        cover.disposition = av.stream.Disposition.attached_pic
        for packet in cover.encode(picture(quadrants(240, 320), 0)):
            container.mux(packet)
        for i, image in enumerate(moving(12)):
            container.mux(video.encode(picture(image, 40 * i)))
        container.mux(video.encode(None))


def only_cover(path: Path) -> None:
    """A song with a cover picture."""
    with av.open(str(path), "w", format="mp4") as container:
        cover = _stream(container, "mjpeg", 240, 320)
        cover.disposition = av.stream.Disposition.attached_pic
        sound = container.add_stream("aac", rate=44100)
        container.mux(cover.encode(picture(quadrants(240, 320), 0)))
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), format="fltp", layout="mono")
        frame.sample_rate = 44100
        container.mux([*sound.encode(frame), *sound.encode(None)])


def several_tracks(path: Path) -> None:
    """A small track first, the main one second, both of equal rank."""
    with av.open(str(path), "w") as container:
        streams = [_stream(container, "libx264", 32, 32), _stream(container, "libx264", 48, 64)]
        for stream in streams:
            stream.disposition = av.stream.Disposition.default
        for i in range(12):
            for stream in streams:
                container.mux(stream.encode(picture(moving(1, stream.height, stream.width)[0], 40 * i)))
        for stream in streams:
            container.mux(stream.encode(None))


def personal(path: Path) -> None:
    """A clip that says where and by whom it was filmed."""
    good = make_clip(path.with_name("good.mp4"), moving(12))
    tag(good, path)


def tag(source: Path, target: Path) -> None:
    """Copy ``source`` with :data:`PERSONAL` in its metadata."""
    options = {"movflags": "use_metadata_tags"}
    with av.open(str(source)) as old, av.open(str(target), "w", options=options) as new:
        new.metadata.update(PERSONAL)
        stream = new.add_stream_from_template(old.streams.video[0])
        for packet in old.demux(old.streams.video[0]):
            if packet.dts is not None:
                packet.stream = stream
                new.mux(packet)


def stuffed(path: Path) -> None:
    """A hundred kilobytes of padding and an unknown box in the index."""
    data = make_clip(path, moving(12)).read_bytes()
    data = append_to(data, box(b"free", bytes(100_000)) + box(b"xyzw", b"?" * 500), b"moov")
    path.write_bytes(data)


def cut_short(path: Path) -> None:
    """A fragmented mp4 that stops in the middle, as a camera's does when its battery fails."""
    flags = "frag_keyframe+empty_moov+default_base_moof"
    data = make_clip(path, moving(40), movflags=flags, g="5").read_bytes()
    path.write_bytes(data[: len(data) * 6 // 10])


LONG_PAUSE = [0, 40, 80, 1480, 1520, 1560]
JITTER = [0, 33, 66, 133, 166, 200, 300, 340, 373, 400, 440, 480]

ODD: dict[str, Odd] = {
    "H.264 mp4": Odd(coded("libx264")),
    "H.264 mov": Odd(coded("libx264"), "clip.mov"),
    "HEVC mp4": Odd(coded("libx265", 48, 64, **_QUIET)),
    "VP8 webm": Odd(coded("libvpx"), "clip.webm"),
    "VP9 webm": Odd(coded("libvpx-vp9"), "clip.webm"),
    "VP9 mp4": Odd(coded("libvpx-vp9")),
    "AV1 webm": Odd(coded("libsvtav1", 96, 128), "clip.webm", size=(96, 128)),
    "AV1 mp4": Odd(coded("libsvtav1", 96, 128), size=(96, 128)),
    "MPEG-4 mkv": Odd(coded("mpeg4"), "clip.mkv"),
    "ProRes mov": Odd(coded("prores_ks", pix_fmt="yuv422p10le"), "clip.mov"),
    "webm named mp4": Odd(coded("libvpx-vp9", format="webm")),
    "fragmented": Odd(coded("libx264", movflags="frag_keyframe+empty_moov+default_base_moof")),
    "index first": Odd(coded("libx264", movflags="+faststart")),
    "odd size VP9": Odd(coded("libvpx-vp9", 17, 33), "clip.webm", size=(17, 33)),
    "odd size H.264": Odd(coded("libx264", 17, 33, pix_fmt="yuv444p"), size=(17, 33)),
    "one pixel high": Odd(coded("libx264", 1, 64, pix_fmt="yuv444p"), size=(1, 64)),
    "10-bit HLG HEVC": Odd(wide_range(18), "clip.mov", size=(64, 96)),
    "10-bit PQ HEVC": Odd(wide_range(16), "clip.mov", size=(64, 96)),
    "Dolby Vision over HLG": Odd(wide_range(18, b"dvh1"), "clip.mov", size=(64, 96)),
    "Dolby Vision alone": Odd(wide_range(2, b"dvh1"), "clip.mov", code="video.dolby_vision"),
    "turned 90": Odd(turned(90), size=(64, 48)),
    "turned 180": Odd(turned(180)),
    "turned 270": Odd(turned(270), size=(64, 48)),
    "mirrored": Odd(turned(0, mirror=True)),
    "mirrored and turned": Odd(turned(90, mirror=True), size=(64, 48)),
    "variable rate": Odd(timed(JITTER), last=0.48),
    "long pause": Odd(timed(LONG_PAUSE), frames=6, last=1.56),
    "late start": Odd(timed([5000 + 40 * i for i in range(12)])),
    "slow motion, 240 a second": Odd(timed([round(i * 25 / 6) for i in range(120)]), frames=120, last=0.496),
    "two frames": Odd(timed([0, 40]), frames=2, last=0.04),
    "B-frames": Odd(coded("libx264", bf="3")),
    "trimmed by an edit list": Odd(trimmed, frames=5, last=0.16),
    "delayed by an edit list": Odd(delayed),
    "with sound": Odd(with_sound),
    "with plain sound": Odd(with_plain_sound, "clip.mov"),
    "with a cover": Odd(with_cover),
    "only a cover": Odd(only_cover, code="video.no_video_track"),
    "several tracks": Odd(several_tracks, "clip.mkv"),
    "personal tags": Odd(personal),
    "stuffed index": Odd(stuffed),
    "cut short": Odd(cut_short, frames=None, warnings=["video.truncated"]),
}
