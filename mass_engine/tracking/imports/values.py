"""Files of arrays from other programs, read without running them, as plain dictionaries, lists and arrays.

An .npy of objects is a header and a pickle, an .npz a zip of .npy: whatever is pickled in them goes through
:mod:`mass_engine.hand.safe_pickle`; numpy's own loader never sees it.
"""

from __future__ import annotations

import io
import math
import re
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mass_engine.errors import EngineError
from mass_engine.hand.safe_pickle import (
    MOST_BYTES,
    PickledArray,
    UnsafePickleError,
    load_values,
    to_array,
)

#: Values in one file: thousands of frames with dozens of entries each.
_MOST_VALUES = 2_000_000
_DEEPEST = 16
_MOST_FILES = 100_000
_SUFFIXES = (".npz", ".pkl", ".pickle", ".npy")
_ADVICE = (
    "Give the .npz, .pkl or .npy that holds the arrays (numpy arrays, not torch tensors: .cpu().numpy())."
)


def read_values(path: Path) -> Any:
    """What the file ``path`` holds; its form is told by its content.

    Raises EngineError ``tracks.not_found``, ``tracks.unreadable`` or ``tracks.unsafe_pickle``.
    """
    try:
        if path.stat().st_size > MOST_BYTES:
            raise ValueError(f"it is larger than {MOST_BYTES >> 20} MiB")
        data = path.read_bytes()
    except OSError as error:
        raise EngineError("tracks.not_found", f"{path} cannot be read.", "Check the path.") from error
    except ValueError as error:
        raise EngineError("tracks.unreadable", f"{path.name} cannot be read: {error}.", _ADVICE) from error
    try:
        if data[:4] == b"PK\x03\x04":
            return _npz(data)
        if data[:6] == b"\x93NUMPY":
            return _npy(data)
        return _plain(load_values(data))
    except UnsafePickleError as error:
        raise EngineError(
            "tracks.unsafe_pickle",
            f"{path.name} asks for {error}, which is no plain array; it was not read.",
            "A pickle can run any program. Save plain numpy arrays (torch tensors: .cpu().numpy()).",
        ) from error
    except (ValueError, OverflowError, MemoryError) as error:
        raise EngineError("tracks.unreadable", f"{path.name} cannot be read: {error}.", _ADVICE) from error


def folder_files(path: Path) -> list[Path]:
    """The .npz, .pkl and .npy files of a folder by name. Raises EngineError ``tracks.unreadable``."""
    files = sorted(entry for entry in path.iterdir() if entry.suffix in _SUFFIXES and entry.is_file())
    if not 0 < len(files) <= _MOST_FILES:
        raise EngineError(
            "tracks.unreadable", f"{path.name} holds {len(files)} .npz, .pkl or .npy files.", _ADVICE
        )
    return files


def name_numbers(names: Sequence[str]) -> list[int] | None:
    """The frame number in each name, or None when some name has none.

    Of several numbers in a name, as in ``clip2_000017_0``, it is the one that differs most from name to name.
    """
    groups = [[int(number) for number in re.findall(r"\d{1,12}", Path(name).stem)] for name in names]
    count = min((len(group) for group in groups), default=0)
    if count == 0:
        return None
    best = max(range(count), key=lambda place: len({group[place] for group in groups}))
    return [group[best] for group in groups]


def _npz(data: bytes) -> dict[str, Any]:
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            unpacked = sum(entry.file_size for entry in archive.infolist())
            if unpacked > MOST_BYTES:
                raise ValueError(f"it unpacks to {unpacked >> 20} MiB")
            return {name.removesuffix(".npy"): _npy(archive.read(name)) for name in archive.namelist()}
    except (zipfile.BadZipFile, EOFError, KeyError, NotImplementedError, RuntimeError, zlib.error) as error:
        raise ValueError(f"not npz ({error})") from error


def _npy(data: bytes) -> Any:
    file = io.BytesIO(data)
    version = np.lib.format.read_magic(file)
    if version not in ((1, 0), (2, 0)):
        raise ValueError(f"npy version {version}")
    read = np.lib.format.read_array_header_1_0 if version[0] == 1 else np.lib.format.read_array_header_2_0
    try:
        shape, fortran, dtype = read(file)
    except Exception as error:  # the header is a Python literal; its tokenizer has errors of its own
        raise ValueError(f"its header is broken ({str(error)[:120]})") from error
    rest = data[file.tell() :]
    if dtype.hasobject:
        if dtype.names is not None:
            raise ValueError("an array with named fields")
        return _plain(load_values(rest))
    if dtype.kind not in "biufSU" or any(size < 0 for size in shape):
        raise ValueError(f"an array of {dtype}")
    if math.prod(shape) * dtype.itemsize != len(rest):
        raise ValueError(f"an array of shape {shape} does not fit its {len(rest)} bytes")
    values = np.frombuffer(rest, dtype).reshape(shape, order="F" if fortran else "C")
    return _single(values.astype(dtype.newbyteorder("=")))


def _single(array: NDArray[Any]) -> Any:
    """Text as lists of str, numbers as they are."""
    return array.tolist() if array.dtype.kind in "SU" else array


def _plain(value: object) -> Any:
    left = _MOST_VALUES
    ready: dict[int, Any] = {}  # stand-ins already made arrays; the file may name one many times

    def convert(item: Any, depth: int) -> Any:
        nonlocal left
        left -= 1
        if left < 0 or depth > _DEEPEST:
            raise ValueError("its values are too many or too deeply nested")
        if isinstance(item, dict):
            return {key: convert(part, depth + 1) for key, part in item.items()}
        if isinstance(item, list | tuple):
            if len(item) > 16 and all(isinstance(part, int | float) for part in item):
                return np.asarray(item)
            return [convert(part, depth + 1) for part in item]
        if isinstance(item, PickledArray):
            if id(item) not in ready:
                ready[id(item)] = array(item, depth)
            return ready[id(item)]
        if item is None or isinstance(item, str | bytes | bool | int | float | np.generic):
            return item
        return to_array(item)

    def array(item: PickledArray, depth: int) -> Any:
        try:
            _version, shape, kind, _fortran, raw = item.state
            objects = kind.dtype.hasobject
        except (TypeError, ValueError, AttributeError) as error:
            raise ValueError("an array has no state") from error
        if not objects:
            return _single(to_array(item))
        if not isinstance(raw, list) or not isinstance(shape, tuple) or math.prod(shape) != len(raw):
            raise ValueError("an array of objects is broken")
        return convert(raw[0] if shape == () else raw, depth + 1)

    return convert(value, 0)
