"""What the index of an mp4 or mov file claims, looked at before a demuxer believes it.

A sample table can claim four thousand million samples of one size in twenty bytes, and a demuxer builds an
entry of about 70 bytes for each; an edit list repeats them. ISO/IEC 14496-12 has the boxes. They are found
by name wherever they stand, because demuxers, too, accept them in places where they do not belong.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import BinaryIO

from mass_engine.errors import EngineError
from mass_engine.video.limits import VideoLimits

#: Sound stored sample by sample: demuxers index it by chunks, so its large counts are harmless.
_PLAIN_SOUND = (b"lpcm", b"sowt", b"twos", b"in24", b"in32", b"fl32", b"fl64", b"raw ", b"ipcm", b"fpcm")
_CHUNK = 1024
_PADDING = (b"free", b"skip", b"wide")


def check_index(stream: BinaryIO, size: int, limits: VideoLimits) -> None:
    """Refuse a file of ``size`` bytes whose index is larger than any usable clip's.

    Raises EngineError ``video.too_long`` (too many samples), ``video.too_many_edits``,
    ``video.unsupported_container`` (a compressed index, which could hide all that).
    """
    samples, edits = 0, 1
    for content in _index_boxes(stream, size, limits):
        if b"cmov" in content and b"dcom" in content:
            raise EngineError(
                "video.unsupported_container",
                "The file's index is compressed.",
                "Record or export the clip again as mp4, mov or webm.",
            )
        edits = max([edits, *_numbers(content, b"elst", 4)])
        if edits > limits.max_edits:
            raise EngineError(
                "video.too_many_edits",
                f"The file's edit list has more than {limits.max_edits} entries.",
                "Export the edited clip again as a new video.",
            )
        samples += declared_samples(content)
        if samples * edits > limits.max_samples:  # each edit may repeat every sample
            raise _too_many(limits)


def declared_samples(content: bytes) -> int:
    """How many index entries the boxes in ``content`` make a demuxer build."""
    total = sum(_numbers(content, b"trun", 4))
    for track in content.split(b"trak"):
        count = sum(_numbers(track, b"stsz", 8)) + sum(_numbers(track, b"stz2", 8))
        total += count // _CHUNK if _is_plain_sound(track) else count
    return total


def _too_many(limits: VideoLimits) -> EngineError:
    return EngineError(
        "video.too_long",
        f"The file's index is larger than that of a clip of {limits.max_seconds:.0f} s.",
        "Trim it to the part that shows the hand.",
    )


def _index_boxes(stream: BinaryIO, size: int, limits: VideoLimits) -> Iterator[bytes]:
    """The content of every outermost box but the media itself and padding."""
    at, room = 0, limits.max_index_bytes
    while at + 8 <= size:
        stream.seek(at)
        head = stream.read(24)
        length, kind = struct.unpack_from(">I4s", head)
        header = 8
        if length == 1 and len(head) >= 16:
            length, header = struct.unpack_from(">Q", head, 8)[0], 16
        elif length == 0:
            length = size - at
        if length < header:
            return
        # An index that was not yet valid while recording may stand inside padding; demuxers look there.
        hidden = kind in _PADDING and b"moov" not in head[header:]
        if kind != b"mdat" and not hidden:
            room -= min(length, size - at)
            if room < 0:
                raise _too_many(limits)
            stream.seek(at + header)
            yield stream.read(min(length, size - at) - header)
        at += length


def _numbers(content: bytes, kind: bytes, offset: int) -> Iterator[int]:
    """The 32-bit number ``offset`` bytes into each box ``kind`` in ``content``."""
    at = content.find(kind)
    while at >= 0 and at + 8 + offset <= len(content):
        yield struct.unpack_from(">I", content, at + 4 + offset)[0]
        at = content.find(kind, at + 4)


def _is_plain_sound(track: bytes) -> bool:
    formats = track.find(b"stsd")
    steps = track.find(b"stts")
    return (
        b"soun" in track
        and b"vide" not in track
        and track[formats + 16 : formats + 20] in _PLAIN_SOUND
        and track.count(b"stts") == 1
        and track[steps + 8 : steps + 12] == b"\0\0\0\1"  # one entry
        and track[steps + 16 : steps + 20] == b"\0\0\0\1"  # of one tick a sample
    )
