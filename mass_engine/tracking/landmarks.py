"""21 landmarks of one hand inside a region of an image.

Network: MediaPipe Hands (Zhang et al. 2020). Its joint order is turned into ours here and nowhere else.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mass_engine.hand.pose import Side
from mass_engine.tracking.models import Network
from mass_engine.tracking.region import Region, upward_angle

#: Row i of our 21 points is row NETWORK_ORDER[i] of the network's (wrist, then thumb, index, middle,
#: ring, little finger, four points each from the hand outwards).
NETWORK_ORDER: tuple[int, ...] = (
    0, 5, 6, 7, 9, 10, 11, 17, 18, 19, 13, 14, 15, 1, 2, 3, 4, 8, 12, 16, 20,
)  # fmt: skip

WRIST, INDEX_1, MIDDLE_1, PINKY_1, RING_1, THUMB_1, THUMB_2, THUMB_3 = 0, 1, 4, 7, 10, 13, 14, 15

#: Bones as (parent, child) rows of the 21 points.
BONES: tuple[tuple[int, int], ...] = (
    (0, 1), (1, 2), (2, 3), (3, 17),
    (0, 4), (4, 5), (5, 6), (6, 18),
    (0, 7), (7, 8), (8, 9), (9, 20),
    (0, 10), (10, 11), (11, 12), (12, 19),
    (0, 13), (13, 14), (14, 15), (15, 16),
)  # fmt: skip

#: Points that span the next frame's region: wrist, thumb, and the two lower joints of each finger.
_STABLE = (0, 13, 14, 15, 1, 2, 4, 5, 10, 11, 7, 8)
_LANDMARKS_TO_HAND, _HAND_SHIFT = 2.0, -0.1


@dataclass(frozen=True)
class HandLandmarks:
    """One hand in one frame.

    ``points`` [21,2] float32 pixels of the upright full image (pixel centres at +0.5), in the joint order
    of :data:`mass_engine.hand.pose.JOINT_NAMES`; ``world`` [21,3] metres, x right, y down, z away from the
    camera, about the hand's middle (a weak cue: bone lengths are not constant); ``score`` the network's
    presence, 0..1; ``right`` its probability that this is a right hand, before any vote over the clip;
    ``track`` numbers the uninterrupted run of frames; ``trusted`` is False for an outlier; ``at_joints`` says
    that the points are joints of a hand model, not what this tracker sees (:mod:`.offsets`). ``reading`` is
    what the network saw where ``points`` were put right (:mod:`.continuity`).
    """

    index: int
    side: Side
    points: NDArray[np.float32]
    world: NDArray[np.float32]
    score: float
    right: float
    track: int = 0
    trusted: bool = True
    at_joints: bool = False
    reading: NDArray[np.float32] | None = None

    @property
    def as_read(self) -> NDArray[np.float32]:
        """Points [21,2] as the network saw them: wrong fingers, perhaps, but on the hand's outline."""
        return self.points if self.reading is None else self.reading

    @property
    def scale(self) -> float:
        """Hand size in pixels: the diagonal of the landmarks' bounding box."""
        return hand_scale(self.points)


@dataclass(frozen=True)
class Reading:
    """What the landmark network says about one region: as :class:`HandLandmarks`, in image pixels."""

    points: NDArray[np.float32]
    world: NDArray[np.float32]
    score: float
    right: float


def hand_scale(points: NDArray[np.floating]) -> float:
    """The diagonal of the bounding box of ``points`` [21,2]."""
    return float(np.linalg.norm(points.max(0) - points.min(0)))


def region_of(points: NDArray[np.floating]) -> Region:
    """The region to look at next, from landmarks [21,2] in pixels."""
    knuckles = (points[INDEX_1] + points[RING_1]) / 2
    angle = upward_angle(points[WRIST], (knuckles + points[MIDDLE_1]) / 2)
    stable = points[list(_STABLE)]
    centre = (stable.max(0) + stable.min(0)) / 2
    cos, sin = np.cos(angle), np.sin(angle)
    turn = np.array([[cos, -sin], [sin, cos]])  # image axes to the region's own
    local = (stable - centre) @ turn
    low, high = local.min(0), local.max(0)
    x, y = centre + (low + high) / 2 @ turn.T
    box = Region(float(x), float(y), max(float((high - low).max()), 1.0), angle)
    return box.shifted(0.0, _HAND_SHIFT, _LANDMARKS_TO_HAND)


class LandmarkReader:
    """Runs the landmark network on a region."""

    def __init__(self, network: Network) -> None:
        self._network = network

    def __call__(self, rgb: NDArray[np.uint8], region: Region) -> Reading:
        """Landmarks of the hand in ``region`` of ``rgb``, whether there is one or not: see ``score``."""
        side = self._network.size
        flat, presence, right, world = self._network(
            region.crop(rgb, side), ("Identity", "Identity_1", "Identity_2", "Identity_3")
        )
        order = list(NETWORK_ORDER)
        matrix = region.to_image(side)
        local = flat.reshape(21, 3)[order, :2]
        points = local @ matrix[:, :2].T + matrix[:, 2]
        cos, sin = np.cos(region.angle), np.sin(region.angle)
        metric = world.reshape(21, 3)[order].astype(np.float64)
        metric[:, :2] = metric[:, :2] @ np.array([[cos, sin], [-sin, cos]])
        return Reading(
            points.astype(np.float32), metric.astype(np.float32), float(presence[0]), float(right[0])
        )
