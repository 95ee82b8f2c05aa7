"""Pickles that would do harm: refused, and nothing happens."""

from __future__ import annotations

import contextlib
import os
import pickle
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mass_engine.errors import EngineError
from mass_engine.hand import safe_pickle
from mass_engine.hand.mano import read_mano
from mass_engine.hand.safe_pickle import UnsafePickleError, load_arrays, to_array
from tests.engine.hand.files import array, mano_arrays, mapping, new, number, text, write_mano


class Shell:
    """The classic: runs a command when it is unpickled."""

    def __init__(self, command: str) -> None:
        self.command = command

    def __reduce__(self) -> tuple[Any, tuple[str]]:
        return os.system, (self.command,)


@pytest.mark.parametrize("protocol", range(6))
def test_a_hostile_pickle_runs_nothing_and_says_what_it_asked_for(tmp_path: Path, protocol: int) -> None:
    mark = tmp_path / "it ran"
    arrays: dict[str, Any] = mano_arrays(1)
    arrays["weights"] = Shell(f"touch '{mark}'")
    path = tmp_path / "MANO_RIGHT.pkl"
    path.write_bytes(pickle.dumps(arrays, protocol))
    with pytest.raises(EngineError, match=r"(posix|nt|os)\.system") as caught:
        read_mano(path)
    assert caught.value.code == "template.unsafe_pickle"
    assert not mark.exists()


UNSAFE = {
    "eval": b"c__builtin__\neval\n(S'1'\ntR.",
    "exec": b"cbuiltins\nexec\n(S'1'\ntR.",
    "getattr": b"cbuiltins\ngetattr\n.",
    "import": b"c__builtin__\n__import__\n(S'os'\ntR.",
    "instance": b"(S'id'\nios\nsystem\n.",
    "object": b"(cos\nsystem\nS'id'\no.",
    "numpy load": b"cnumpy\nload\n(S'x.npy'\ntR.",
    "numpy fromfile": b"cnumpy\nfromfile\n.",
    "numpy testing": b"cnumpy.testing._private.utils\nrunstring\n.",
    "scipy load": b"cscipy.sparse\nload_npz\n.",
    "stack_global": b"\x80\x04\x8c\x02os\x8c\x06system\x93.",
    "nested name": b"\x80\x04\x8c\x08builtins\x8c\x0feval.__call__.x\x93.",
    "chumpy method": b"\x80\x04\x8c\x06chumpy\x8c\x0bCh.__init__\x93.",
    "safe module": b"cmass_engine.hand.safe_pickle\nload_arrays\n.",
    "bytearray": b"cbuiltins\nbytearray\n(J\xff\xff\xff\x7ftR.",
    "extension": b"\x80\x02\x82\x01.",
    "persistent": b"Pname\n.",
    "buffer": b"\x80\x05\x97.",
    "class state": b"cnumpy\nndarray\n}U\x01xK\x01sb.",
    "function state": b"c_codecs\nencode\nN}U\x0c__defaults__N\x86sb.",
    "codec": b"c_codecs\nencode\n(S'x'\nS'zlib'\ntR.",
    "objects": b"cnumpy\ndtype\n(U\x02O8K\x00K\x01tR.",
    "strange object": b"ccopy_reg\n_reconstructor\n(c__builtin__\nset\nc__builtin__\nobject\nNtR.",
}


@pytest.mark.parametrize("name", UNSAFE)
def test_names_that_arrays_do_not_need_are_refused(name: str) -> None:
    with pytest.raises((UnsafePickleError, ValueError)) as caught:
        load_arrays(UNSAFE[name])
    if name not in ("function state",):
        assert isinstance(caught.value, UnsafePickleError), caught.value


