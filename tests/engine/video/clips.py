"""Small videos made on the spot, good and bad."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from av.video.stream import VideoStream
from numpy.typing import NDArray

RED, GREEN, BLUE, GREY = (200, 40, 40), (40, 200, 40), (40, 40, 200), (120, 120, 120)


def quadrants(height: int = 48, width: int = 64) -> NDArray[np.uint8]:
    """Red and green above, blue and grey below: shows every turn and every mirroring."""
    image = np.empty((height, width, 3), np.uint8)
    image[: height // 2, : width // 2], image[: height // 2, width // 2 :] = RED, GREEN
    image[height // 2 :, : width // 2], image[height // 2 :, width // 2 :] = BLUE, GREY
    return image


def corner_colors(image: NDArray[np.uint8]) -> list[tuple[int, int, int]]:
    """The named colour nearest to the middle of each quadrant: above left, above right, below left, right."""
    height, width = image.shape[:2]
    named = np.array([RED, GREEN, BLUE, GREY])
    found = []
    for y in (height // 4, 3 * height // 4):
        for x in (width // 4, 3 * width // 4):
            nearest = named[np.abs(named - image[y, x]).sum(1).argmin()]
            found.append((int(nearest[0]), int(nearest[1]), int(nearest[2])))
    return found


@contextmanager
def encoder(
    path: Path, codec: str, height: int, width: int, pix_fmt: str = "yuv420p", **options: str
) -> Iterator[tuple[av.container.OutputContainer, VideoStream]]:
    """An open container with one video stream in milliseconds; flushed and closed on leaving."""
    if codec == "libx265":  # its reordered frames reach the muxer without a decoding time now and then
        options.setdefault("x265-params", "bframes=0:log-level=error")
    flags = {"movflags": options.pop("movflags")} if "movflags" in options else {}
    with av.open(str(path), "w", format=options.pop("format", None), options=flags) as container:
        stream = container.add_stream(codec, rate=25, options=options)
        assert isinstance(stream, VideoStream)
        stream.width, stream.height, stream.pix_fmt = width, height, pix_fmt
        stream.codec_context.time_base = Fraction(1, 1000)
        yield container, stream
        container.mux(stream.encode(None))


def picture(
    image: NDArray[np.uint8] | NDArray[np.uint16], milliseconds: int, layout: str = "rgb24"
) -> av.VideoFrame:
    """``image`` as a frame shown at ``milliseconds``."""
    frame = av.VideoFrame.from_ndarray(image, format=layout)
    frame.pts, frame.time_base = milliseconds, Fraction(1, 1000)
    return frame


def make_clip(
    path: Path,
    images: Sequence[NDArray[np.uint8]],
    times: Sequence[int] | None = None,
    codec: str = "libx264",
    **options: str,
) -> Path:
    """Encode ``images`` shown at ``times`` in milliseconds (25 a second when not given)."""
    height, width = images[0].shape[:2]
    with encoder(path, codec, height, width, **options) as (container, stream):
        for image, time in zip(images, times or range(0, 40 * len(images), 40), strict=True):
            container.mux(stream.encode(picture(image, time)))
    return path


def moving(count: int, height: int = 48, width: int = 64, seed: int = 0) -> list[NDArray[np.uint8]]:
    """Noise that rolls sideways, so that frames differ and compress badly."""
    rng = np.random.default_rng(seed)
    noise = rng.integers(0, 256, (height, width, 3), dtype=np.uint8)
    return [np.roll(noise, 3 * i, axis=1) for i in range(count)]


def make_audio(path: Path) -> Path:
    """A sound recording in an mp4."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("aac", rate=44100)
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 4096), np.float32), format="fltp", layout="mono")
        frame.sample_rate = 44100
        for packet in [*stream.encode(frame), *stream.encode(None)]:
            container.mux(packet)
    return path
