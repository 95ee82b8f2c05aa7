"""A rough hand drawn from its 21 landmarks: tapered capsules around the bones, a filled palm, a forearm."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from mass_engine.tracking.landmarks import BONES

#: Nominal length in mm of each bone in ``BONES`` order: adult means after Buryanov and Kotiuk (2010),
#: the first of each finger measured from the wrist, the last including the soft tip.
BONE_LENGTHS: tuple[float, ...] = (
    88.0, 39.8, 22.4, 19.6,
    84.0, 44.6, 26.3, 21.4,
    76.0, 32.7, 18.1, 19.7,
    78.0, 41.4, 25.7, 21.3,
    33.0, 46.2, 31.6, 27.4,
)  # fmt: skip

#: Radius in mm at each of the 21 points.
RADII: tuple[float, ...] = (
    22.0,
    10.2, 9.0, 7.9,
    10.4, 9.2, 8.1,
    8.8, 7.6, 6.7,
    9.8, 8.6, 7.6,
    15.0, 12.0, 10.2,
    7.6, 6.6, 6.8, 6.4, 5.7,
)  # fmt: skip

#: The palm as triangles of landmarks: wrist fan over the knuckles, and the web of the thumb.
_PALM = ((0, 1, 4), (0, 4, 10), (0, 10, 7), (0, 13, 1), (13, 14, 1))

_SUB = 4  # fractional bits of OpenCV's drawing coordinates: 1/16 pixel


def pixels_per_mm(points: NDArray[np.floating]) -> float:
    """Image scale of a hand [21,2]: the 75th percentile of drawn over nominal bone length.

    A high percentile, because perspective only ever shortens bones.
    """
    parents, children = (np.array(side) for side in zip(*BONES, strict=True))
    drawn = np.linalg.norm(points[children] - points[parents], axis=1)
    return max(float(np.percentile(drawn / np.array(BONE_LENGTHS), 75)), 0.02)


@dataclass(frozen=True)
class CapsuleHand:
    """The rough hand in an image window of [h,w] pixels, at ``scale`` pixels per mm.

    ``distance`` mm to its outline, negative inside; ``along`` mm from the wrist down the forearm (negative
    towards the fingers) and ``across`` mm from the forearm's axis; ``forearm`` bool, a corridor beyond the
    wrist.
    """

    distance: NDArray[np.float32]
    along: NDArray[np.float32]
    across: NDArray[np.float32]
    forearm: NDArray[np.bool_]
    scale: float


def draw(points: NDArray[np.floating], scale: float, height: int, width: int) -> CapsuleHand:
    """Draw ``points`` [21,2] (window pixels, centres at +0.5) at ``scale`` pixels per mm."""
    canvas = np.zeros((height, width), np.uint8)
    centres = points.astype(np.float64) - 0.5  # OpenCV puts pixel centres on whole numbers
    radii = np.array(RADII) * scale
    for parent, child in BONES:
        start = radii[parent] if parent else radii[child] * 1.15  # the wrist end of a ray is not a ball
        _capsule(canvas, centres[parent], centres[child], float(start), float(radii[child]))
    for triangle in _PALM:
        corners = np.round(centres[list(triangle)] * (1 << _SUB)).astype(np.int32)
        cv2.fillConvexPoly(canvas, corners, 255, cv2.LINE_8, _SUB)
    outside = cv2.distanceTransform(255 - canvas, cv2.DIST_L2, 3)
    inside = cv2.distanceTransform(canvas, cv2.DIST_L2, 3)
    distance = np.asarray((outside - inside) / scale, np.float32)
    along, across = _forearm_axes(points, scale, height, width)
    forearm = (along > 5.0) & (across < 42.0 + 0.35 * along) & (distance > 2.0)
    return CapsuleHand(distance, along, across, forearm, scale)


def _capsule(
    canvas: NDArray[np.uint8],
    start: NDArray[np.float64],
    end: NDArray[np.float64],
    start_radius: float,
    end_radius: float,
) -> None:
    for centre, radius in ((start, start_radius), (end, end_radius)):
        x, y, r = (round(float(v) * (1 << _SUB)) for v in (*centre, radius))
        cv2.circle(canvas, (x, y), max(r, 1), 255, -1, cv2.LINE_8, _SUB)
    along = end - start
    length = float(np.hypot(*along))
    if length < 1e-6:
        return
    normal = np.array([-along[1], along[0]]) / length
    corners = np.stack([
        start + normal * start_radius,
        end + normal * end_radius,
        end - normal * end_radius,
        start - normal * start_radius,
    ])  # fmt: skip
    cv2.fillConvexPoly(canvas, np.round(corners * (1 << _SUB)).astype(np.int32), 255, cv2.LINE_8, _SUB)


def _forearm_axes(
    points: NDArray[np.floating], scale: float, height: int, width: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """``along`` and ``across`` of :class:`CapsuleHand`."""
    wrist = points[0].astype(np.float64)
    axis = wrist - points[[1, 4, 10, 7]].mean(0)
    axis /= max(float(np.hypot(*axis)), 1e-6) * scale
    x = (np.arange(width) + 0.5 - wrist[0])[None]
    y = (np.arange(height) + 0.5 - wrist[1])[:, None]
    along = (x * axis[0] + y * axis[1]).astype(np.float32)
    return along, np.abs(x * axis[1] - y * axis[0]).astype(np.float32)
