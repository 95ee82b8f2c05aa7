"""Byte surgery on ISO media files: boxes found, patched, put in, and built from nothing."""

from __future__ import annotations

import struct

_FOLDERS = (b"moov", b"trak", b"mdia", b"minf", b"dinf", b"stbl", b"edts", b"udta", b"moof", b"traf", b"mvex")


def box(kind: bytes, *content: bytes) -> bytes:
    """A box with its size in front."""
    body = b"".join(content)
    return struct.pack(">I", 8 + len(body)) + kind + body


def full_box(kind: bytes, *content: bytes, flags: int = 0, version: int = 0) -> bytes:
    """A box that begins with a version and flags."""
    return box(kind, struct.pack(">I", version << 24 | flags), *content)


def find(data: bytes, *path: bytes) -> tuple[int, int]:
    """(offset, size) of the first box at ``path``, such as ``b"moov", b"trak"``. Raises KeyError."""
    start, end = 0, len(data)
    size = 0
    for kind in path:
        while True:
            if start + 8 > end:
                raise KeyError(kind)
            size = struct.unpack_from(">I", data, start)[0]
            if data[start + 4 : start + 8] == kind:
                break
            start += max(size, 8)
        end = start + size
        start += 8
    return start - 8, size


def replace_box(data: bytes, new: bytes, *path: bytes) -> bytes:
    """``data`` with the box at ``path`` replaced by ``new``; the sizes of all around it follow.

    The media must come before the index, or its chunk offsets would be wrong.
    """
    at, size = find(data, *path)
    changed = bytearray(data[:at] + new + data[at + size :])
    for depth in range(1, len(path)):
        parent, length = find(data, *path[:depth])
        struct.pack_into(">I", changed, parent, length + len(new) - size)
    return bytes(changed)


def append_to(data: bytes, extra: bytes, *path: bytes) -> bytes:
    """``data`` with ``extra`` added at the end of the box at ``path``."""
    at, size = find(data, *path)
    return replace_box(data, box(path[-1], data[at + 8 : at + size], extra), *path)


def patch(data: bytes, where: int, new: bytes) -> bytes:
    """``data`` with ``new`` written over what is at ``where``."""
    return data[:where] + new + data[where + len(new) :]
