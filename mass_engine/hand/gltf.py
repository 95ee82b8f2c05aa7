"""Any rigged hand out of a glTF file: its skin, brought into the engine's form.

What counts is the bind pose: the mesh's vertices with the inverse bind matrices of its skin. Where the
scene's nodes stand, and what else is in the file, plays no part; the hand's own form gives units and axes.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mass_engine.errors import EngineError
from mass_engine.hand.gltf_file import GltfFile, broken, extensions, read_gltf, unsupported
from mass_engine.hand.joint_names import ADVICE, JointMatch, apply_mapping, match_joints
from mass_engine.hand.model import HandModel
from mass_engine.hand.pose import JOINT_NAMES, Side
from mass_engine.hand.rigging import (
    Array,
    Faces,
    RiggedHand,
    check_proportions,
    estimate_tips,
    keep_vertices,
    side_of,
    to_engine,
)

#: A fit puts many surfels into every face; the built-in hand has 2328, MANO 1538.
MOST_FACES, FEWEST_FACES = 12_000, 200
#: Of everything that moves with the skin, a whole body perhaps.
MOST_VERTICES = 400_000
_MOST_JOINTS, _MOST_SKINS, _MOST_PRIMITIVES = 2000, 64, 1000
_MOST_SETS = 4  # of four joints a vertex
_TRIANGLES = 4
#: Vertices closer than this, in hand sizes, are one (files split them where texture or normal has a seam).
_WELD = 1e-6


def read_rigged_hand(
    path: Path, joint_map: Path | None = None, side: Side | None = None
) -> tuple[HandModel, list[tuple[str, str]]]:
    """The hand of ``path`` and notes (code, message) on what was done to it.

    ``side`` chooses between two hands of one file, or says which one it is where names and form do not.
    Raises EngineError: ``template.unreadable``, ``gltf_invalid``, ``gltf_unsupported``, ``joints_missing``,
    ``joints_ambiguous``, ``joint_map``, ``side_unknown``, ``too_large``, ``mesh``, ``proportions`` (all after
    ``template.``).
    """
    file = read_gltf(path)
    skin, names, match = _choose_skin(file, joint_map, side)
    joints = _bind_positions(file, skin, len(names))
    owners = _owners(file, skin, match)
    hand = _mesh(file, skin, owners)
    points = np.zeros((21, 3))
    for name, row in match.joints.items():
        points[JOINT_NAMES.index(name)] = joints[row]
    try:
        tips, _ = estimate_tips(hand.vertices, points[:16], hand.weights)
    except ValueError as error:
        raise EngineError(
            "template.mesh", f"A finger's last joint has no skin in the file ({error}).", ADVICE
        ) from error
    notes = []
    unknown = [name for name in JOINT_NAMES[16:] if name not in match.joints]
    for name in unknown:
        points[JOINT_NAMES.index(name)] = tips[JOINT_NAMES.index(name) - 16]
    if unknown:
        notes.append(("template.tips", f"Found on the mesh, as the rig has none: {', '.join(unknown)}."))
    hand = replace(hand, points=points, guessed=tuple(JOINT_NAMES.index(name) for name in unknown))
    check_proportions(points)
    known = match.side or side or side_of(hand) or _side_in_name(path)
    if known is None:
        raise EngineError(
            "template.side_unknown",
            "Neither the joints' names nor the hand's form say whether it is a left or a right hand.",
            "Say so: --template gltf:FILE,side=right.",
        )
    model, more = to_engine(hand, known)
    return model, notes + more


def _choose_skin(
    file: GltfFile, joint_map: Path | None, side: Side | None
) -> tuple[int, list[str], JointMatch]:
    """The skin with most joints of a hand. Raises EngineError when it is not a whole one."""
    skins = file.items("skins")
    mapping = {} if joint_map is None else _read_mapping(joint_map)
    if not skins:
        raise EngineError(
            "template.no_skin", "The file has no skinned mesh.", "Export the hand with its skin."
        )
    best: tuple[int, list[str], JointMatch] | None = None
    for number, skin in enumerate(skins[:_MOST_SKINS]):
        nodes = skin.get("joints")
        if not isinstance(nodes, list) or not 0 < len(nodes) <= _MOST_JOINTS:
            raise broken(f"skin {number} has no list of joints")
        names = [str(file.item("nodes", node).get("name", f"node {node}"))[:200] for node in nodes]
        given = [value for key, value in mapping.items() if key != "side"]
        if mapping and (len(skins) == 1 or all(value in names for value in given)):
            # What the user has named needs no guess, and no complaint about two that look alike.
            match = match_joints(["" if name in given else name for name in names], side)
            match = apply_mapping(match, names, mapping)
        else:
            match = match_joints(names, side)
        if best is None or len(match.joints) > len(best[2].joints):
            best = number, names, match
    assert best is not None
    number, names, match = best
    if mapping:
        apply_mapping(match, names, mapping)  # to say which name does not fit
    if match.missing:
        used = {*match.joints.values(), *match.folded}
        left = [name[:40] for row, name in enumerate(names) if row not in used]
        raise EngineError(
            "template.joints_missing",
            f"No joint was found for {', '.join(match.missing)}."
            + (f" Not understood: {', '.join(left[:40])}." if left else ""),
            ADVICE,
        )
    return best


def _read_mapping(path: Path) -> dict[str, object]:
    try:
        if path.stat().st_size > 1 << 20:
            raise ValueError("it is larger than 1 MiB")
        content = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(content, dict):
            raise ValueError("it is no JSON object")
    except (OSError, ValueError, RecursionError) as error:
        raise EngineError(
            "template.joint_map", f"The mapping file {path.name} cannot be read: {error}.", ADVICE
        ) from error
    return content


def _bind_positions(file: GltfFile, skin: int, count: int) -> Array:
    """Where each joint of the skin is in the bind pose, in the mesh's space [J,3]."""
    entry = file.item("skins", skin)
    if "inverseBindMatrices" not in entry:
        raise unsupported("has a skin without inverse bind matrices, so where its joints rest is not known")
    matrices = file.accessor(entry["inverseBindMatrices"], ("MAT4",)).astype(np.float64)
    if len(matrices) < count:
        raise broken("the skin has fewer inverse bind matrices than joints")
    matrices = matrices[:count]
    if not np.isfinite(matrices).all() or (np.abs(np.linalg.det(matrices)) < 1e-30).any():
        raise broken("an inverse bind matrix cannot be inverted")
    return np.asarray(np.linalg.inv(matrices)[:, :3, 3])


