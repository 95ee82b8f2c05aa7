"""Files and options that cannot be used: a stable code each, and a hostile file runs nothing."""

from __future__ import annotations

import io
import os
import pickle
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mass_engine.errors import BadArgumentError, EngineError
from mass_engine.options import FitOptions
from mass_engine.tracking.imports.values import name_numbers, read_values
from mass_engine.tracks_spec import parse_tracks
from tests.engine.hand.files import mano_arrays
from tests.engine.tracking.import_files import flat, make_clip, network_output
from tests.engine.tracking.test_imports import load


def good() -> dict[str, Any]:
    return flat(network_output(make_clip(mano_arrays(3))))


class Shell:
    """Runs a command when it is unpickled."""

    def __init__(self, command: str) -> None:
        self.command = command

    def __reduce__(self) -> tuple[Any, tuple[str]]:
        return os.system, (self.command,)


def as_pickle(path: Path, value: Any) -> Path:
    file = path / "a.pkl"
    file.write_bytes(pickle.dumps(value))
    return file


def as_npy(path: Path, value: Any) -> Path:
    np.save(path / "a.npy", np.array(value, dtype=object), allow_pickle=True)
    return path / "a.npy"


def as_npz(path: Path, value: Any) -> Path:
    np.savez(path / "a.npz", more=np.array([value, value], dtype=object))
    return path / "a.npz"


def as_folder(path: Path, value: Any) -> Path:
    (path / "frames").mkdir()
    as_pickle(path / "frames", value)
    return path / "frames"


@pytest.mark.parametrize("write", [as_pickle, as_npy, as_npz, as_folder])
def test_a_hostile_file_runs_nothing(tmp_path: Path, write: Callable[[Path, Any], Path]) -> None:
    mark = tmp_path / "it ran"
    path = write(tmp_path, {**good(), "scaled_focal_length": Shell(f"touch '{mark}'")})
    for text in (str(path), f"wilor:{path}", f"harp:{path}", f"arctic:{path},mano={path}"):
        if text.startswith("arctic") and path.is_dir():
            continue
        with pytest.raises(EngineError) as caught:
            load(text)
        assert caught.value.code in ("tracks.unsafe_pickle", "template.unreadable", "template.unsafe_pickle")
    assert not mark.exists()


def test_tensors_are_named(tmp_path: Path) -> None:
    import torch

    with pytest.raises(EngineError, match=r"tracks\.unsafe_pickle.*torch.*numpy"):
        load(as_pickle(tmp_path, {"hand_pose": torch.zeros(1, 45)}))


def test_values_that_name_one_another_too_often_are_refused(tmp_path: Path) -> None:
    bomb: list[Any] = [np.zeros(10)]
    for _ in range(12):
        bomb = [bomb] * 10
    path = as_pickle(tmp_path, bomb)
    assert path.stat().st_size < 2000
    with pytest.raises(EngineError, match=r"tracks\.unreadable.*too many"):
        load(path)
    loop: list[Any] = []
    loop.append(loop)
    with pytest.raises(EngineError, match=r"tracks\.unreadable"):
        load(as_pickle(tmp_path, loop))


