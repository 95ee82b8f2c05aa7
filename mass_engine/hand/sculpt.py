"""Makes the built-in hand's data file: ``python -m mass_engine.hand.sculpt [OUT]``.

The soft tissue of :mod:`mass_engine.hand.anatomy` is blended into one distance field, meshed once for the mean
shape, and every vertex is tied to the bones around it: that gives skinning weights and, by moving the bones, the
shape space. One topology serves all shapes. Needs the development extras (scikit-image, fast-simplification).
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from mass_engine.hand.anatomy import FINGERS, SHAPE_NAMES, STUMP, RoundCone, skeleton, soft_tissue
from mass_engine.hand.builtin import DATA_FILE

Vector = NDArray[np.float64]
Faces = NDArray[np.int64]

_CELL = 0.0016  # marching-cubes cell, metres
_LOW, _HIGH = (-0.215, -0.050, -0.085), (0.040, 0.040, 0.110)
_TARGET_FACES = 2400
#: Blend widths (metres): within a finger, within palm or wrist, and of each group with the rest.
_WITHIN_FINGER, _WITHIN_PALM = 0.005, 0.020
_FINGER_TO_PALM, _THUMB_TO_PALM, _WRIST_TO_PALM = 0.008, 0.018, 0.024


def _smooth_union(a: Vector, b: Vector, width: float) -> Vector:
    """The polynomial smooth minimum of two distances."""
    mix = np.clip(0.5 + 0.5 * (b - a) / width, 0.0, 1.0)
    return b * (1 - mix) + a * mix - width * mix * (1 - mix)


def _along(points: Vector, cone: RoundCone) -> tuple[Vector, Vector]:
    """Where along the cone's axis (0 to 1) each point lies, and its distance from the axis."""
    axis = cone.end - cone.start
    place = np.clip((points - cone.start) @ axis / (axis @ axis), 0.0, 1.0)
    return place, np.linalg.norm(points - cone.start - place[:, None] * axis, axis=1)


def distance_field(points: Vector, cones: Sequence[RoundCone]) -> Vector:
    """Distance [P] of ``points`` [P,3] to the hand, negative inside, in metres."""
    groups: dict[str, Vector] = {}
    for cone in cones:
        place, apart = _along(points, cone)
        here = apart - (cone.start_radius + (cone.end_radius - cone.start_radius) * place)
        width = _WITHIN_PALM if cone.group in ("palm", "wrist") else _WITHIN_FINGER
        groups[cone.group] = _smooth_union(groups[cone.group], here, width) if cone.group in groups else here
    hand = groups["palm"]
    for finger in FINGERS:
        hand = _smooth_union(hand, groups[finger], _FINGER_TO_PALM)
    hand = _smooth_union(hand, groups["thumb"], _THUMB_TO_PALM)
    hand = _smooth_union(hand, groups["wrist"], _WRIST_TO_PALM)
    return np.maximum(hand, points[:, 0] - STUMP)


def mesh(cones: Sequence[RoundCone]) -> tuple[Vector, Faces]:
    """Vertices [V,3] and outward faces [F,3] of the hand, evened out."""
    import fast_simplification
    from skimage.measure import marching_cubes

    axes = [np.arange(low, high, _CELL) for low, high in zip(_LOW, _HIGH, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
    field = distance_field(grid.reshape(-1, 3), cones).reshape(grid.shape[:3])
    vertices, faces, _, _ = marching_cubes(field, 0.0, spacing=(_CELL,) * 3)
    vertices = (vertices + np.array(_LOW)).astype(np.float32)
    vertices, faces = fast_simplification.simplify(vertices, faces.astype(np.int64), target_count=_TARGET_FACES)
    vertices, faces = vertices.astype(np.float64), faces.astype(np.int64)
    corners = vertices[faces]
    if np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) < 0:
        faces = faces[:, ::-1].copy()
    return _evened(vertices, faces, cones), faces


def _neighbour_mean(faces: Faces, count: int) -> sp.csr_array:
    """The matrix [V,V] that averages a vertex value over its ring."""
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    both = np.concatenate([ends, ends[:, ::-1]])
    ring = sp.csr_array((np.ones(len(both)), (both[:, 0], both[:, 1])), shape=(count, count))
    ring.data[:] = 1.0
    return sp.csr_array(sp.diags_array(1.0 / ring.sum(axis=1)) @ ring)


def _gradient(points: Vector, cones: Sequence[RoundCone]) -> Vector:
    step = 1e-4
    columns = []
    for axis in range(3):
        shift = np.zeros(3)
        shift[axis] = step
        columns.append(distance_field(points + shift, cones) - distance_field(points - shift, cones))
    slope = np.stack(columns, -1)
    return slope / np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 1e-12)


