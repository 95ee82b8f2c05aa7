"""Makes the built-in hand's data file: ``python -m mass_engine.hand.sculpt [OUT]``.

The soft tissue of :mod:`mass_engine.hand.anatomy` is blended into one distance field and meshed once for the
mean shape; how joints bend is found by bending that field (:mod:`mass_engine.hand.bending`). Each shape
parameter moves the bones and the field; every vertex follows both, which gives the shape space: one topology
serves all shapes. Needs the development extra scikit-image.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from mass_engine.hand.anatomy import (
    FIRST_JOINT,
    SHAPE_NAMES,
    SHAPE_STEPS,
    STUMP,
    TIP_POINT,
    Tissue,
    Vector,
    skeleton,
    soft_tissue,
)
from mass_engine.hand.bending import bend_shapes
from mass_engine.hand.builtin import DATA_FILE
from mass_engine.hand.field import (
    distance_field,
    field_gradient,
    nail_distance,
    project,
    tissue_distance,
    to_outline,
)
from mass_engine.hand.remesh import remesh
from mass_engine.hand.skinning import Faces, neighbour_mean, skinning_weights
from mass_engine.surfel.subdivision import loop_subdivision

_CELL = 0.003  # marching-cubes cell, metres
_LOW, _HIGH = (-0.215, -0.060, -0.085), (0.045, 0.045, 0.115)
#: Wanted edge length (metres) on the palm, on the digits, at their tips and on the nails.
_COARSE, _FINE, _TIP, _NAIL = 0.0089, 0.0059, 0.0043, 0.0028


def _mesh(tissues: Sequence[Tissue]) -> tuple[Vector, Faces]:
    """Vertices [V,3] and outward faces [F,3] of the hand's surface, evened out."""
    from skimage.measure import marching_cubes

    axes = [np.arange(low, high, _CELL) for low, high in zip(_LOW, _HIGH, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
    values = distance_field(grid.reshape(-1, 3), tissues).reshape(grid.shape[:3])
    vertices, faces, _, _ = marching_cubes(values, 0.0, spacing=(_CELL,) * 3)
    vertices = vertices.astype(np.float64) + np.array(_LOW)
    faces = faces.astype(np.int64)
    corners = vertices[faces]
    if np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) < 0:
        faces = faces[:, ::-1].copy()
    digits = [part for part in tissues if part.group in FIRST_JOINT]
    nails = [part.nail for part in digits if part.nail is not None]
    tips = skeleton(np.zeros(len(SHAPE_NAMES)))[list(TIP_POINT.values())]

    def size(points: Vector) -> Vector:
        apart = np.stack([tissue_distance(points, part) for part in digits]).min(0)
        coarse = np.clip(apart / 0.012, 0.0, 1.0)
        tip = np.linalg.norm(points[:, None] - tips, axis=-1).min(1)
        fine = _TIP + (_FINE - _TIP) * np.clip((tip - 0.008) / 0.012, 0.0, 1.0)
        nail = np.stack([nail_distance(points, nail) for nail in nails]).min(0)
        fine = _NAIL + (fine - _NAIL) * np.clip((nail - 0.0015) / 0.004, 0.0, 1.0)
        rim = np.clip((STUMP - 0.002 - points[:, 0]) / 0.012, 0.0, 1.0)
        return np.asarray(_FINE + (fine + (_COARSE - fine) * coarse - _FINE) * rim)

    def onto(points: Vector) -> Vector:
        for nail in nails:
            points = to_outline(points, nail)
        return project(points, tissues, steps=1)

    return remesh(vertices, faces, size, onto)


def _cage(vertices: Vector, faces: Faces, tissues: Sequence[Tissue]) -> Vector:
    """Vertices whose Loop-subdivided surface, not the coarse mesh itself, lies on the hand's surface."""
    twice = loop_subdivision(torch.from_numpy(faces), len(vertices), 2)
    for _ in range(12):
        # Subdivision keeps the old vertices first.
        smooth = twice.apply(torch.from_numpy(vertices).float()).double().numpy()[: len(vertices)]
        slope = field_gradient(smooth, tissues)
        slope /= np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 1e-9)
        vertices = vertices - 0.7 * slope * distance_field(smooth, tissues)[:, None]
    return vertices


def _placed(vertices: Vector, weights: Vector, betas: Vector, height: Vector) -> Vector:
    """The vertices on a hand of shape ``betas``: carried by the bones, then put back at their ``height``."""
    old, new = skeleton(np.zeros(len(betas))), skeleton(betas)
    carried = np.zeros_like(vertices)
    palm = np.array([np.linalg.norm(new[4]) / np.linalg.norm(old[4]), 1.0, new[1, 2] / old[1, 2]])
    ends = {joint: joint + 1 for joint in range(1, 16)}
    ends.update({FIRST_JOINT[digit] + 2: TIP_POINT[digit] for digit in FIRST_JOINT})
    for joint in range(16):
        arm = vertices - old[joint]
        if joint == 0:
            moved = arm * palm
        else:
            bone, longer = old[ends[joint]] - old[joint], new[ends[joint]] - new[joint]
            along = bone / np.linalg.norm(bone)
            stretch = np.linalg.norm(longer) / np.linalg.norm(bone) - 1
            moved = arm + np.outer(arm @ along, along) * stretch
        carried += weights[:, [joint]] * (new[joint] + moved)
    return project(carried, soft_tissue(betas), height)


def _shape_basis(vertices: Vector, faces: Faces, weights: Vector) -> tuple[Vector, Vector]:
    """Change of vertices [V,3,10] and of the 21 points [21,3,10] per unit of each parameter."""
    mean = soft_tissue(np.zeros(len(SHAPE_NAMES)))
    height = distance_field(vertices, mean)
    average = neighbour_mean(faces, len(vertices))
    of_vertices, of_points = [], []
    for place, name in enumerate(SHAPE_NAMES):
        unit = np.eye(len(SHAPE_NAMES))[place]
        of_points.append((skeleton(unit) - skeleton(-unit)) / 2)
        if name == "size":
            of_vertices.append(vertices * SHAPE_STEPS[place])
            continue
        change = (_placed(vertices, weights, unit, height) - _placed(vertices, weights, -unit, height)) / 2
        for _ in range(2):
            change = 0.5 * change + 0.5 * (average @ change)
        of_vertices.append(change)
    return np.stack(of_vertices, -1), np.stack(of_points, -1)


def sculpt() -> dict[str, NDArray[np.generic]]:
    """All arrays of the data file."""
    mean = np.zeros(len(SHAPE_NAMES))
    tissues, points = soft_tissue(mean), skeleton(mean)
    vertices, faces = _mesh(tissues)
    weights = skinning_weights(vertices, faces, points)
    cage = _cage(vertices, faces, tissues)
    bends = bend_shapes(vertices, cage, faces, points, weights, tissues)
    of_vertices, of_points = _shape_basis(cage, faces, weights)
    return {
        "template": cage.astype(np.float32),
        "faces": faces.astype(np.int32),
        "shape_basis": of_vertices.astype(np.float32),
        "joint_template": points.astype(np.float32),
        "joint_shape_basis": of_points.astype(np.float32),
        "weights": weights.astype(np.float32),
        "bend_shapes": bends.astype(np.float32),
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
