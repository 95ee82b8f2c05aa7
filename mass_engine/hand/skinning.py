"""Which bone moves which part of the skin."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from mass_engine.hand.anatomy import DIGITS, FINGERS, FIRST_JOINT, THUMB_BACK, Vector, digit_line

Faces = NDArray[np.int64]

#: Half widths (metres) of the skin that bends with each joint of a finger and of the thumb, first to last.
_FINGER_BANDS, _THUMB_BANDS = (0.0115, 0.0075, 0.0065), (0.0170, 0.0105, 0.0080)
#: The crease under a knuckle lies farther out than the knuckle: metres along per metre below the bone.
_CREASE = 0.45
_SMOOTHING = 3


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