def _owners(file: GltfFile, skin: int, match: JointMatch) -> NDArray[np.int64]:
    """For each joint of the skin the hand joint (0 to 15) it moves with, or 16: no part of the hand.

    What has no name of its own (twist bones, finger ends) goes with the nearest ancestor that has one.
    """
    nodes: list[int] = file.item("skins", skin)["joints"]
    parents: dict[int, int] = {}
    for number, entry in enumerate(file.items("nodes")):
        children = entry.get("children", [])
        for child in children if isinstance(children, list) else []:
            if isinstance(child, int):
                parents[child] = number
    known: dict[int, int] = {}
    for name, row in (*match.joints.items(), *((name, row) for row, name in match.folded.items())):
        place = JOINT_NAMES.index(name)
        known[nodes[row]] = place if place < 16 else (15, 3, 6, 12, 9)[place - 16]
    owners = []
    for node in nodes:
        above: int | None = node
        steps = 0
        while above is not None and above not in known and steps < 1000:  # a broken file may hold a circle
            above, steps = parents.get(above), steps + 1
        owners.append(known.get(above, 16) if above is not None else 16)
    return np.array(owners, np.int64)


def _mesh(file: GltfFile, skin: int, owners: NDArray[np.int64]) -> RiggedHand:
    """The part of the skinned mesh that belongs to the hand, seams welded; points are left empty."""
    meshes = {str(node["mesh"]): node["mesh"] for node in file.items("nodes") if _shows(node, skin)}
    parts, room = [], MOST_VERTICES
    for mesh in meshes.values():
        for primitive in _primitives(file.item("meshes", mesh)):
            parts.append(_primitive(file, primitive, owners, room))
            room -= len(parts[-1][0])
    if not parts:
        raise EngineError(
            "template.no_skin",
            "No mesh in the file moves with the hand's joints.",
            "Export the hand with its skin.",
        )
    starts = np.cumsum([0, *(len(part[0]) for part in parts)])
    vertices = np.concatenate([part[0] for part in parts])
    faces = np.concatenate([part[1] + start for part, start in zip(parts, starts[:-1], strict=True)])
    weights = np.concatenate([part[2] for part in parts])
    # What moves mostly with another joint is not hand; a little of the forearm's hold goes to the wrist.
    hand = weights[:, 16] < 0.5
    weights[:, 0] += weights[:, 16]
    whole = RiggedHand(vertices, faces, weights[:, :16], np.zeros((21, 3)))
    result = _weld(keep_vertices(whole, hand))
    if len(result.faces) > MOST_FACES:
        raise EngineError(
            "template.too_large",
            f"The hand has {len(result.faces)} triangles, at most {MOST_FACES} can be fitted.",
            "Simplify the mesh (in Blender: Decimate), then export it again.",
        )
    if len(result.faces) < FEWEST_FACES:
        raise EngineError(
            "template.mesh",
            f"Only {len(result.faces)} triangles move with the hand's joints.",
            "Check that the file's skin has weights on the finger joints.",
        )
    return _outward(result)


