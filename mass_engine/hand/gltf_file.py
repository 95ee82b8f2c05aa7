"""Reading glTF 2.0 files: the JSON, the buffers and the accessors, as far as a skinned mesh needs them.

Everything the file claims is checked against the bytes that are there, so that a broken or hostile file
ends in an error at once. Compressed (Draco, meshopt) and sparse data are refused by name.
"""

from __future__ import annotations

import base64
import binascii
import json
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from mass_engine.errors import EngineError

#: Limits on the file with its buffers, on its JSON, and on the length of each list in it.
MOST_BYTES, MOST_JSON, MOST_ITEMS = 256 << 20, 32 << 20, 100_000
_TYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": (1,), "VEC2": (2,), "VEC3": (3,), "VEC4": (4,), "MAT4": (4, 4)}
_COMPRESSED = ("KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_meshopt_compression")
_ADVICE = "Export the hand again as glTF 2.0 (.glb), with its skin, without compression."


def broken(problem: str) -> EngineError:
    """The error of a file that does not hold what it says."""
    return EngineError("template.gltf_invalid", f"The glTF file is broken: {problem}.", _ADVICE)


def unsupported(problem: str, advice: str = _ADVICE) -> EngineError:
    """The error of a file that is right but uses what is not read here."""
    return EngineError("template.gltf_unsupported", f"The glTF file {problem}.", advice)


@dataclass(frozen=True)
class GltfFile:
    """``content``: the JSON, its lists checked. ``buffers``: the bytes behind it."""

    content: dict[str, Any]
    buffers: tuple[bytes, ...]

    def items(self, name: str) -> list[dict[str, Any]]:
        """A top-level list of objects (nodes, meshes, skins); empty when there is none."""
        return cast("list[dict[str, Any]]", self.content.get(name, []))

    def item(self, name: str, index: object) -> dict[str, Any]:
        """One object of a top-level list."""
        values = self.items(name)
        if isinstance(index, bool) or not isinstance(index, int) or not 0 <= index < len(values):
            raise broken(f"there is no {name}[{str(index)[:20]}]")
        return values[index]

    def accessor(self, index: object, kind: tuple[str, ...]) -> NDArray[Any]:
        """The values of an accessor, one row per element; ``kind`` names the element types that will do.

        Normalised integers come as float64 from -1 or 0 to 1, everything else in the file's own type;
        matrices come row by row.
        """
        entry = self.item("accessors", index)
        if "sparse" in entry:
            raise unsupported("uses sparse accessors")
        if entry.get("type") not in kind or entry.get("componentType") not in _TYPES:
            raise broken(f"accessor {index} is {entry.get('type')} of {entry.get('componentType')}")
        if "bufferView" not in entry:
            raise broken(f"accessor {index} has no data")
        dtype, shape = np.dtype(_TYPES[entry["componentType"]]), _WIDTHS[entry["type"]]
        view = self.item("bufferViews", entry["bufferView"])
        if any(name in extensions(view) for name in _COMPRESSED):
            raise unsupported("is compressed (meshopt)")
        size = dtype.itemsize * int(np.prod(shape))
        count, start, inner = (
            _size(entry, "count"),
            _size(view, "byteOffset", 0),
            _size(entry, "byteOffset", 0),
        )
        step = _size(view, "byteStride", size)
        data = self._buffer(view)
        last = inner + step * (count - 1) + size
        if count < 1 or step < size or last > _size(view, "byteLength") or start + last > len(data):
            raise broken(f"accessor {index} reaches beyond its data")
        # Matrices are written column by column.
        inside = (dtype.itemsize,) if len(shape) == 1 else (dtype.itemsize, 4 * dtype.itemsize)
        values = np.ndarray((count, *shape), dtype, data, start + inner, (step, *inside)).copy()
        if entry.get("normalized") is True and dtype.kind in "iu":
            limit = float(np.iinfo(dtype).max)
            return np.maximum(values.astype(np.float64) / limit, -1.0)
        return values[:, 0] if shape == (1,) else values

    def _buffer(self, view: dict[str, Any]) -> bytes:
        index = view.get("buffer")
        if isinstance(index, bool) or not isinstance(index, int) or not 0 <= index < len(self.buffers):
            raise broken("a buffer is not there")
        return self.buffers[index]


