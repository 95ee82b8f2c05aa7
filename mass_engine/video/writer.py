"""Writing a video: H.264 in mp4, whole or not at all."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterable, Iterator
from fractions import Fraction
from itertools import chain
from pathlib import Path

import av
import numpy as np
from av.video.reformatter import ColorRange, Colorspace
from av.video.stream import VideoStream
from numpy.typing import NDArray

#: Encoders by preference; the second is part of every FFmpeg build.
_ENCODERS = ("libx264", "mpeg4")


def write_video(
    path: str | os.PathLike[str], frames: Iterable[NDArray[np.uint8]], fps: float, crf: int = 18
) -> int:
    """Encode ``frames`` uint8 [H,W,3] RGB, all of one size, to the mp4 ``path``; returns their number.

    ``crf`` is x264's quality (0 lossless, 51 worst). Odd sizes gain one repeated row or column. The file
    appears only when complete. Raises ValueError for no frames or frames of another shape.
    """
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(dir=target.parent, prefix=f".{target.name}.", suffix=".mp4")
    os.close(handle)
    try:
        count = _encode(temporary, iter(frames), fps, crf)
        os.chmod(temporary, 0o644)
        os.replace(temporary, target)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise
    return count


def _encode(path: str, frames: Iterator[NDArray[np.uint8]], fps: float, crf: int) -> int:
    first = next(frames, None)
    if first is None:
        raise ValueError("a video needs at least one frame")
    count = 0
    with av.open(path, "w", format="mp4", options={"movflags": "+faststart"}) as container:
        stream = _stream(container, first.shape[0], first.shape[1], fps, crf)
        for frame in chain([first], frames):
            if (
                frame.shape != first.shape
                or frame.dtype != np.uint8
                or frame.ndim != 3
                or frame.shape[2] != 3
            ):
                raise ValueError(f"frame {count} is {frame.dtype} {frame.shape}, not uint8 {first.shape}")
            padding = ((0, frame.shape[0] % 2), (0, frame.shape[1] % 2), (0, 0))
            picture = av.VideoFrame.from_ndarray(
                np.ascontiguousarray(np.pad(frame, padding, mode="edge")), format="rgb24"
            )
            # Tagged and converted alike, so that every reader gets the colours that went in.
            picture = picture.reformat(
                format="yuv420p", dst_colorspace=Colorspace.ITU709, dst_color_range=ColorRange.MPEG
            )
            picture.pts = count
            container.mux(stream.encode(picture))
            count += 1
        container.mux(stream.encode(None))
    return count


def _stream(
    container: av.container.OutputContainer, height: int, width: int, fps: float, crf: int
) -> VideoStream:
    available = [name for name in _ENCODERS if name in av.codecs_available]
    quality = {"crf": str(crf)} if available[0] == "libx264" else {"qscale": "3"}
    stream = container.add_stream(available[0], rate=Fraction(fps).limit_denominator(1001), options=quality)
    assert isinstance(stream, VideoStream)
    stream.width, stream.height = width + width % 2, height + height % 2
    stream.pix_fmt = "yuv420p"
    context = stream.codec_context
    context.colorspace, context.color_primaries, context.color_trc, context.color_range = 1, 1, 1, 1
    return stream
