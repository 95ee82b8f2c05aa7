"""MANO hands (Romero, Tzionas and Black 2017, Embodied Hands) from the file of somebody who has one.

Read are the pickle as distributed, and the same arrays as .npz or .safetensors (:meth:`ManoFile.save` writes
both, ``python -m mass_engine.hand.mano IN OUT`` converts). Nothing of MANO comes with this program.

A pose inside the engine is relative to the flat rest hand: zero is flat. The file's mean pose is added only
where parameters come in that were written relative to it: :meth:`ManoFile.hand_pose`.
"""

from __future__ import annotations

import argparse
import io
import sys
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.numpy import load as load_safetensors
from safetensors.numpy import save_file
from torch import Tensor

from mass_engine.errors import EngineError
from mass_engine.hand.model import HandModel
from mass_engine.hand.pose import JOINT_PARENTS, Side
from mass_engine.hand.rigging import estimate_tips
from mass_engine.hand.safe_pickle import MOST_BYTES, UnsafePickleError, load_arrays, to_array

Array = NDArray[np.float64]

#: Vertices that stand for the five fingertips (thumb, index, middle, ring, pinky) on the 778 of MANO.
TIP_VERTICES: dict[str, tuple[int, ...]] = {
    "smplx": (744, 320, 443, 554, 671),
    "manopth": (745, 317, 444, 556, 673),
}
_VERTICES = 778
_ADVICE = "Give MANO_RIGHT.pkl or MANO_LEFT.pkl as distributed, or the same arrays as .npz or .safetensors."
#: Wrist to middle knuckle of a hand in metres, with room for every hand there is.
_PALM_LENGTHS = (0.04, 0.2)


@dataclass(frozen=True)
class ManoFile:
    """The arrays of one file, float64, names as in the file.

    ``v_template`` [V,3] metres; ``f`` [F,3] int64; ``shapedirs`` [V,3,K], the left hand's sign fault already
    put right; ``posedirs`` [V,3,135]; ``J_regressor`` [16,V]; ``weights`` [V,16]; ``hands_mean`` [45] and
    ``hands_components`` [N,45] (rows), the mean pose and the principal components about it.
    """

    side: Side
    v_template: Array
    f: NDArray[np.int64]
    shapedirs: Array
    posedirs: Array
    J_regressor: Array
    weights: Array
    hands_mean: Array
    hands_components: Array
    sign_fault: bool = False  # shapedirs came with it

    def model(self, tips: str = "smplx", dtype: torch.dtype = torch.float32) -> HandModel:
        """The hand model; ``tips`` (smplx, manopth) says which vertices its fingertips are.

        A mesh that has not MANO's 778 vertices gets fingertips from its shape. Ten shape parameters are
        used; fewer are filled up with parameters that do nothing.
        """
        count = min(10, self.shapedirs.shape[2])
        shape = np.zeros((*self.v_template.shape, 10))
        shape[..., :count] = self.shapedirs[..., :count]
        joints = self.J_regressor @ self.v_template
        joint_shape = np.einsum("jv,vck->jck", self.J_regressor, shape)
        if len(self.v_template) == _VERTICES:
            rows = list(TIP_VERTICES[tips])
            ends, end_shape = self.v_template[rows], shape[rows]
        else:
            ends, nearest = estimate_tips(self.v_template, joints, self.weights)
            end_shape = shape[nearest]
        values: dict[str, Array] = {
            "template": self.v_template,
            "shape_basis": shape,
            "joint_template": np.concatenate([joints, ends]),
            "joint_shape_basis": np.concatenate([joint_shape, end_shape]),
            "weights": self.weights / self.weights.sum(1, keepdims=True),
            "pose_basis": self.posedirs,
        }
        tensors = {name: torch.tensor(value, dtype=dtype) for name, value in values.items()}
        return HandModel.from_tensors(self.side, {**tensors, "faces": torch.from_numpy(self.f)})

    def hand_pose(self, parameters: Tensor, *, pca: bool = False, flat_hand_mean: bool = False) -> Tensor:
        """Finger parameters of this file's side as other programs write them -> axis-angles [...,45].

        ``pca``: they are coefficients [...,N] of the first N components. ``flat_hand_mean`` False, MANO's
        own convention (also of ARCTIC and HARP): they are relative to the mean pose, which is added.
        """
        known = len(self.hands_components) if pca else 45
        if not (1 <= parameters.shape[-1] <= known) or (not pca and parameters.shape[-1] != 45):
            raise EngineError(
                "pose.shape",
                f"{parameters.shape[-1]} finger parameters do not fit this MANO file.",
                f"Give 1 to {known} principal components." if pca else "Give 45 axis-angle numbers.",
            )
        pose = parameters
        if pca:
            pose = parameters @ torch.from_numpy(self.hands_components[: parameters.shape[-1]]).to(parameters)
        return pose if flat_hand_mean else pose + torch.from_numpy(self.hands_mean).to(pose)

    def tips(self, vertices: Tensor, convention: str = "smplx") -> Tensor:
        """Fingertips [...,5,3] read off posed vertices [...,778,3], thumb first."""
        return vertices[..., list(TIP_VERTICES[convention]), :]

    def save(self, path: Path) -> None:
        """Write the arrays as .npz or .safetensors, whichever ``path`` ends with."""
        arrays = {field.name: np.ascontiguousarray(getattr(self, field.name)) for field in fields(self)[1:-1]}
        parents = np.array(JOINT_PARENTS)
        arrays["kintree_table"] = np.stack([parents, np.arange(16)]).astype(np.int64)
        if path.suffix == ".npz":
            with path.open("wb") as file:
                np.savez_compressed(file, allow_pickle=False, **arrays)
        else:
            save_file(arrays, path)