def read_gltf(path: Path) -> GltfFile:
    """Read a .glb or .gltf file with its buffers.

    Raises EngineError ``template.unreadable``, ``template.gltf_invalid`` or ``template.gltf_unsupported``.
    """
    data = _read(path)
    first = None
    if data[:4] == b"glTF":
        data, first = _chunks(data)
    if len(data) > MOST_JSON:
        raise broken(f"its JSON has {len(data) >> 20} MiB")
    try:
        content = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise broken("it is neither GLB nor JSON") from error
    if not isinstance(content, dict) or not isinstance(content.get("asset"), dict):
        raise broken("it has no asset")
    version = str(content["asset"].get("version"))
    if not version.startswith("2."):
        raise unsupported(f"is of version {version[:10]}, not 2.0")
    needed = content.get("extensionsRequired", [])
    for name in needed if isinstance(needed, list) else []:
        if name in _COMPRESSED:
            raise unsupported(f"is compressed ({name})")
    for name in ("accessors", "buffers", "bufferViews", "meshes", "nodes", "skins"):
        value = content.setdefault(name, [])
        if not isinstance(value, list) or not all(isinstance(item, dict) for item in value):
            raise broken(f"{name} is no list of objects")
        if len(value) > MOST_ITEMS:
            raise broken(f"it has {len(value)} {name}")
    buffers: list[bytes] = []
    room = MOST_BYTES
    for number, entry in enumerate(content["buffers"]):
        buffers.append(_load_buffer(path, entry, first if number == 0 else None, room))
        room -= len(buffers[-1])
    return GltfFile(content, tuple(buffers))


def extensions(entry: dict[str, Any]) -> set[str]:
    """Names of the extensions an object uses."""
    value = entry.get("extensions")
    return set(value) if isinstance(value, dict) else set()


def _size(entry: dict[str, Any], name: str, default: int | None = None) -> int:
    value = entry.get(name, default)
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= 1 << 40:
        raise broken(f"{name} is {str(value)[:20]}")
    return value


def _read(path: Path, most: int = MOST_BYTES) -> bytes:
    try:
        if not path.is_file() or path.stat().st_size > most:
            raise OSError("it is no file or too large")
        return path.read_bytes()
    except OSError as error:
        raise EngineError("template.unreadable", f"{path.name} cannot be read ({error}).", _ADVICE) from error


def _chunks(data: bytes) -> tuple[bytes, bytes | None]:
    """The JSON and the binary chunk of a GLB."""
    found: dict[bytes, bytes] = {}
    try:
        version, length = struct.unpack_from("<II", data, 4)
        place = 12
        while place < min(length, len(data)) and len(found) < 2:
            size, kind = struct.unpack_from("<I4s", data, place)
            chunk = data[place + 8 : place + 8 + size]
            if len(chunk) < size:
                raise broken("it ends early")
            found[kind] = chunk
            place += 8 + size
    except struct.error as error:
        raise broken("it ends early") from error
    if version != 2:
        raise unsupported(f"is a GLB of version {version}, not 2")
    if length > len(data) or b"JSON" not in found:
        raise broken("it ends early")
    return found[b"JSON"], found.get(b"BIN\x00")


def _load_buffer(path: Path, entry: dict[str, Any], first: bytes | None, room: int) -> bytes:
    length, uri = _size(entry, "byteLength"), entry.get("uri")
    if uri is None:
        if first is None:
            raise broken("a buffer has no data")
        data = first
    elif not isinstance(uri, str):
        raise broken("a buffer's address is no text")
    elif uri.startswith("data:"):
        head, _, body = uri.partition(",")
        if not head.endswith(";base64"):
            raise broken("a buffer's data are not base64")
        try:
            data = base64.b64decode(body, validate=True)
        except (binascii.Error, ValueError) as error:
            raise broken("a buffer's data are not base64") from error
    else:
        folder = path.resolve().parent
        other = (folder / unquote(uri)).resolve() if "\x00" not in unquote(uri) else folder
        if "://" in uri or not other.is_relative_to(folder) or other == folder:
            raise unsupported("names data outside its own folder", "Export it as one .glb file.")
        data = _read(other, room)
    if length > len(data) or len(data) > room:
        raise broken("a buffer is shorter than it says, or too large")
    return data