def _evened(vertices: Vector, faces: Faces, cones: Sequence[RoundCone]) -> Vector:
    """Slide the vertices along the surface towards their rings' middles, so that edges become alike.

    The flat end of the stump keeps its rim.
    """
    average = _neighbour_mean(faces, len(vertices))
    for _ in range(30):
        inner = (vertices[:, 0] < STUMP - 2e-4)[:, None]
        normal = _gradient(vertices, cones)
        pull = average @ vertices - vertices
        pull -= normal * np.sum(pull * normal, axis=1, keepdims=True)
        moved = vertices + 0.4 * pull
        moved -= _gradient(moved, cones) * distance_field(moved, cones)[:, None]
        vertices = np.where(inner, moved, vertices)
    return vertices


def _closeness(vertices: Vector, cones: Sequence[RoundCone], sharpness: float) -> Vector:
    """How much each cone owns each vertex [V,C], rows summing to one."""
    scaled = []
    for cone in cones:
        place, apart = _along(vertices, cone)
        scaled.append(apart / (cone.start_radius + (cone.end_radius - cone.start_radius) * place))
    distance = np.stack(scaled, 1)
    share = np.exp(-(distance - distance.min(1, keepdims=True)) * sharpness)
    return share / share.sum(1, keepdims=True)


def skinning_weights(vertices: Vector, faces: Faces, cones: Sequence[RoundCone]) -> Vector:
    """Weights [V,16] from the closeness of the bones, smoothed over the surface."""
    share = _closeness(vertices, cones, 7.0)
    weights = np.zeros((len(vertices), 16))
    for place, cone in enumerate(cones):
        weights[:, cone.joint] += share[:, place]
    average = _neighbour_mean(faces, len(vertices))
    for _ in range(3):
        weights = 0.5 * weights + 0.5 * (average @ weights)
    weights[weights < 0.01] = 0.0
    return weights / weights.sum(1, keepdims=True)


def shape_basis(vertices: Vector, cones: Sequence[RoundCone]) -> tuple[Vector, Vector]:
    """Change of vertices [V,3,10] and of the 21 points [21,3,10] per unit of each parameter.

    A vertex keeps its place along the cones that own it and its offset scaled by their radius.
    """
    share = _closeness(vertices, cones, 6.0)

    def placed(betas: Vector) -> Vector:
        result = np.zeros_like(vertices)
        for column, (old, new) in enumerate(zip(cones, soft_tissue(betas), strict=True)):
            place, _ = _along(vertices, old)
            offset = vertices - old.start - place[:, None] * (old.end - old.start)
            before = old.start_radius + (old.end_radius - old.start_radius) * place
            after = new.start_radius + (new.end_radius - new.start_radius) * place
            position = new.start + place[:, None] * (new.end - new.start) + offset * (after / before)[:, None]
            result += share[:, [column]] * position
        return result

    units = np.eye(len(SHAPE_NAMES))
    of_vertices = [(placed(unit) - placed(-unit)) / 2 for unit in units]
    of_points = [(skeleton(unit) - skeleton(-unit)) / 2 for unit in units]
    return np.stack(of_vertices, -1), np.stack(of_points, -1)


def sculpt() -> dict[str, NDArray[np.generic]]:
    """All arrays of the data file."""
    mean = np.zeros(len(SHAPE_NAMES))
    cones = soft_tissue(mean)
    vertices, faces = mesh(cones)
    of_vertices, of_points = shape_basis(vertices, cones)
    return {
        "template": vertices.astype(np.float32),
        "faces": faces.astype(np.int32),
        "shape_basis": of_vertices.astype(np.float32),
        "joint_template": skeleton(mean).astype(np.float32),
        "joint_shape_basis": of_points.astype(np.float32),
        "weights": skinning_weights(vertices, faces, cones).astype(np.float32),
    }


def main(argv: Sequence[str] | None = None) -> int:
    """Write the data file."""
    from safetensors.numpy import save_file

    parser = argparse.ArgumentParser(prog="python -m mass_engine.hand.sculpt", description=__doc__)
    parser.add_argument("out", type=Path, nargs="?", default=DATA_FILE)
    out: Path = parser.parse_args(argv).out
    out.parent.mkdir(parents=True, exist_ok=True)
    arrays = sculpt()
    save_file({name: np.ascontiguousarray(array) for name, array in arrays.items()}, out)
    print(f"{out}: {len(arrays['template'])} vertices, {len(arrays['faces'])} faces")
    return 0


if __name__ == "__main__":
    sys.exit(main())