HEAVY = {
    "memo of 64 GB": b"\x80\x02Nr\xff\xff\xff\xff.",
    "bytes of 1 TB": b"\x80\x05\x96" + struct.pack("<Q", 1 << 40) + b"x.",
    "string of 1 TB": b"\x80\x04\x8d" + struct.pack("<Q", 1 << 40) + b"x.",
    "frame of 1 TB": b"\x80\x04\x95" + struct.pack("<Q", 1 << 40) + b"N.",
    "number of a million digits": b"I" + b"9" * 1_000_000 + b"\n.",
}


@pytest.mark.parametrize("name", HEAVY)
def test_claims_beyond_the_file_cost_nothing(name: str) -> None:
    with pytest.raises(ValueError, match=r"cannot be read|holds a"):
        load_arrays(HEAVY[name])


def loop() -> bytes:
    """A chumpy array that wraps itself."""
    return b"cchumpy.ch\nCh\n)\x81q\x01}U\x01xh\x01sb"


def matrix(rows: int, columns: int, index: int) -> bytes:
    state = {
        "_shape": number(rows) + number(columns) + b"\x86",
        "indices": array(np.array([index], np.int32)),
        "indptr": array(np.array([0, 1, 1], np.int32)),
        "data": array(np.array([1.0])),
    }
    return new("scipy.sparse.csc", "csc_matrix", state)


BROKEN = {
    "itself": loop(),
    "sparse giant": matrix(1 << 30, 1 << 30, 0),
    "sparse out of range": matrix(2, 2, 7),
    "sparse negative": matrix(2, 2, -1),
    "sparse empty": new("scipy.sparse.csr", "csr_matrix", {}),
    "short array": array(np.zeros(4)).replace(number(4), number(400_000_000)),
    "negative shape": array(np.zeros(4)).replace(number(4), number(-4)),
    "no state": b"cnumpy\nndarray\n)\x81",
    "no type": b"cnumpy\ndtype\n)\x81",
    "chumpy sum": new("chumpy.ch_ops", "add", {"left": b"N", "right": b"N"}),
    "chumpy indices": new(
        "chumpy.reordering", "Select", {"a": array(np.ones(3)), "idxs": array(np.array([9]))}
    ),
    "text": text("abc"),
    "nothing": b"N",
}


@pytest.mark.parametrize("name", BROKEN)
def test_broken_arrays_end_in_one_kind_of_error(name: str) -> None:
    content = load_arrays(b"\x80\x02" + mapping({"a": BROKEN[name]}) + b".")
    with pytest.raises((ValueError, UnsafePickleError)):
        to_array(content["a"])


def test_good_arrays_come_through() -> None:
    values = np.arange(6.0).reshape(2, 3)
    content = load_arrays(b"\x80\x02" + mapping({"a": array(values), "b": array(values, ">")}) + b".")
    np.testing.assert_array_equal(to_array(content["a"]), values)
    np.testing.assert_array_equal(to_array(content["b"]), values)
    assert to_array(content["b"]).dtype == np.float64


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    return write_mano(tmp_path_factory.mktemp("mano") / "m.pkl", mano_arrays(1)).read_bytes()


@settings(max_examples=40, deadline=None, derandomize=True)
@given(
    cut=st.integers(0, 20_000),
    flips=st.lists(st.tuples(st.integers(0, 4000), st.integers(0, 255)), max_size=4),
)
def test_damaged_files_end_in_an_error_or_are_read(
    whole: bytes, cut: int, flips: list[tuple[int, int]], tmp_path_factory: pytest.TempPathFactory
) -> None:
    data = bytearray(whole[: len(whole) - cut])
    for place, value in flips:
        data[place] = value
    path = tmp_path_factory.mktemp("damaged") / "m.pkl"
    path.write_bytes(data)
    # Anything but an EngineError, a crash or a hang fails the test.
    with contextlib.suppress(EngineError):
        read_mano(path)


def test_a_file_too_large_is_not_parsed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(safe_pickle, "MOST_BYTES", 100)
    with pytest.raises(ValueError, match="larger"):
        load_arrays(bytes(101))