def read_mano(path: Path) -> ManoFile:
    """Read a MANO file of either side; the form is told by its content, the side by its geometry.

    Raises EngineError ``template.unreadable``, ``template.unsafe_pickle``, ``template.incomplete``.
    """
    try:
        if path.stat().st_size > MOST_BYTES:
            raise ValueError(f"it is larger than {MOST_BYTES >> 20} MiB")
        arrays = _read_arrays(path.read_bytes())
    except UnsafePickleError as error:
        raise EngineError(
            "template.unsafe_pickle",
            f"{path.name} asks for {error}, which no MANO file needs; it was not read.",
            "A pickle can run any program. Get MANO from its own site.",
        ) from error
    except (ValueError, OSError, MemoryError) as error:
        raise EngineError("template.unreadable", f"{path.name} cannot be read: {error}.", _ADVICE) from error
    try:
        return _checked(arrays)
    except ValueError as error:
        raise EngineError(
            "template.incomplete", f"{path.name} is no whole MANO hand: {error}.", _ADVICE
        ) from error


_NAMES = tuple(field.name for field in fields(ManoFile)[1:-1])


def _read_arrays(data: bytes) -> dict[str, NDArray[Any]]:
    wanted = (*_NAMES, "kintree_table")
    if data[:4] == b"PK\x03\x04":
        return _read_npz(data, wanted)
    if data[8:9] == b"{":
        try:
            tensors = load_safetensors(data)
        except Exception as error:  # the library raises classes of its own
            raise ValueError(f"not safetensors ({error})") from error
        return {name: tensors[name] for name in wanted if name in tensors}
    content = load_arrays(data)
    return {name: to_array(content[name]) for name in wanted if name in content}


def _read_npz(data: bytes, wanted: Sequence[str]) -> dict[str, NDArray[Any]]:
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            unpacked = sum(entry.file_size for entry in archive.infolist())
        if unpacked > MOST_BYTES:
            raise ValueError(f"it unpacks to {unpacked >> 20} MiB")
        with np.load(io.BytesIO(data), allow_pickle=False) as file:
            return {name: np.asarray(file[name]) for name in wanted if name in file.files}
    except (zipfile.BadZipFile, EOFError, KeyError, NotImplementedError, RuntimeError, zlib.error) as error:
        raise ValueError(f"not npz ({error})") from error


