"""Reading a pickle of arrays without running what it says.

A pickle is a program: an ordinary unpickler imports and calls whatever the file names. Here the only names
are those below, and each of them gives a stand-in of this module that records its arguments; numpy, scipy and
chumpy themselves are never called by the file. Files of Python 2 (MANO's are) and of Python 3 are understood.
"""

from __future__ import annotations

import io
import math
import pickle
import re
import struct
from collections.abc import Callable
from typing import Any, ClassVar, cast

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

#: Files larger than this are no hand model.
MOST_BYTES = 256 << 20
#: How deep chumpy arrays may be wrapped in one another.
_DEEPEST = 16
_SPARSE_MODULE = re.compile(r"scipy\.sparse(\.\w+)*")
_SPARSE_CLASS = re.compile(r"(csc|csr|coo)_(matrix|array)")
_CHUMPY_MODULE = re.compile(r"chumpy(\.\w+)*")
_DTYPE = re.compile(r"[<>|=]?([biu][1248]|f[248]|[?bBhHiIlLqQefd])")
_ANY_DTYPE = re.compile(_DTYPE.pattern + r"|\|?O8?|[<>|=]?[SU]\d{1,5}")


class UnsafePickleError(Exception):
    """The file names something that arrays do not need; the message says what."""


class _StandIn:
    """What the file says of one object. A file may skip ``__init__``: the defaults are the class's."""

    state: Any = None

    def __init__(self, *_: object) -> None:
        pass

    def __setstate__(self, state: Any) -> None:
        self.state = state


class PickledType(_StandIn):
    """Stand-in for ``numpy.dtype``."""

    spec: str = ""
    known: ClassVar[re.Pattern[str]] = _DTYPE

    def __init__(self, spec: object = "", *_: object) -> None:
        if not isinstance(spec, str) or self.known.fullmatch(spec) is None:
            raise UnsafePickleError(f"an array of {str(spec)[:40]!r}, which are not plain numbers")
        self.spec = spec

    @property
    def dtype(self) -> np.dtype[Any]:
        """The type, in the file's byte order."""
        order: Any = self.state[1] if self.state else "="
        plain = np.dtype(self.spec)
        return plain.newbyteorder(order) if order in ("<", ">") else plain


class PickledAnyType(PickledType):
    """The same where arrays may also hold text, or (in a list) objects."""

    known = _ANY_DTYPE


class PickledArray(_StandIn):
    """Stand-in for ``numpy.ndarray``; its state is (version, shape, type, Fortran order, bytes)."""


class PickledSparse(_StandIn):
    """Stand-in for a scipy.sparse matrix."""

    layout = ""


class PickledCsc(PickledSparse):
    """Compressed columns."""

    layout = "csc"


class PickledCsr(PickledSparse):
    """Compressed rows."""

    layout = "csr"


class PickledCoo(PickledSparse):
    """Rows, columns and values."""

    layout = "coo"


class PickledChumpy(_StandIn):
    """Stand-in for a ``chumpy`` array: a leaf with values ``x``, or a reordering of another one, ``a``."""


def load_arrays(data: bytes) -> dict[str, Any]:
    """The dictionary a pickle holds; its arrays are still stand-ins, see :func:`to_array`.

    Raises UnsafePickleError for a name that arrays do not need, ValueError for anything that is not a
    dictionary with names.
    """
    content = _load(_Unpickler, data)
    if not isinstance(content, dict):
        raise ValueError(f"the pickle holds a {type(content).__name__[:40]}, not a dictionary")
    return {str(name): value for name, value in content.items() if isinstance(name, str | bytes)}


def load_values(data: bytes) -> Any:
    """Whatever a pickle of lists, dictionaries, text, numbers and arrays holds; arrays are still stand-ins.

    Unlike :func:`load_arrays` also ordered and default dictionaries, and arrays of text or of objects (the
    object array's state then has a list of values instead of bytes). Raises as :func:`load_arrays`.
    """
    return _load(_ValueUnpickler, data)