def test_cut_off_and_padded_files_are_refused(tmp_path: Path) -> None:
    for write in (as_pickle, as_npy):
        path = write(tmp_path, good())
        data = path.read_bytes()
        for end in (0, 3, 7, 60, len(data) // 2, len(data) - 1):
            path.write_bytes(data[:end])
            with pytest.raises(EngineError, match=r"tracks\.(unreadable|unknown_kind)"):
                load(path)
    np.savez(tmp_path / "b.npz", **good())
    data = (tmp_path / "b.npz").read_bytes()
    for end in (4, 100, len(data) // 2, len(data) - 1):
        (tmp_path / "b.npz").write_bytes(data[:end])
        with pytest.raises(EngineError, match=r"tracks\.unreadable"):
            load(tmp_path / "b.npz")


def npy(header: str, data: bytes, version: int = 1) -> bytes:
    text = header.encode()
    size = len(text).to_bytes(2 if version == 1 else 4, "little")
    return b"\x93NUMPY" + bytes([version, 0]) + size + text + data


NPY = {
    "short": npy("{'descr': '<f8', 'fortran_order': False, 'shape': (400000000,), }", b"x" * 16),
    "negative": npy("{'descr': '<f8', 'fortran_order': False, 'shape': (-2,), }", b"x" * 16),
    "fields": npy("{'descr': [('a', '<f8')], 'fortran_order': False, 'shape': (1,), }", b"x" * 8),
    "object fields": npy("{'descr': [('a', 'O')], 'fortran_order': False, 'shape': (1,), }", b"N."),
    "time": npy("{'descr': '<M8[s]', 'fortran_order': False, 'shape': (1,), }", b"x" * 8),
    "version": npy("{'descr': '<f8', 'fortran_order': False, 'shape': (1,), }", b"x" * 8, 9),
    "header": npy("{'descr': __import__('os').system('true')}", b""),
    "open header": npy("{'descr': '<f8', 'fortran_order': False, 'shape': (1, ", b"x" * 8),
    "long header": npy("(" * 20000, b"", 2),
}


@pytest.mark.parametrize("name", NPY)
def test_broken_npy_headers_are_refused(tmp_path: Path, name: str) -> None:
    (tmp_path / "a.npy").write_bytes(NPY[name])
    with pytest.raises(EngineError, match=r"tracks\.unreadable"):
        read_values(tmp_path / "a.npy")


def test_an_npz_that_unpacks_to_gigabytes_is_refused_unread(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "a.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("hand_pose.npy", bytes(300 << 20))
    with pytest.raises(EngineError, match="unpacks to 300 MiB"):
        load(tmp_path / "a.npz")


def test_forms_of_npy_that_numpy_writes_are_read(tmp_path: Path) -> None:
    for values in (
        np.arange(6, dtype=">i4").reshape(2, 3),
        np.asfortranarray(np.random.default_rng(0).random((3, 4))),
        np.array([[1.5]], np.float16),
        np.zeros((0, 3)),
        np.array(True),
    ):
        np.save(tmp_path / "a.npy", values)
        np.testing.assert_array_equal(read_values(tmp_path / "a.npy"), values)
    file = io.BytesIO()
    np.lib.format.write_array(file, np.eye(2), version=(2, 0))
    (tmp_path / "a.npy").write_bytes(file.getvalue())
    np.testing.assert_array_equal(read_values(tmp_path / "a.npy"), np.eye(2))
    np.save(tmp_path / "a.npy", np.array(["ab", "c"]))
    assert read_values(tmp_path / "a.npy") == ["ab", "c"]


def spoil(output: dict[str, Any], change: str) -> None:
    if change == "45 of 15 joints":
        output["hand_pose"] = output["hand_pose"][:, :14]
    elif change == "global_orient":
        del output["global_orient"]
    elif change == "is for 3 hands":
        output["global_orient"] = output["global_orient"][:3]
    elif change == "not rotations":
        output["hand_pose"] = output["hand_pose"] * 1.2
    elif change == "are not rotations":
        output["hand_pose"] = -output["hand_pose"]  # reflections
    elif change == "no frame holds a hand":
        output["hand_pose"] = output["hand_pose"] * np.nan
    elif change == "betas has shape":
        output["betas"] = output["betas"][:, :7]
    elif change == "pred_cam_t_full, or pred_cam":
        del output["box_size"]
    elif change == "not positive":
        output["box_size"] = -output["box_size"]
    elif change == "hands are .* m long":
        output["pred_keypoints_3d"] = output["pred_keypoints_3d"] * 1000
    elif change == "several sizes":
        output["img_size"][2] = (320, 240)
    elif change == "a side is called":
        output["right"] = ["right", "both", "left", "right", "left"]
    elif change == "sides are given for":
        output["right"] = np.ones(3)
    else:
        output["hand_pose"] = "hand"


@pytest.mark.parametrize(
    "change",
    [
        "45 of 15 joints",
        "global_orient",
        "is for 3 hands",
        "not rotations",
        "are not rotations",
        "no frame holds a hand",
        "betas has shape",
        "pred_cam_t_full, or pred_cam",
        "not positive",
        "hands are .* m long",
        "several sizes",
        "a side is called",
        "sides are given for",
        "not made of numbers",
    ],
)
def test_what_does_not_fit_is_named(tmp_path: Path, change: str) -> None:
    output = good()
    spoil(output, change)
    wanted = "hand_pose has shape" if change.startswith("45") else change
    with pytest.raises(EngineError, match=wanted) as caught:
        load(as_pickle(tmp_path, output))
    assert caught.value.code == "tracks.invalid"


def test_other_content_is_of_an_unknown_kind(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", vertices=np.zeros((3, 3)))
    with pytest.raises(EngineError, match=r"tracks\.unknown_kind.*vertices"):
        load(tmp_path / "a.npz")
    for kind in ("wilor", "hamer", "harp"):
        with pytest.raises(EngineError, match=r"tracks\.invalid"):
            load(f"{kind}:{tmp_path / 'a.npz'}", size=(448, 448))
    (tmp_path / "folder").mkdir()
    with pytest.raises(EngineError, match=r"tracks\.unreadable"):
        load(tmp_path / "folder")
    (tmp_path / "list.json").write_text("[1, 2]")
    with pytest.raises(EngineError, match=r"tracks\.invalid"):
        load(tmp_path / "list.json")


def test_a_file_without_sides_is_taken_as_right_or_as_told(tmp_path: Path) -> None:
    output = good()
    del output["right"]
    path = as_pickle(tmp_path, output)
    for side, expected in (("auto", "right"), ("right", "right"), ("left", "left")):
        loaded = load(path, side=side)
        assert loaded.tracks.pose.side == expected
        assert "tracks.side_assumed" in {code for code, _, _ in loaded.notes}
    with pytest.raises(EngineError, match=r"tracks\.no_hand"):
        load(as_pickle(tmp_path, good()), side="left")


def test_the_option_is_parsed(tmp_path: Path) -> None:
    odd = tmp_path / "my,offset=odd, file=1.npz"
    odd.touch()
    mano = tmp_path / "m.pkl"
    mano.touch()
    spec = parse_tracks(f"hamer:{odd},offset=-3,undistorted=yes,mano={mano}")
    assert (spec.kind, spec.path, spec.offset, spec.undistorted, spec.mano) == ("hamer", odd, -3, True, mano)
    assert parse_tracks(str(odd)).kind == "auto"
    for tail, code in (
        (",offset=x", "tracks.option"),
        (",offset=1,offset=2", "tracks.option"),
        (",undistorted=perhaps", "tracks.option"),
        (",mano=nowhere.pkl", "tracks.not_found"),
        (".gone", "tracks.not_found"),
    ):
        with pytest.raises(BadArgumentError) as caught:
            FitOptions(tracks=f"{odd}{tail}")
        assert caught.value.code == code


def test_the_frame_s_number_is_the_one_that_counts() -> None:
    assert name_numbers(["a/0001_mano.pkl", "a/0002_mano.pkl"]) == [1, 2]
    assert name_numbers(["take2_000005_0.npz", "take2_000006_1.npz", "take2_000007_0.npz"]) == [5, 6, 7]
    assert name_numbers(["left", "right"]) is None