def _shows(node: dict[str, Any], skin: int) -> bool:
    return node.get("skin") == skin and "mesh" in node


def _primitives(mesh: dict[str, Any]) -> list[dict[str, Any]]:
    primitives = mesh.get("primitives")
    if (
        not isinstance(primitives, list)
        or len(primitives) > _MOST_PRIMITIVES
        or not all(isinstance(item, dict) for item in primitives)
    ):
        raise broken("a mesh has no primitives")
    return primitives


def _primitive(
    file: GltfFile, primitive: dict[str, Any], owners: NDArray[np.int64], room: int
) -> tuple[Array, Faces, Array]:
    """Vertices, faces and weights [V,17] on the hand's joints and on everything else."""
    if "KHR_draco_mesh_compression" in extensions(primitive):
        raise unsupported("is compressed (KHR_draco_mesh_compression)")
    if primitive.get("mode", _TRIANGLES) != _TRIANGLES:
        raise unsupported("holds a mesh that is not made of triangles")
    attributes = primitive.get("attributes")
    if not isinstance(attributes, dict) or "POSITION" not in attributes:
        raise broken("a mesh has no positions")
    vertices = file.accessor(attributes["POSITION"], ("VEC3",)).astype(np.float64)
    count = len(vertices)
    if count > room:
        raise EngineError(
            "template.too_large",
            f"The skinned meshes have more than {MOST_VERTICES} vertices.",
            "Export the hand alone, or simplify it.",
        )
    if not np.isfinite(vertices).all():
        raise broken("a position is not a finite number")
    if "indices" in primitive:
        indices = file.accessor(primitive["indices"], ("SCALAR",))
        if indices.dtype.kind != "u":
            raise broken("indices are no whole numbers")
    else:
        indices = np.arange(count)
    if len(indices) > 10 * MOST_VERTICES or len(indices) % 3 or indices.max(initial=0) >= count:
        raise broken("a triangle names a vertex that is not there")
    weights = np.zeros((count, 17))
    for number in range(_MOST_SETS):
        if f"JOINTS_{number}" not in attributes or f"WEIGHTS_{number}" not in attributes:
            break
        joints = file.accessor(attributes[f"JOINTS_{number}"], ("VEC4",))
        values = file.accessor(attributes[f"WEIGHTS_{number}"], ("VEC4",)).astype(np.float64)
        if joints.dtype.kind != "u" or joints.shape != (count, 4) or values.shape != (count, 4):
            raise broken("joints and weights do not fit the positions")
        if not np.isfinite(values).all() or values.min() < 0 or (joints[values > 0] >= len(owners)).any():
            raise broken("a weight names a joint that is not there")
        joints = np.minimum(joints, len(owners) - 1)
        for column in range(4):
            np.add.at(weights, (np.arange(count), owners[joints[:, column]]), values[:, column])
    total = weights.sum(1, keepdims=True)
    weights = np.where(total > 1e-9, weights / np.maximum(total, 1e-9), np.eye(17)[16])
    return vertices, indices.astype(np.int64).reshape(-1, 3), weights


def _weld(hand: RiggedHand) -> RiggedHand:
    """Vertices in one place become one; triangles that then are none, or doubles, go."""
    size = float(np.ptp(hand.vertices, axis=0).max()) if len(hand.vertices) else 1.0
    grid = np.round(hand.vertices / max(size * _WELD, 1e-30)).astype(np.int64)
    _, first, number = np.unique(grid, axis=0, return_index=True, return_inverse=True)
    number = number.reshape(-1)
    weights = np.zeros((len(first), hand.weights.shape[1]))
    np.add.at(weights, number, hand.weights)
    weights /= np.maximum(weights.sum(1, keepdims=True), 1e-12)
    faces = number[hand.faces]
    whole = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    faces = faces[whole]
    _, kept = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    welded = RiggedHand(hand.vertices[first], faces[np.sort(kept)], weights, hand.points)
    return keep_vertices(welded, np.ones(len(first), bool))


def _outward(hand: RiggedHand) -> RiggedHand:
    """Faces seen counter-clockwise from outside: the volume they enclose is positive."""
    corners = (hand.vertices - hand.vertices.mean(0))[hand.faces]
    volume = np.einsum("fi,fi->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
    faces = hand.faces if volume >= 0 else hand.faces[:, ::-1]
    return RiggedHand(hand.vertices, np.ascontiguousarray(faces), hand.weights, hand.points)


def _side_in_name(path: Path) -> Side | None:
    """``left.glb`` and ``right.glb`` are what WebXR's own hands are called."""
    stem = path.stem.lower()
    if ("left" in stem) == ("right" in stem):
        return None
    return "left" if "left" in stem else "right"