def _checked(arrays: Mapping[str, NDArray[Any]]) -> ManoFile:
    """The file whose arrays these are. Raises ValueError."""
    missing = [name for name in (*_NAMES[:6], "kintree_table") if name not in arrays]
    if missing:
        raise ValueError(f"it lacks {', '.join(missing)}")
    count, faces = len(arrays["v_template"]), len(arrays["f"])
    shapes: dict[str, tuple[int | None, ...]] = {
        "v_template": (count, 3),
        "f": (faces, 3),
        "shapedirs": (count, 3, None),
        "posedirs": (count, 3, 135),
        "J_regressor": (16, count),
        "weights": (count, 16),
        "kintree_table": (2, 16),
        "hands_mean": (45,),
        "hands_components": (None, 45),
    }
    numbers: dict[str, Array] = {}
    for name, shape in shapes.items():
        # Without these two nothing is lost: parameters are then full axis-angles about the flat hand.
        array = arrays.get(name, np.eye(45) if name == "hands_components" else np.zeros(45))
        fits = len(array.shape) == len(shape) and all(
            want in (None, size) for want, size in zip(shape, array.shape, strict=True)
        )
        if not fits or array.size == 0:
            raise ValueError(f"{name} has shape {array.shape}")
        numbers[name] = np.asarray(array, np.float64)
        if not np.isfinite(numbers[name]).all():
            raise ValueError(f"{name} holds numbers that are not finite")
    tree = [int(parent) for parent in numbers["kintree_table"][0, 1:]]
    if tuple(tree) != JOINT_PARENTS[1:]:
        raise ValueError("its joints are not in MANO's order")
    f = numbers["f"].astype(np.int64)
    if f.min() < 0 or f.max() >= count:
        raise ValueError("a face names a vertex that is not there")
    if numbers["weights"].min() < -1e-6 or abs(numbers["weights"].sum(1) - 1).max() > 1e-3:
        raise ValueError("skinning weights do not add up to one")
    joints = numbers["J_regressor"] @ numbers["v_template"]
    along, across = joints[4] - joints[0], joints[1] - joints[7]
    length = float(np.linalg.norm(along))
    if not _PALM_LENGTHS[0] < length < _PALM_LENGTHS[1]:
        raise ValueError(f"its palm is {length:.3g} long, which is not metres")
    if abs(along[0]) < 0.8 * length or across[2] <= 0:
        raise ValueError("it does not lie as MANO does, fingers along x and thumb towards z")
    side: Side = "right" if along[0] < 0 else "left"
    result = ManoFile(
        side,
        numbers["v_template"],
        f,
        numbers["shapedirs"],
        numbers["posedirs"],
        numbers["J_regressor"],
        numbers["weights"],
        numbers["hands_mean"],
        numbers["hands_components"],
    )
    if side == "left" and length_breadth_covariance(result.v_template, result.shapedirs) < 0:
        turned = result.shapedirs * np.array([-1.0, 1.0, 1.0])[:, None]
        return replace(result, shapedirs=turned, sign_fault=True)
    return result


def length_breadth_covariance(template: Array, shapedirs: Array) -> float:
    """Covariance of relative length (x) and relative breadth (z) over the hands that the basis describes.

    The published left hand's ``shapedirs`` have x with the right hand's sign (smplx issue 48). Shape
    parameters are independent with unit variance, and people with longer hands have broader ones: a basis
    after which longer hands are narrower has that fault.
    """
    centered = template - template.mean(0)
    growth = [
        centered[:, axis] @ shapedirs[:, axis] / (centered[:, axis] @ centered[:, axis]) for axis in (0, 2)
    ]
    return float(growth[0] @ growth[1])


def main(argv: Sequence[str] | None = None) -> int:
    """Convert one file into another."""
    parser = argparse.ArgumentParser(
        prog="python -m mass_engine.hand.mano", description="Convert a MANO file."
    )
    parser.add_argument("source", type=Path)
    parser.add_argument("out", type=Path, help=".npz or .safetensors")
    arguments = parser.parse_args(argv)
    try:
        read_mano(arguments.source).save(arguments.out)
    except EngineError as error:
        print(f"error: {error}", file=sys.stderr)
        return 3
    return 0


if __name__ == "__main__":
    sys.exit(main())