def _load(machine: type[_Unpickler], data: bytes) -> Any:
    if len(data) > MOST_BYTES:
        raise ValueError(f"the file is larger than {MOST_BYTES >> 20} MiB")
    try:
        return machine(io.BytesIO(data), encoding="latin1").load()
    except UnsafePickleError:
        raise
    except Exception as error:  # what a broken program of pickle opcodes raises is open-ended
        raise ValueError(f"the pickle cannot be read ({type(error).__name__}: {str(error)[:120]})") from error


def to_array(value: object) -> NDArray[Any]:
    """The dense array behind a value of :func:`load_arrays`. Raises ValueError when there is none."""
    try:
        return _dense(value, _DEEPEST)
    except (TypeError, KeyError, IndexError, AttributeError, OverflowError, MemoryError) as error:
        raise ValueError(f"an array is broken ({type(error).__name__}: {str(error)[:120]})") from error


def _dense(value: object, depth: int) -> NDArray[Any]:
    if depth == 0:
        raise ValueError("arrays are wrapped in one another too deeply")
    if isinstance(value, PickledArray):
        _version, shape, kind, fortran, raw = value.state
        return _array(kind, raw, shape, "F" if fortran else "C")
    if isinstance(value, np.ndarray | np.generic | bool | int | float):
        return np.asarray(value)
    if isinstance(value, list | tuple) and all(isinstance(item, bool | int | float) for item in value):
        return np.asarray(value)
    if isinstance(value, PickledSparse):
        return _sparse(value, depth)
    if isinstance(value, PickledChumpy):
        return _chumpy(dict(value.state), depth)
    raise ValueError(f"a {type(value).__name__} is no array")


def _sparse(value: PickledSparse, depth: int) -> NDArray[Any]:
    state = dict(value.state)
    rows, columns = (int(size) for size in state.get("_shape", state.get("shape")) or ())
    if min(rows, columns) < 0 or rows * columns * 8 > MOST_BYTES:
        raise ValueError(f"a sparse matrix of {rows} x {columns}")
    data = _dense(state["data"], depth - 1)
    if value.layout == "coo":
        places = state["coords"] if "coords" in state else (state["row"], state["col"])
        pair = tuple(_dense(place, depth - 1) for place in places)
        return np.asarray(sp.coo_array((data, pair), shape=(rows, columns)).toarray())
    make = sp.csc_array if value.layout == "csc" else sp.csr_array
    indices, starts = (_dense(state[name], depth - 1) for name in ("indices", "indptr"))
    matrix = make((data, indices, starts), shape=(rows, columns))
    matrix.check_format(full_check=True)
    return np.asarray(matrix.toarray())


def _chumpy(state: dict[str, Any], depth: int) -> NDArray[Any]:
    if "x" in state:
        return _dense(state["x"], depth - 1)
    if "a" not in state:
        raise ValueError("a chumpy array is neither values nor a reordering of values")
    source = _dense(state["a"], depth - 1)
    if "idxs" in state:
        source = source.ravel()[_dense(state["idxs"], depth - 1).astype(np.int64).ravel()]
    shape = state.get("preferred_shape", state.get("newshape"))
    return source if shape is None else source.reshape(tuple(int(n) for n in shape))


def _array(kind: object, raw: object, shape: object, order: str) -> NDArray[Any]:
    if not isinstance(kind, PickledType):
        raise ValueError("an array has no type")
    data = raw.encode("latin1") if isinstance(raw, str) else raw
    if not isinstance(data, bytes):
        raise ValueError("an array has no bytes")
    dtype = kind.dtype
    if dtype.hasobject:
        raise ValueError("an array holds objects, not numbers")
    sizes = tuple(int(size) for size in cast("tuple[int, ...]", shape))
    if any(size < 0 for size in sizes) or math.prod(sizes) * dtype.itemsize != len(data):
        raise ValueError(f"an array of shape {sizes} does not fit its {len(data)} bytes")
    values = np.frombuffer(data, dtype).astype(dtype.newbyteorder("="))
    return values.reshape(sizes, order=cast("Any", order))


def _empty_array(*_: object) -> PickledArray:
    return PickledArray()


