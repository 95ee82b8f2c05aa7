"""The built-in hand's anatomy: bones, soft tissue and what each shape parameter changes.

Right hand at rest: fingers along -x, palm towards -y, thumb towards +z, wrist joint at the origin; metres.
Segment lengths are the means of Buryanov and Kotiuk (2010, "Proportions of hand segments"); radii follow the
finger breadths of adult hands in the same range. One unit of a shape parameter is about one standard deviation
of adults (Greiner 1991, hand anthropometry of U.S. Army personnel); :data:`SHAPE_RANGES` reaches children.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]

SHAPE_NAMES: tuple[str, ...] = (
    "size",  # the whole hand
    "palm_width",
    "palm_length",
    "finger_length",
    "thumb_length",
    "finger_thickness",
    "palm_thickness",
    "wrist_thickness",
    "index_length",
    "pinky_length",
)

#: Change of the quantity per unit of each parameter, as a fraction.
SHAPE_STEPS: tuple[float, ...] = (0.06, 0.05, 0.05, 0.05, 0.05, 0.06, 0.08, 0.07, 0.04, 0.05)

#: Least and greatest sensible value of each parameter: from a child of about six (size -5) to very large hands.
SHAPE_RANGES: tuple[tuple[float, float], ...] = ((-6.0, 4.0), *(((-4.0, 4.0),) * 9))

FINGERS = ("index", "middle", "pinky", "ring")
FIRST_JOINT = {"index": 1, "middle": 4, "pinky": 7, "ring": 10, "thumb": 13}
TIP_POINT = {"thumb": 16, "index": 17, "middle": 18, "ring": 19, "pinky": 20}

#: Knuckle (first finger joint) positions, and how far each finger is turned outward at rest (radians).
_KNUCKLES = {
    "index": (-0.0900, 0.0030, 0.0240),
    "middle": (-0.0935, 0.0060, 0.0020),
    "ring": (-0.0880, 0.0040, -0.0180),
    "pinky": (-0.0790, -0.0010, -0.0350),
}
_SPLAY = {"index": 0.09, "middle": 0.0, "ring": -0.09, "pinky": -0.20}
#: Proximal, middle, distal segment with soft tip (mm), and radii from knuckle to tip (mm).
_SEGMENTS = {
    "index": (39.8, 22.4, 15.8 + 3.8),
    "middle": (44.6, 26.3, 17.4 + 4.0),
    "ring": (41.4, 25.7, 17.3 + 4.0),
    "pinky": (32.7, 18.1, 16.0 + 3.7),
}
_RADII = {
    "index": (10.2, 9.0, 7.9, 6.4),
    "middle": (10.4, 9.2, 8.1, 6.6),
    "ring": (9.8, 8.6, 7.6, 6.2),
    "pinky": (8.8, 7.6, 6.7, 5.5),
}
_THUMB_BASE = (-0.0200, -0.0130, 0.0250)
_THUMB_DIRECTIONS = ((-0.72, -0.28, 0.63), (-0.84, -0.24, 0.48), (-0.86, -0.22, 0.46))
_THUMB_SEGMENTS = (46.2, 31.6, 21.7 + 5.7)
_THUMB_RADII = (15.0, 11.8, 10.4, 7.4)
#: Where the forearm stump is cut off, and how far the wrist's soft tissue reaches.
STUMP = 0.022


@dataclass(frozen=True)
class RoundCone:
    """Soft tissue around the segment from ``start`` to ``end``: a sphere rolled along it while its radius goes
    from ``start_radius`` to ``end_radius``. ``group`` says with what it blends, ``joint`` what moves it."""

    group: str
    joint: int
    start: Vector
    end: Vector
    start_radius: float
    end_radius: float


def _factors(betas: Vector) -> dict[str, float]:
    return {
        name: 1.0 + step * float(value) for name, step, value in zip(SHAPE_NAMES, SHAPE_STEPS, betas, strict=True)
    }


def skeleton(betas: Vector) -> Vector:
    """The 21 points [21,3] of a hand at rest with shape ``betas`` [10]."""
    f = _factors(betas)
    points = np.zeros((21, 3))
    extra = {"index": f["index_length"], "pinky": f["pinky_length"]}
    for finger in FINGERS:
        first, tip = FIRST_JOINT[finger], TIP_POINT[finger]
        direction = np.array([-np.cos(_SPLAY[finger]), 0.0, np.sin(_SPLAY[finger])])
        scale = 1e-3 * f["finger_length"] * extra.get(finger, 1.0)
        points[first] = np.array(_KNUCKLES[finger]) * (f["palm_length"], 1.0, f["palm_width"])
        lengths = np.array(_SEGMENTS[finger]) * scale
        points[first + 1] = points[first] + direction * lengths[0]
        points[first + 2] = points[first + 1] + direction * lengths[1]
        points[tip] = points[first + 2] + direction * lengths[2]
    points[13] = np.array(_THUMB_BASE) * (f["palm_length"], 1.0, f["palm_width"])
    for place, (direction_of, length) in enumerate(zip(_THUMB_DIRECTIONS, _THUMB_SEGMENTS, strict=True)):
        unit = np.array(direction_of) / np.linalg.norm(direction_of)
        points[14 + place] = points[13 + place] + unit * length * 1e-3 * f["thumb_length"]
    return points * f["size"]


def soft_tissue(betas: Vector) -> list[RoundCone]:
    """The round cones whose blended union is the hand with shape ``betas`` [10]."""
    f, points = _factors(betas), skeleton(betas)
    size = f["size"]
    finger, palm, wrist = (f[name] * size for name in ("finger_thickness", "palm_thickness", "wrist_thickness"))
    wide, far = f["palm_width"], f["palm_length"]
    cones = []

    def at(x: float, y: float, z: float) -> Vector:
        return np.array([x * far, y, z * wide]) * size

    for name in FINGERS:
        first, tip = FIRST_JOINT[name], TIP_POINT[name]
        chain = [points[first], points[first + 1], points[first + 2], points[tip]]
        radii = [radius * 1e-3 * finger for radius in _RADII[name]]
        # The tip point is the finger's end: the last sphere stops there.
        inward = (chain[2] - chain[3]) / np.linalg.norm(chain[2] - chain[3])
        chain[3] = chain[3] + inward * radii[3]
        for k in range(3):
            cones.append(RoundCone(name, first + k, chain[k], chain[k + 1], radii[k], radii[k + 1]))
        root = at(-0.012, -0.001, _KNUCKLES[name][2] * 0.55)
        knuckle = points[first] + np.array([0.004, -0.003, 0.0]) * size
        cones.append(RoundCone("palm", 0, root, knuckle, 0.0142 * palm, 0.0114 * palm))
    radii = [radius * 1e-3 * finger for radius in _THUMB_RADII]
    chain = [points[13], points[14], points[15], points[16]]
    inward = (chain[2] - chain[3]) / np.linalg.norm(chain[2] - chain[3])
    chain[3] = chain[3] + inward * radii[3]
    for k in range(3):
        cones.append(RoundCone("thumb", 13 + k, chain[k], chain[k + 1], radii[k], radii[k + 1]))
    # The balls of thumb and little finger, and the two columns of the wrist.
    cones.append(RoundCone("palm", 0, at(-0.020, -0.009, 0.013), at(-0.052, -0.012, 0.021), 0.0150 * palm, 0.0125 * palm))
    cones.append(RoundCone("palm", 0, at(-0.020, -0.008, -0.017), at(-0.056, -0.010, -0.027), 0.0140 * palm, 0.0105 * palm))
    for sign in (1.0, -1.0):
        cones.append(
            RoundCone("wrist", 0, at(0.035, 0.0, 0.0115 * sign), at(-0.010, 0.0, 0.0125 * sign), 0.0175 * wrist, 0.0155 * wrist)
        )
    return cones
