"""Small MANO files and rigged hands, written byte by byte as other programs write them."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from mass_engine.hand.builtin import load_builtin
from mass_engine.hand.pose import JOINT_NAMES, JOINT_PARENTS, TIP_PARENTS

Array = NDArray[np.float64]


# -- MANO ---------------------------------------------------------------------------------------------------


def mano_arrays(seed: int = 0, vertices: int | None = 778, shape: str = "builtin") -> dict[str, Any]:
    """The arrays of a right MANO hand with the built-in hand's geometry (``vertices`` of it, None: all).

    ``shape`` builtin: the built-in hand's shape basis; random: small noise. Pose correctives are noise.
    """
    random = np.random.default_rng(seed)
    model = load_builtin("right")
    rows = np.arange(len(model.template))
    faces = model.faces.numpy()
    if vertices is not None:
        rows = np.sort(random.permutation(rows)[:vertices])
        faces = random.integers(0, vertices, (1538, 3))
    template = model.template.double().numpy()[rows]
    weights = model.weights.double().numpy()[rows]
    joints = model.joint_template[:16].double().numpy()
    regressor = np.zeros((16, len(rows)))
    for row, joint in enumerate(joints):
        near = np.argsort(np.linalg.norm(template - joint, axis=1))[:12]
        system = np.concatenate([template[near].T, np.ones((1, 12))])
        regressor[row, near] = np.linalg.lstsq(system, np.append(joint, 1.0), rcond=None)[0]
    basis = model.shape_basis.double().numpy()[rows]
    return {
        "v_template": template,
        "f": faces.astype(np.uint32),
        "shapedirs": basis if shape == "builtin" else random.normal(0, 5e-4, (len(rows), 3, 10)),
        "posedirs": random.normal(0, 1e-3, (len(rows), 3, 135)),
        "J_regressor": regressor,
        "weights": weights / weights.sum(1, keepdims=True),
        "kintree_table": np.array([[2**32 - 1, *JOINT_PARENTS[1:]], range(16)], np.int64),
        "hands_mean": random.normal(0, 0.3, 45),
        "hands_components": np.linalg.qr(random.normal(size=(45, 45)))[0],
    }


def left_arrays(right: dict[str, Any], fault: bool) -> dict[str, Any]:
    """The mirror image, with the sign fault of the published left hand or without."""
    flip = np.array([-1.0, 1.0, 1.0])
    turn = np.tile([1.0, -1.0, -1.0], 15)
    signs = np.tile((flip[:, None] * flip).ravel(), 15)
    return {
        **right,
        "v_template": right["v_template"] * flip,
        "f": right["f"][:, ::-1],
        "shapedirs": right["shapedirs"] * (1.0 if fault else flip[:, None]),
        "posedirs": right["posedirs"] * flip[:, None] * signs,
        "hands_mean": right["hands_mean"] * turn,
        "hands_components": right["hands_components"] * turn,
    }


def text(value: str) -> bytes:
    """A string as Python 2 pickles it."""
    return b"U" + bytes([len(value)]) + value.encode()


def number(value: int) -> bytes:
    return b"J" + struct.pack("<i", value)


def array(values: NDArray[Any], order: Literal["<", ">"] = "<") -> bytes:
    """A numpy array in protocol 2 of Python 2: a raw string holds the numbers."""
    kind = f"{values.dtype.kind}{values.dtype.itemsize}"
    raw = np.ascontiguousarray(values.astype(values.dtype.newbyteorder(order))).tobytes()
    dtype = b"cnumpy\ndtype\n" + text(kind) + b"K\x00K\x01\x87R"
    dtype += b"(K\x03" + text(order) + b"NNN" + number(-1) + number(-1) + b"K\x00tb"
    start = b"cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\nK\x00\x85" + text("b") + b"\x87R"
    shape = b"(" + b"".join(number(size) for size in values.shape) + b"t"
    return start + b"(K\x01" + shape + dtype + b"\x89T" + struct.pack("<i", len(raw)) + raw + b"tb"


def mapping(content: dict[str, bytes]) -> bytes:
    return b"}(" + b"".join(text(name) + value for name, value in content.items()) + b"u"


def new(module: str, name: str, state: dict[str, bytes]) -> bytes:
    """An object with a state, as protocol 2 writes it."""
    return f"c{module}\n{name}\n".encode() + b")\x81" + mapping(state) + b"b"


def old(module: str, name: str, state: dict[str, bytes]) -> bytes:
    """An object with a state, as protocols 0 and 1 write it."""
    kind = f"c{module}\n{name}\n".encode()
    return b"ccopy_reg\n_reconstructor\n(" + kind + b"c__builtin__\nobject\nNtR" + mapping(state) + b"b"


def sparse(values: Array) -> bytes:
    """A csc matrix."""
    columns = [np.flatnonzero(values[:, column]) for column in range(values.shape[1])]
    starts = np.cumsum([0, *(len(rows) for rows in columns)]).astype(np.int32)
    state = {
        "_shape": number(values.shape[0]) + number(values.shape[1]) + b"\x86",
        "indices": array(np.concatenate(columns).astype(np.int32)),
        "indptr": array(starts),
        "data": array(values.T[values.T != 0]),
        "maxprint": number(50),
    }
    return new("scipy.sparse.csc", "csc_matrix", state)


def write_mano(path: Path, arrays: dict[str, Any]) -> Path:
    """A pickle as MANO is distributed: Python 2, chumpy arrays, a sparse regressor."""
    dirty = b"c__builtin__\nset\n]\x85R"
    shapedirs = arrays["shapedirs"]
    # The first ten of more shapes, chosen by chumpy.
    more = np.concatenate([shapedirs, np.full((*shapedirs.shape[:2], 3), 9.0)], -1)
    places = np.arange(more.size).reshape(more.shape)[..., :10].ravel()
    inner = old("chumpy.ch", "Ch", {"x": array(more), "_dirty_vars": dirty})
    size = b"(" + b"".join(number(n) for n in shapedirs.shape) + b"t"
    content = {
        "v_template": array(arrays["v_template"]),
        "f": array(arrays["f"]),
        "shapedirs": new(
            "chumpy.reordering", "Select", {"a": inner, "idxs": array(places), "preferred_shape": size}
        ),
        "posedirs": new("chumpy.ch", "Ch", {"x": array(arrays["posedirs"]), "_dirty_vars": dirty}),
        "J_regressor": sparse(arrays["J_regressor"]),
        "weights": array(arrays["weights"], ">"),
        "kintree_table": array(arrays["kintree_table"].astype(np.uint32)),
        "hands_mean": array(arrays["hands_mean"]),
        "hands_components": array(arrays["hands_components"]),
        "bs_style": text("lbs"),
    }
    path.write_bytes(b"\x80\x02" + mapping(content) + b".")
    return path


# -- rigged hands -------------------------------------------------------------------------------------------


@dataclass
class Rig:
    """A skinned hand: ``joints`` (name, parent row or -1, place); ``weights`` [V,J]."""

    vertices: Array
    faces: NDArray[np.int64]
    joints: list[tuple[str, int, Array]]
    weights: Array
    extra: dict[str, Any] = field(default_factory=dict)  # put over the file's JSON

    def renamed(self, change: Callable[[str], str]) -> Rig:
        """The same rig with other names."""
        return Rig(self.vertices, self.faces, [(change(n), p, x) for n, p, x in self.joints], self.weights)


def builtin_rig(side: str = "right", tips: bool = True) -> Rig:
    """The built-in hand with our own joint names."""
    model = load_builtin("right")
    model = model if side == "right" else model.mirrored()
    points = model.joint_template.double().numpy()
    joints = [
        (name, parent, points[row])
        for row, (name, parent) in enumerate(zip(JOINT_NAMES, JOINT_PARENTS, strict=False))
    ]
    weights = model.weights.double().numpy()
    if tips:
        joints += [
            (JOINT_NAMES[16 + row], parent, points[16 + row]) for row, parent in enumerate(TIP_PARENTS)
        ]
        weights = np.pad(weights, ((0, 0), (0, 5)))
    return Rig(model.template.double().numpy(), model.faces.numpy(), joints, weights)


def write_glb(path: Path, rig: Rig, *, small: bool = False, embed: bool = True) -> Path:
    """A GLB (or, not ``embed``, a .gltf with a .bin beside it); ``small``: 8-bit joints and weights."""
    blob = bytearray()
    views: list[dict[str, Any]] = []
    accessors: list[dict[str, Any]] = []
    kinds = {"<f4": 5126, "<u4": 5125, "<u2": 5123, "|u1": 5121}

    def add(values: NDArray[Any], kind: str, **more: Any) -> int:
        while len(blob) % 4:
            blob.append(0)
        views.append({"buffer": 0, "byteOffset": len(blob), "byteLength": values.nbytes})
        blob.extend(np.ascontiguousarray(values).tobytes())
        entry = {"bufferView": len(views) - 1, "componentType": kinds[values.dtype.str], "count": len(values)}
        accessors.append({**entry, "type": kind, **more})
        return len(accessors) - 1

    order = np.argsort(-rig.weights, axis=1)[:, :8]
    values = np.take_along_axis(rig.weights, order, 1)
    if small:
        values = np.round(values * 255)
    attributes = {"POSITION": add(rig.vertices.astype("<f4"), "VEC3")}
    for part in range(0, min(8, order.shape[1]), 4):
        joints, held = order[:, part : part + 4], values[:, part : part + 4]
        name = str(part // 4)
        attributes["JOINTS_" + name] = add(joints.astype("u1" if small else "<u2"), "VEC4")
        if small:
            attributes["WEIGHTS_" + name] = add(held.astype("u1"), "VEC4", normalized=True)
        else:
            attributes["WEIGHTS_" + name] = add(held.astype("<f4"), "VEC4")
    inverse = np.tile(np.eye(4), (len(rig.joints), 1, 1))
    inverse[:, :3, 3] = [-place for _, _, place in rig.joints]
    primitive = {
        "attributes": attributes,
        "indices": add(rig.faces.astype("<u2" if small else "<u4").ravel(), "SCALAR"),
    }
    nodes: list[dict[str, Any]] = [{"name": name, "children": []} for name, _, _ in rig.joints]
    for row, (_, parent, _) in enumerate(rig.joints):
        if parent >= 0:
            nodes[parent]["children"].append(row)
    nodes.append({"name": "Hand mesh", "mesh": 0, "skin": 0})
    matrices = add(inverse.swapaxes(1, 2).astype("<f4"), "MAT4")
    content: dict[str, Any] = {
        "asset": {"version": "2.0"},
        "nodes": nodes,
        "meshes": [{"primitives": [primitive]}],
        "skins": [{"joints": list(range(len(rig.joints))), "inverseBindMatrices": matrices}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(blob)}],
        **rig.extra,
    }
    if not embed:
        path.with_suffix(".bin").write_bytes(blob)
        content["buffers"][0]["uri"] = path.with_suffix(".bin").name
        path.write_text(json.dumps(content))
        return path
    path.write_bytes(glb(content, bytes(blob)))
    return path


def glb(content: dict[str, Any], blob: bytes) -> bytes:
    """The bytes of a GLB."""
    head = json.dumps(content).encode()
    head += b" " * (-len(head) % 4)
    blob += bytes(-len(blob) % 4)
    chunks = (
        struct.pack("<I4s", len(head), b"JSON") + head + struct.pack("<I4s", len(blob), b"BIN\x00") + blob
    )
    return b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks


def split_seams(rig: Rig) -> Rig:
    """Every triangle with vertices of its own, as after a hard-edged export."""
    rows = rig.faces.ravel()
    faces = np.arange(len(rows)).reshape(-1, 3)
    return Rig(rig.vertices[rows], faces, rig.joints, rig.weights[rows])


def with_joints(rig: Rig, more: Sequence[tuple[str, int, Array]]) -> Rig:
    """Further joints that move nothing."""
    return Rig(
        rig.vertices,
        rig.faces,
        [*rig.joints, *more],
        np.pad(rig.weights, ((0, 0), (0, len(more)))),
        rig.extra,
    )
