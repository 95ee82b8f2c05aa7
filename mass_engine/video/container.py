"""Opening a video file safely: which container it is, by its first bytes, and nothing but that one file.

A demuxer chosen by probing may follow references to other files (a text playlist named ``.mp4`` does).
So the container is sniffed here, only two self-contained families are accepted, and the demuxer is named.
"""

from __future__ import annotations

import errno
import os
from pathlib import Path

import av
import av.container

from mass_engine.errors import EngineError
from mass_engine.video.limits import VideoLimits
from mass_engine.video.mp4_index import check_index

#: ISO base media and QuickTime files begin with one of these boxes (offset 4).
_MOV_BOXES = (b"ftyp", b"moov", b"mdat", b"wide", b"free", b"skip")
_EBML = b"\x1a\x45\xdf\xa3"

_RECORD_AGAIN = "Record or export the clip again as mp4, mov or webm."


def corrupt(reason: str) -> EngineError:
    """The one error for a file that cannot be decoded."""
    return EngineError(
        "video.corrupt",
        f"The video cannot be decoded ({reason}).",
        "Copy the file from the camera again: it may be cut off or damaged.",
    )


def sniff(head: bytes) -> str | None:
    """FFmpeg's demuxer name for a file that begins with ``head`` (12 bytes are enough), or None."""
    if head[4:8] in _MOV_BOXES:
        return "mov"
    if head[:4] == _EBML:
        return "matroska"
    return None


def open_container(path: str | os.PathLike[str], limits: VideoLimits) -> av.container.InputContainer:
    """Open ``path`` with the demuxer its first bytes name.

    Raises EngineError ``video.not_found``, ``video.empty``, ``video.too_large``,
    ``video.unsupported_container``, ``video.too_long``, ``video.too_many_edits``,
    ``video.too_many_pixels`` or ``video.corrupt``.
    """
    file = Path(path)
    try:
        size = file.stat().st_size if file.is_file() else None
        head = b"" if size is None else _head(file)
    except OSError as error:
        raise EngineError(
            "video.not_found", f"{file.name} cannot be read ({error.strerror}).", "Check its permissions."
        ) from error
    if size is None:
        raise EngineError("video.not_found", f"There is no file {file}.", "Check the path.")
    if size == 0:
        raise EngineError("video.empty", "The file is empty.", "Upload the clip again.")
    if size > limits.max_bytes:
        raise EngineError(
            "video.too_large",
            f"The file has {size / 1e6:.0f} MB; the limit is {limits.max_bytes / 1e6:.0f} MB.",
            "Trim the clip or export it at a lower resolution.",
        )
    demuxer = sniff(head)
    if demuxer is None:
        raise EngineError(
            "video.unsupported_container", "The file is not an mp4, mov, webm or mkv video.", _RECORD_AGAIN
        )
    if demuxer == "mov":
        with file.open("rb") as stream:
            check_index(stream, size, limits)
    # Coded sizes are padded to whole blocks, hence the slack; the exact cap is applied to decoded frames.
    options = {"max_pixels": str(limits.max_pixels + limits.max_pixels // 8), "protocol_whitelist": "file"}
    try:
        return av.open(f"file:{file.resolve()}", format=demuxer, options=options, metadata_errors="replace")
    except (av.FFmpegError, ValueError, OverflowError) as error:
        if isinstance(error, av.FFmpegError) and error.errno == errno.EINVAL and "avcodec" in str(error):
            raise too_many_pixels(limits) from error
        raise corrupt(reason_of(error)) from error


def reason_of(error: Exception) -> str:
    """FFmpeg's own words, without the path."""
    strerror = getattr(error, "strerror", None)
    return str(strerror or error).strip().lower() or type(error).__name__


def too_many_pixels(limits: VideoLimits, found: str = "The frames are too large") -> EngineError:
    """The one error for frames over ``limits.max_pixels``."""
    return EngineError(
        "video.too_many_pixels",
        f"{found}; the limit is {limits.max_pixels / 1e6:.1f} megapixels a frame.",
        "Export the clip at 1080p or below.",
    )


def _head(file: Path) -> bytes:
    with file.open("rb") as stream:
        return stream.read(16)
