"""Pictures of a data set as a video that loses nothing: FFV1 of RGB in Matroska."""

from __future__ import annotations

from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from av.video.stream import VideoStream
from numpy.typing import NDArray


def write_lossless(path: Path, frames: Iterable[NDArray[np.uint8]], fps: float) -> int:
    """Write ``frames`` uint8 [H,W,3] RGB to ``path`` (.mkv); returns their number.

    Raises ValueError for frames of different sizes or none.
    """
    count, shape = 0, None
    with av.open(str(path), "w", format="matroska") as container:
        stream: VideoStream | None = None
        for frame in frames:
            if stream is None:
                shape = frame.shape
                made = container.add_stream("ffv1", rate=Fraction(fps).limit_denominator(1001))
                assert isinstance(made, VideoStream)
                stream = made
                stream.width, stream.height, stream.pix_fmt = frame.shape[1], frame.shape[0], "bgr0"
            if frame.shape != shape:
                raise ValueError(f"frame {count} is {frame.shape}, not {shape}")
            picture = av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), format="rgb24")
            picture = picture.reformat(format="bgr0")
            picture.pts = count
            container.mux(stream.encode(picture))
            count += 1
        if stream is None:
            raise ValueError("a video needs at least one frame")
        container.mux(stream.encode(None))
    return count