def _filled_array(raw: object, kind: object, shape: object, order: object) -> PickledArray:
    """How protocol 5 writes an array."""
    result = PickledArray()
    result.state = (1, shape, kind, order == "F", raw)
    return result


def _scalar(kind: object, raw: object) -> Any:
    return _array(kind, raw, (), "C")[()]


def _latin1(text: str, encoding: str = "latin1") -> bytes:
    """How Python 3 writes bytes in the older protocols."""
    if encoding not in ("latin1", "latin-1"):
        raise UnsafePickleError(f"the codec {str(encoding)[:40]!r}")
    return text.encode("latin1")


def _new_object(kind: object, *_: object) -> object:
    """``copy_reg._reconstructor``: how protocols 0 and 1 make an object."""
    if not (isinstance(kind, type) and issubclass(kind, _StandIn)):
        raise UnsafePickleError("an object of a kind that is no array")
    return kind()


def _nothing(*_: object) -> None:
    """A part of chumpy's bookkeeping that nobody needs."""


def _dictionary(*_: object) -> dict[Any, Any]:
    """An ordered or default dictionary; its items follow."""
    return {}


def _names() -> dict[tuple[str, str], Callable[..., Any]]:
    names: dict[tuple[str, str], Callable[..., Any]] = {
        ("numpy", "ndarray"): PickledArray,
        ("numpy", "dtype"): PickledType,
        ("_codecs", "encode"): _latin1,
        ("copyreg", "_reconstructor"): _new_object,
        ("builtins", "object"): _nothing,
        ("builtins", "set"): _nothing,
    }
    for core in ("numpy.core", "numpy._core"):
        names[core + ".multiarray", "_reconstruct"] = _empty_array
        names[core + ".multiarray", "scalar"] = _scalar
        names[core + ".numeric", "_frombuffer"] = _filled_array
    return names


class _Unpickler(pickle._Unpickler):
    """The unpickler written in Python: the one in C lets a file of ten bytes claim 64 GB for its memo."""

    dispatch: ClassVar[dict[int, Any]] = dict(pickle._Unpickler.dispatch)

    def find_class(self, module: str, name: str) -> Any:
        module = {"__builtin__": "builtins", "copy_reg": "copyreg"}.get(module, module)
        if (module, name) in _names():
            return _names()[module, name]
        if _SPARSE_MODULE.fullmatch(module) and (match := _SPARSE_CLASS.fullmatch(name)):
            return {"csc": PickledCsc, "csr": PickledCsr, "coo": PickledCoo}[match[1]]
        if _CHUMPY_MODULE.fullmatch(module) and name.isidentifier():
            return PickledChumpy
        raise UnsafePickleError(f"{module[:60]}.{name[:60]}")

    def _build(self) -> None:
        # The usual rule would also let the file set attributes of the stand-ins' own classes.
        if not isinstance(cast("Any", self).stack[-2], _StandIn):
            raise UnsafePickleError("a change of an object that is no array")
        cast("Any", pickle._Unpickler).load_build(self)

    def _bytes(self) -> None:
        # The usual rule makes room for as many bytes as the file claims before it reads them.
        machine = cast("Any", self)
        (size,) = struct.unpack("<Q", machine.read(8))
        machine.append(bytes(machine.read(min(size, MOST_BYTES))))

    def _refuse(self) -> None:
        raise UnsafePickleError("an extension, a persistent object or a buffer outside the file")

    dispatch[pickle.BUILD[0]] = _build
    dispatch[pickle.BYTEARRAY8[0]] = _bytes
    for _code in (pickle.EXT1, pickle.EXT2, pickle.EXT4, pickle.PERSID, pickle.BINPERSID, pickle.NEXT_BUFFER):
        dispatch[_code[0]] = _refuse


class _ValueUnpickler(_Unpickler):
    """For :func:`load_values`."""

    def find_class(self, module: str, name: str) -> Any:
        if module == "collections" and name in ("OrderedDict", "defaultdict"):
            return _dictionary
        if module in ("builtins", "__builtin__") and name in ("dict", "list"):
            return _nothing  # what a default dictionary fills itself with
        found = super().find_class(module, name)
        return PickledAnyType if found is PickledType else found
