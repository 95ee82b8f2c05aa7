"""Reading a video upright, frame by frame, by its own timestamps, inside hard limits."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from fractions import Fraction

import av
import av.container
import cv2
import numpy as np
from av.video.stream import VideoStream
from numpy.typing import NDArray

from mass_engine.errors import EngineError
from mass_engine.video.color import to_rgb
from mass_engine.video.container import corrupt, open_container, reason_of, too_many_pixels
from mass_engine.video.focal_length import field_of_view
from mass_engine.video.limits import VideoLimits
from mass_engine.video.orientation import Orientation

#: Fewer decoded frames than this share of the declared number count as a truncated file.
_COMPLETE = 0.9
_DOLBY_TAGS = ("dvh1", "dvhe", "dva1", "dvav", "dav1")
_UNSPECIFIED = 2  # transfer characteristics: the file does not say


@dataclass(frozen=True)
class Frame:
    """One decoded picture: ``time`` in seconds since the first one, ``rgb`` uint8 [H,W,3], upright."""

    index: int
    time: float
    rgb: NDArray[np.uint8]


@dataclass(frozen=True)
class VideoInfo:
    """What the container declares: upright ``width`` and ``height``, ``frames`` (None when not declared),
    ``fps`` on average, ``duration`` in seconds (None when not declared), ``codec`` name, the ``rotation``
    that makes it upright, in degrees clockwise (0, 90, 180, 270), and the field of view ``fov`` of the longer
    side in degrees where the camera wrote its focal length."""

    width: int
    height: int
    frames: int | None
    fps: float
    duration: float | None
    codec: str
    rotation: int
    fov: float | None = None


@dataclass(frozen=True)
class VideoWarning:
    """Something a user should know about a video that is usable all the same.

    Codes: ``video.truncated`` (ends before its declared end), ``video.damaged`` (pictures were lost).
    """

    code: str
    message: str


def probe(path: str | os.PathLike[str], limits: VideoLimits | None = None) -> VideoInfo:
    """Describe a video after decoding its first frame. Raises EngineError as :func:`read_frames` does."""
    limits = limits or VideoLimits()
    with open_container(path, limits) as container:
        stream = _main_track(container)
        fps = float(stream.average_rate or stream.guessed_rate or 30)
        duration = _declared_seconds(container, stream)
        frames = stream.frames or None
        _check_length(frames, duration, limits)
        first = next(_decode(container, stream, limits, _Losses()), None)
        if first is None:
            raise corrupt("no picture could be decoded")
        _refuse_proprietary_colors(first, stream)
        orientation = Orientation.of(first)
        height, width = orientation.size(*_square_size(first, stream))
        codec = stream.codec_context.name
        fov = field_of_view(container.metadata | stream.metadata, width, height)
        return VideoInfo(width, height, frames, fps, duration, codec, orientation.degrees, fov)


def read_frames(
    path: str | os.PathLike[str],
    limits: VideoLimits | None = None,
    on_warning: Callable[[VideoWarning], None] | None = None,
) -> Iterator[Frame]:
    """Decode the main video track of ``path``, upright, one frame in memory at a time.

    A damaged or cut file yields what decodes; ``on_warning`` hears of it at the end. Raises EngineError
    with a code ``video.*``: ``not_found``, ``empty``, ``too_large``, ``unsupported_container``, ``corrupt``,
    ``no_video_track``, ``too_many_pixels``, ``too_long``, ``too_many_edits``, ``size_changes``,
    ``dolby_vision``, ``too_short`` (a single frame).
    """
    limits = limits or VideoLimits()
    with open_container(path, limits) as container:
        stream = _main_track(container)
        declared = stream.frames or None
        seconds = _declared_seconds(container, stream)
        _check_length(declared, seconds, limits)
        step = float(1 / (stream.average_rate or stream.guessed_rate or Fraction(30)))
        losses = _Losses()
        start: float | None = None
        time, index, shape = 0.0, 0, None
        for picture in _decode(container, stream, limits, losses):
            stamp = time + step if picture.time is None else float(picture.time)
            start = stamp if start is None else start
            # A damaged file may repeat or reverse timestamps; time must still pass.
            time = stamp - start if index == 0 or stamp - start > time else time + step
            if index >= limits.max_frames or time > limits.max_seconds:
                raise _too_long(limits)
            if index == 0:
                _refuse_proprietary_colors(picture, stream)
            rgb = _upright(picture, stream)
            if shape is not None and rgb.shape != shape:
                raise EngineError(
                    "video.size_changes",
                    "The picture size changes within the video.",
                    "Export the clip again at one fixed resolution.",
                )
            shape = rgb.shape
            yield Frame(index, time, rgb)
            index += 1
    _check_enough(index, losses)
    if on_warning is not None:
        _report_losses(index, declared, seconds, time + step, losses, on_warning)


@dataclass
class _Losses:
    """What went missing while decoding: ``pictures`` dropped, and why the stream ``ended`` early."""

    pictures: int = 0
    ended: str | None = None


def _main_track(container: av.container.InputContainer) -> VideoStream:
    """The track a player would show: the default one, else the one with the most pixels; no cover art."""
    tracks = [
        s
        for s in container.streams.video
        if s.codec_context is not None and not s.disposition & av.stream.Disposition.attached_pic
    ]
    if not tracks:
        raise EngineError(
            "video.no_video_track", "The file has no video track.", "Upload a video, not a sound recording."
        )
    default = av.stream.Disposition.default

    def rank(track: VideoStream) -> tuple[bool, int]:
        return bool(track.disposition & default), track.codec_context.width * track.codec_context.height

    return max(tracks, key=rank)


def _decode(
    container: av.container.InputContainer, stream: VideoStream, limits: VideoLimits, losses: _Losses
) -> Iterator[av.VideoFrame]:
    """Decoded pictures in display order; damaged packets are skipped and counted in ``losses``."""
    stream.thread_type = "AUTO"
    packets = container.demux(stream)
    while True:
        try:
            packet = next(packets)
        except StopIteration:
            return
        except av.FFmpegError as error:
            losses.ended = reason_of(error)
            return
        try:
            pictures = packet.decode()
        except av.FFmpegError:
            losses.pictures += 1
            continue
        for picture in pictures:
            if not isinstance(picture, av.VideoFrame) or picture.is_corrupt:
                losses.pictures += 1
                continue
            if picture.width * picture.height > limits.max_pixels:
                raise too_many_pixels(limits, f"The frames have {picture.width}x{picture.height} pixels")
            yield picture


def _refuse_proprietary_colors(picture: av.VideoFrame, stream: VideoStream) -> None:
    """Refuse Dolby Vision without a compatible base layer (profile 5): its colours are no known colour space.

    Its tracks carry a name of their own and leave the transfer function open; phones write profile 8.4,
    whose base layer is plain HLG and is tone-mapped like it.
    """
    tag = str(stream.codec_context.codec_tag).lower()
    if tag in _DOLBY_TAGS and int(picture.color_trc or _UNSPECIFIED) == _UNSPECIFIED:
        raise EngineError(
            "video.dolby_vision",
            "The video is Dolby Vision without a standard base layer.",
            "Export it as HDR (HLG) or SDR, or switch HDR video off in the camera's settings.",
        )


def _upright(picture: av.VideoFrame, stream: VideoStream) -> NDArray[np.uint8]:
    rgb = to_rgb(picture)
    height, width = _square_size(picture, stream)
    if rgb.shape[:2] != (height, width):
        rgb = np.asarray(cv2.resize(rgb, (width, height), interpolation=cv2.INTER_LINEAR), np.uint8)
    return Orientation.of(picture).apply(rgb)


def _square_size(picture: av.VideoFrame, stream: VideoStream) -> tuple[int, int]:
    """(height, width) with square pixels, before rotation: anamorphic video is widened."""
    ratio = stream.sample_aspect_ratio
    if not ratio or not Fraction(1, 4) <= ratio <= 4:
        return picture.height, picture.width
    return picture.height, max(1, round(picture.width * float(ratio)))


def _declared_seconds(container: av.container.InputContainer, stream: VideoStream) -> float | None:
    if stream.duration is not None and stream.time_base is not None:
        return float(stream.duration * stream.time_base)
    if container.duration is not None:
        return container.duration / av.time_base
    return None


def _check_length(frames: int | None, seconds: float | None, limits: VideoLimits) -> None:
    if (frames or 0) > limits.max_frames or (seconds or 0.0) > limits.max_seconds + 1.0:
        raise _too_long(limits)


def _check_enough(decoded: int, losses: _Losses) -> None:
    if decoded >= 2:
        return
    if losses.pictures or losses.ended or decoded == 0:
        raise corrupt(losses.ended or f"only {decoded} intact pictures")
    raise EngineError(
        "video.too_short", "The video has a single frame.", "Record a few seconds of the moving hand."
    )


def _too_long(limits: VideoLimits) -> EngineError:
    return EngineError(
        "video.too_long",
        f"The video is longer than {limits.max_seconds:.0f} s or {limits.max_frames} frames.",
        "Trim it to the part that shows the hand.",
    )


def _report_losses(
    decoded: int,
    declared: int | None,
    declared_seconds: float | None,
    seconds: float,
    losses: _Losses,
    on_warning: Callable[[VideoWarning], None],
) -> None:
    # An edit list may leave out many of the declared frames, and a last frame may stand for long.
    complete = declared is None and declared_seconds is None
    complete |= declared is not None and decoded >= _COMPLETE * declared
    complete |= declared_seconds is not None and seconds >= _COMPLETE * declared_seconds
    if not complete or losses.ended:
        of = f" of {declared} declared" if declared else ""
        on_warning(VideoWarning("video.truncated", f"The file ends early: {decoded} frames{of} were read."))
    elif losses.pictures:
        on_warning(VideoWarning("video.damaged", f"{losses.pictures} damaged pictures were left out."))
