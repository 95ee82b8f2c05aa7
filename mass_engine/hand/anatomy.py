"""The built-in hand's anatomy: bones, soft tissue and what each shape parameter changes.

Right hand at rest: fingers along -x, palm towards -y, thumb towards +z, wrist joint at the origin; metres.
Segment lengths are the means of Buryanov and Kotiuk (2010, "Proportions of hand segments"); breadths and
depths lie within the adult ranges of Garrett (1971, "The adult human hand: some anthropometric and
biomechanical considerations") and Greiner (1991, "Hand anthropometry of U.S. Army personnel"); nails, webs
and pads are drawn by eye. The joints' limits and their sources are in :mod:`mass_engine.hand.builtin`. One
unit of a shape parameter is about one standard deviation of adults; :data:`SHAPE_RANGES` reaches children.
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

#: Least and greatest sensible value of each parameter: a child of about six has size -5.
SHAPE_RANGES: tuple[tuple[float, float], ...] = ((-6.0, 4.0), *(((-4.0, 4.0),) * 9))

FINGERS = ("index", "middle", "pinky", "ring")
DIGITS = (*FINGERS, "thumb")
FIRST_JOINT = {"index": 1, "middle": 4, "pinky": 7, "ring": 10, "thumb": 13}
TIP_POINT = {"thumb": 16, "index": 17, "middle": 18, "ring": 19, "pinky": 20}

#: Knuckle (first finger joint) positions, and how far each finger is turned outward at rest (radians).
_KNUCKLES = {
    "index": (-0.0905, 0.0005, 0.0235),
    "middle": (-0.0940, 0.0030, 0.0010),
    "ring": (-0.0875, 0.0010, -0.0200),
    "pinky": (-0.0775, -0.0045, -0.0375),
}
_SPLAY = {"index": 0.09, "middle": 0.0, "ring": -0.09, "pinky": -0.20}
#: Proximal, middle, distal segment with soft tip (mm; the tips a little longer than the source's).
_SEGMENTS = {
    "index": (39.8, 22.4, 15.8 + 5.2),
    "middle": (44.6, 26.3, 17.4 + 5.4),
    "ring": (41.4, 25.7, 17.3 + 5.4),
    "pinky": (32.7, 18.1, 16.0 + 4.8),
}
_THUMB_BASE = (-0.0200, -0.0110, 0.0225)
_THUMB_DIRECTIONS = ((-0.72, -0.28, 0.63), (-0.84, -0.24, 0.48), (-0.86, -0.22, 0.46))
_THUMB_SEGMENTS = (46.2, 31.6, 21.7 + 7.0)
#: The thumb's back looks this way, turned by about 50 degrees against the fingers' (which look along +y).
THUMB_BACK = (0.0, 0.6, 0.8)

#: Cross-sections along a finger: place (joint number + fraction of the segment), half breadth, height above
#: the bone (back) and below it (pad), in mm of the index finger. The round tip begins at the last.
_FINGER_SECTIONS = (
    (0.00, 7.2, 5.8, 8.5),
    (0.25, 8.4, 6.9, 10.6),
    (0.55, 9.3, 7.8, 10.9),
    (0.85, 9.5, 8.3, 9.7),
    (1.00, 9.6, 8.6, 8.8),
    (1.20, 9.2, 7.8, 9.2),
    (1.50, 8.8, 7.1, 9.7),
    (1.85, 8.5, 6.9, 8.4),
    (2.00, 8.5, 6.9, 7.7),
    (2.25, 8.3, 6.3, 8.6),
    (2.50, 8.2, 5.6, 8.9),
    (2.72, 7.6, 5.0, 7.8),
)
_FINGER_FACTOR = {"index": 1.0, "middle": 1.03, "ring": 0.96, "pinky": 0.85}
_FINGER_TIP = 5.8
_THUMB_SECTIONS = (
    (0.00, 12.0, 10.0, 12.0),
    (0.50, 10.4, 9.0, 10.6),
    (1.00, 9.6, 9.0, 8.8),
    (1.50, 9.7, 8.0, 10.2),
    (1.85, 10.2, 8.4, 9.2),
    (2.00, 10.6, 8.4, 8.8),
    (2.25, 11.0, 7.4, 9.8),
    (2.45, 10.9, 6.4, 10.4),
    (2.72, 9.8, 5.8, 9.0),
)
_THUMB_TIP = 7.4
#: Nails: half length, half breadth, and how far the plate's middle lies from the digit's end (mm, index).
_FINGER_NAIL, _THUMB_NAIL = (5.9, 5.7, 8.2), (7.0, 7.4, 9.8)
_NAIL_HEIGHT = 0.7
#: The same for the bones of the palm, from the carpus to the knuckle.
_PALM_SECTIONS = (
    (0.0, 10.5, 11.0, 14.0),
    (0.3, 10.5, 11.8, 15.6),
    (0.6, 10.5, 10.8, 15.6),
    (0.82, 10.0, 9.0, 14.2),
    (1.0, 8.5, 7.2, 11.5),
)
_CARPUS = {"index": 0.45, "middle": 0.35, "ring": 0.42, "pinky": 0.48}
#: Where the forearm stump is cut off.
STUMP = 0.030


@dataclass(frozen=True)
class Nail:
    """A nail plate: its ``middle`` [3], unit directions ``along`` the digit and ``across`` it [3], half
    length, half breadth and ``height`` of the step at its rim, metres."""

    middle: Vector
    along: Vector
    across: Vector
    length: float
    breadth: float
    height: float


@dataclass(frozen=True)
class Tissue:
    """Soft tissue around a line of points: at each, half breadth, height towards ``back`` and away from it.

    ``line`` [P,3], ``sections`` [P,3] (breadth, back, pad), ``back`` [3] unit, ``tip`` the length of the
    round ends (``root`` that of the first, where it differs), all metres. ``group`` names what it blends
    with, ``blend`` how widely.
    """

    group: str
    line: Vector
    sections: Vector
    back: Vector
    tip: float
    blend: float
    root: float | None = None
    nail: Nail | None = None


def _factors(betas: Vector) -> dict[str, float]:
    steps = zip(SHAPE_NAMES, SHAPE_STEPS, betas, strict=True)
    return {name: 1.0 + step * float(value) for name, step, value in steps}


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


def digit_line(points: Vector, digit: str) -> Vector:
    """First joint to tip [4,3] of one digit, from the 21 points."""
    first = FIRST_JOINT[digit]
    return points[[first, first + 1, first + 2, TIP_POINT[digit]]]


def soft_tissue(betas: Vector) -> list[Tissue]:
    """The tissue whose blended union is the hand with shape ``betas`` [10]."""
    f, points = _factors(betas), skeleton(betas)
    size = f["size"]
    finger, palm, wrist = (
        size * f[name] for name in ("finger_thickness", "palm_thickness", "wrist_thickness")
    )
    wide = f["palm_width"] * size
    up = np.array([0.0, 1.0, 0.0])

    def at(x: float, y: float, z: float) -> Vector:
        """A point of the palm, millimetres of the mean hand."""
        return np.array([x * f["palm_length"], y * f["palm_thickness"], z * f["palm_width"]]) * size * 1e-3

    def lump(group: str, ends: tuple[Vector, Vector], radii: tuple[float, float], blend: float) -> Tissue:
        sections = np.repeat(np.array(radii)[:, None], 3, 1) * palm * 1e-3
        return Tissue(group, np.stack(ends), sections, up, float(sections[1, 0]), blend * size)

    parts = []
    for name in FINGERS:
        parts.append(
            _digit(
                name,
                points,
                (_FINGER_SECTIONS, _FINGER_TIP, _FINGER_NAIL),
                _FINGER_FACTOR[name] * finger,
                up,
                0.009 * size,
            )
        )
        knuckle = points[FIRST_JOINT[name]]
        root = np.array([-0.010 * f["palm_length"] * size, -0.002 * size, knuckle[2] * _CARPUS[name]])
        places, breadths, backs, pads = np.array(_PALM_SECTIONS).T
        heights = (
            np.stack([breadths * wide, backs * palm, pads * palm], 1) * 1e-3 * _FINGER_FACTOR[name] ** 0.5
        )
        line = root + places[:, None] * (knuckle - root)
        parts.append(Tissue("palm", line, heights, up, 0.009 * size, 0.010 * size))
    back = np.array(THUMB_BACK)
    parts.append(
        _digit("thumb", points, (_THUMB_SECTIONS, _THUMB_TIP, _THUMB_NAIL), finger, back, 0.016 * size)
    )
    # The skin between neighbouring fingers.
    for a, b in (("index", "middle"), ("middle", "ring"), ("ring", "pinky")):
        one, two = digit_line(points, a), digit_line(points, b)
        ends = tuple(
            0.62 * line[0] + 0.38 * line[1] + np.array([0.0, -0.0035, 0.0]) * size for line in (one, two)
        )
        parts.append(lump("web", (ends[0], ends[1]), (4.6, 4.6), 0.007))
        # From the back of the hand it slopes down between the knuckles.
        between = (one[0] + two[0]) / 2 + np.array([0.006, 0.0005, 0.0]) * size
        parts.append(lump("web", (between, (ends[0] + ends[1]) / 2), (6.5, 4.4), 0.007))
    # What fills the palm between its bones, and the skin of the back over them.
    slab = np.array([[24.0, 8.0, 12.5], [30.0, 8.5, 13.0], [36.0, 6.5, 12.0]]) * 1e-3
    slab *= np.array([wide, palm, palm])
    line = np.stack([at(-16, 0, 0), at(-52, 1.0, -3), at(-80, 0.5, -6)])
    parts.append(Tissue("palm", line, slab, up, 0.008 * size, 0.010 * size))
    # The balls of the thumb and of the little finger, and the skin between thumb and index.
    thumb = digit_line(points, "thumb")
    parts.append(
        lump("palm", (at(-20, -9, 12), 0.42 * thumb[0] + 0.58 * thumb[1] + at(0, -1, -4)), (13.0, 7.0), 0.014)
    )
    parts.append(lump("palm", (at(-12, -8, -19), at(-58, -9, -32)), (14.0, 10.5), 0.014))
    pad = np.array([-0.002, -0.0060, 0.0]) * size
    parts.append(lump("palm", (points[1] + pad, points[10] + pad), (8.3, 7.5), 0.012))
    parts.append(lump("palm", (points[10] + pad, points[7] + pad * 0.9), (7.5, 6.0), 0.012))
    web = (0.4 * thumb[0] + 0.6 * thumb[1], 0.45 * points[1] + np.array([0.0, -0.004, 0.0]) * size)
    parts.append(lump("palm", web, (7.0, 8.0), 0.020))
    web = (0.25 * thumb[0] + 0.75 * thumb[1], 0.72 * points[1] + np.array([0.0, -0.005, 0.0]) * size)
    parts.append(lump("palm", web, (4.0, 7.5), 0.020))
    half = np.array([[28.5, 16.5, 21.0], [27.8, 15.0, 20.5], [28.0, 12.5, 19.5]]) * wrist * 1e-3
    line = np.array([[0.060, -0.002, -0.002], [0.012, -0.001, -0.002], [-0.012, -0.001, -0.001]]) * size
    parts.append(Tissue("wrist", line, half, up, 0.012 * size, 0.022 * size))
    return parts


_Measures = tuple[tuple[tuple[float, ...], ...], float, tuple[float, float, float]]


def _digit(
    name: str, points: Vector, measures: _Measures, scale: float, back: Vector, blend: float
) -> Tissue:
    """A digit as one tissue: cross-sections along its joints, the round tip ending at its tip point."""
    sections, tip, (nail_length, nail_breadth, nail_place) = measures
    chain = digit_line(points, name)
    along = (chain[3] - chain[2]) / np.linalg.norm(chain[3] - chain[2])
    # The last cross-section lies one tip length before the end, whatever the finger's length.
    end = chain[3] - along * tip * scale * 1e-3
    line = []
    for place, *_ in sections[:-1]:
        joint = int(place)
        line.append(chain[joint] + (place - joint) * (chain[joint + 1] - chain[joint]))
    line.append(end)
    heights = np.array(sections)[:, 1:] * scale * 1e-3
    across = back - along * (back @ along)
    across /= np.linalg.norm(across)
    mm = scale * 1e-3
    middle = chain[3] - along * nail_place * mm
    nail = Nail(
        middle, along, np.cross(along, across), nail_length * mm, nail_breadth * mm, _NAIL_HEIGHT * mm
    )
    return Tissue(name, np.array(line), heights, across, tip * mm, blend, nail=nail)
