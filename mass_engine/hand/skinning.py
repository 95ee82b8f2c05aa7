"""Which bone moves which part of the skin, and how the skin keeps its volume when a joint bends."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mass_engine.hand.anatomy import DIGITS, FINGERS, FIRST_JOINT, THUMB_BACK, Vector, digit_line

Faces = NDArray[np.int64]

#: Half widths (metres) of the skin that bends with each joint of a finger and of the thumb, first to last.
_FINGER_BANDS, _THUMB_BANDS = (0.0115, 0.0075, 0.0065), (0.0170, 0.0105, 0.0080)
#: The crease under a knuckle lies farther out than the knuckle: metres along per metre below the bone.
_CREASE = 0.45
_SMOOTHING = 3
#: Angle (radians) at which the volume is exactly kept; how far a bent joint's corner stands out (metres).
_BEND, _CORNER = np.pi / 2, 0.0009


def neighbour_mean(faces: Faces, count: int) -> sp.csr_array:
    """The matrix [V,V] that averages a vertex value over its ring."""
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    both = np.concatenate([ends, ends[:, ::-1]])
    ring = sp.csr_array((np.ones(len(both)), (both[:, 0], both[:, 1])), shape=(count, count))
    ring.data[:] = 1.0
    return sp.csr_array(sp.diags_array(1.0 / ring.sum(axis=1)) @ ring)


def _step(x: Vector) -> Vector:
    """0 below -1, 1 above 1, smooth between."""
    x = np.clip(0.5 * x + 0.5, 0.0, 1.0)
    return np.asarray(x * x * x * (x * (6 * x - 15) + 10))


def back_of(digit: str, line: Vector) -> Vector:
    """Unit vector towards the digit's nail side, across its last segment."""
    along = (line[-1] - line[-2]) / np.linalg.norm(line[-1] - line[-2])
    back = np.array(THUMB_BACK if digit == "thumb" else (0.0, 1.0, 0.0))
    back = back - along * (back @ along)
    return np.asarray(back / np.linalg.norm(back))


def _bends(vertices: Vector, points: Vector, digit: str) -> tuple[Vector, Vector]:
    """How far [V,3] each vertex follows each joint of the digit if it is part of it, and its distance [V]."""
    line = digit_line(points, digit)
    bands = _THUMB_BANDS if digit == "thumb" else _FINGER_BANDS
    back = back_of(digit, line)
    follows, apart = [], np.full(len(vertices), np.inf)
    for k in range(3):
        step = line[k + 1] - line[k]
        length = np.linalg.norm(step)
        here = vertices - line[k]
        place = here @ step / length
        below = np.maximum(0.0, -(here @ back))
        # Only the knuckles' creases lie outward; those between the segments lie under the joints.
        shift = _CREASE * below if k == 0 and digit != "thumb" else 0.0
        follows.append(_step((place - shift) / bands[k]))
        nearest = here - np.clip(place / length, 0.0, 1.0)[:, None] * step
        apart = np.minimum(apart, np.linalg.norm(nearest, axis=1))
    return np.stack(follows, 1), apart


def skinning_weights(vertices: Vector, faces: Faces, points: Vector) -> Vector:
    """Weights [V,16]: each digit's skin by its place along the bones, smoothed over the surface."""
    bends = {digit: _bends(vertices, points, digit) for digit in DIGITS}
    apart = np.stack([bends[finger][1] for finger in FINGERS], 1)
    share = np.exp(-((apart - apart.min(1, keepdims=True)) / 0.0035))
    share /= share.sum(1, keepdims=True)
    belongs = dict(zip(FINGERS, share.T, strict=True))
    # The thumb's root moves much of the palm: its hold fades with the distance from its bones.
    hold = _step((0.0235 - bends["thumb"][1]) / 0.0085)
    belongs["thumb"] = hold
    weights = np.zeros((len(vertices), 16))
    for digit in DIGITS:
        first, (follows, _) = FIRST_JOINT[digit], bends[digit]
        reach = belongs[digit] * follows[:, 0]
        if digit != "thumb":
            reach = reach * (1 - hold * bends["thumb"][0][:, 0])
        weights[:, first] = reach * (1 - follows[:, 1])
        weights[:, first + 1] = reach * follows[:, 1] * (1 - follows[:, 2])
        weights[:, first + 2] = reach * follows[:, 1] * follows[:, 2]
    weights[:, 0] = np.maximum(0.0, 1 - weights.sum(1))
    average = neighbour_mean(faces, len(vertices))
    for _ in range(_SMOOTHING):
        weights = 0.5 * weights + 0.5 * (average @ weights)
    weights[weights < 0.004] = 0.0
    return np.asarray(weights / weights.sum(1, keepdims=True))


def bend_shapes(vertices: Vector, faces: Faces, points: Vector, weights: Vector) -> Vector:
    """Change of the rest vertices [V,3,15] per unit of 1 - cos(angle) of each finger joint.

    Plain skinning averages positions, so the skin across a bent joint comes nearer to it: a quarter turn
    loses 30 % of the radius. What is added here puts it back where it would be if the *angle* were averaged.
    Blending by w takes r (1 - sqrt(1 - 2 w (1 - w) (1 - cos a))), to first order linear in 1 - cos a.
    """
    shapes = np.zeros((len(vertices), 3, 15))
    for digit in DIGITS:
        line = digit_line(points, digit)
        back = back_of(digit, line)
        for k in range(3):
            joint = FIRST_JOINT[digit] + k
            moved = weights[:, joint : FIRST_JOINT[digit] + 3].sum(1)
            # The part of the vertex that moves with neither side of this joint is not its business.
            own = moved + weights[:, joint - 1] if k else moved + weights[:, 0]
            along = (line[k + 1] - line[k]) / np.linalg.norm(line[k + 1] - line[k])
            axis = np.cross(back, along)
            share = np.where(own > 1e-3, moved / np.maximum(own, 1e-3), 0.0)
            arm = vertices - line[k]
            arm -= axis * (arm @ axis)[:, None]
            turned = Rotation.from_rotvec(axis * _BEND).apply(arm)
            blended = (1 - share[:, None]) * arm + share[:, None] * turned
            kept = np.stack(
                [Rotation.from_rotvec(axis * _BEND * s).apply(a) for s, a in zip(share, arm, strict=True)]
            )
            corner = (
                4
                * share
                * (1 - share)
                * np.maximum(0.0, (arm @ back) / np.linalg.norm(arm, axis=1).clip(1e-6))
            )
            kept += (
                kept / np.linalg.norm(kept, axis=1, keepdims=True).clip(1e-6) * (_CORNER * corner)[:, None]
            )
            # Undo the blended rotation to know the change at rest. The inner side folds: leave it be.
            matrix = (1 - share)[:, None, None] * np.eye(3) + share[:, None, None] * Rotation.from_rotvec(
                axis * _BEND
            ).as_matrix()
            change = np.linalg.solve(matrix, (kept - blended)[..., None])[..., 0]
            inner = _step((arm @ back) / 0.004)
            near = _step((0.026 - np.linalg.norm(vertices - line[k], axis=1)) / 0.006)
            shapes[..., joint - 1] = change * (inner * near * own)[:, None]
    average = neighbour_mean(faces, len(vertices))
    flat = shapes.reshape(len(vertices), -1)
    return np.asarray((0.5 * flat + 0.5 * (average @ flat)).reshape(shapes.shape))
