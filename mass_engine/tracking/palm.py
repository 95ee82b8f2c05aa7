"""The palm detector: anchors, decoding, non-maximum suppression.

Network and conventions: MediaPipe Hands (Zhang et al. 2020, "MediaPipe Hands: On-device Real-time Hand
Tracking"); a single-shot detector in the manner of Liu et al. 2016.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from mass_engine.tracking.models import Network
from mass_engine.tracking.region import Region, upward_angle

#: Grid cells per side and anchors per cell of the two feature maps (strides 8 and 16 of 192).
ANCHOR_GRIDS: tuple[tuple[int, int], ...] = ((24, 2), (12, 6))

_WRIST, _MIDDLE_KNUCKLE = 0, 2  # among the detector's seven keypoints
_BOX_TO_HAND, _HAND_SHIFT = 2.6, -0.5


@dataclass(frozen=True)
class Palm:
    """``score`` 0..1; ``box`` (x0, y0, x1, y1) and ``keypoints`` [7,2] in pixels of the full image."""

    score: float
    box: NDArray[np.float32]
    keypoints: NDArray[np.float32]

    def region(self) -> Region:
        """The square around the whole hand this palm belongs to."""
        x0, y0, x1, y1 = (float(v) for v in self.box)
        angle = upward_angle(self.keypoints[_WRIST], self.keypoints[_MIDDLE_KNUCKLE])
        box = Region((x0 + x1) / 2, (y0 + y1) / 2, max(x1 - x0, y1 - y0), angle)
        return box.shifted(0.0, _HAND_SHIFT, _BOX_TO_HAND)


@dataclass(frozen=True)
class View:
    """An axis-aligned square window of the image, in pixels: what the detector sees in one pass."""

    x: float
    y: float
    size: float


def anchors() -> NDArray[np.float32]:
    """Anchor centres [2016,2] in fractions of the input."""
    centres = []
    for cells, per_cell in ANCHOR_GRIDS:
        axis = (np.arange(cells, dtype=np.float32) + 0.5) / cells
        y, x = np.meshgrid(axis, axis, indexing="ij")
        centres.append(np.repeat(np.stack([x.ravel(), y.ravel()], 1), per_cell, axis=0))
    return np.concatenate(centres)


def decode(
    raw: NDArray[np.float32],
    logits: NDArray[np.float32],
    centres: NDArray[np.float32],
    side: int,
    floor: float,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Network outputs ``raw`` [A,18] and ``logits`` [A,1] -> scores [n] and points [n,9,2] above ``floor``.

    Points are two box corners and seven keypoints, in fractions of the input (``side`` pixels).
    """
    scores = 1 / (1 + np.exp(-np.clip(logits[:, 0], -100, 100)))
    keep = scores >= floor
    values = raw[keep].reshape(-1, 9, 2) / side
    centre = centres[keep][:, None]
    middle, extent = values[:, :1] + centre, values[:, 1:2]
    points = np.concatenate([middle - extent / 2, middle + extent / 2, values[:, 2:] + centre], 1)
    return scores[keep].astype(np.float32), points.astype(np.float32)


def overlap(box: NDArray[np.float32], boxes: NDArray[np.float32]) -> NDArray[np.float32]:
    """Intersection over union of one box (4) with boxes [n,4], corners (x0, y0, x1, y1)."""
    low = np.maximum(box[:2], boxes[:, :2])
    high = np.minimum(box[2:], boxes[:, 2:])
    inside = np.prod(np.clip(high - low, 0, None), axis=1)
    area = np.prod(box[2:] - box[:2]) + np.prod(boxes[:, 2:] - boxes[:, :2], axis=1) - inside
    return np.asarray(inside / np.maximum(area, 1e-9), np.float32)


def merge(scores: NDArray[np.float32], points: NDArray[np.float32], iou: float = 0.3) -> list[Palm]:
    """Weighted non-maximum suppression: overlapping detections are averaged by score, best first."""
    boxes = points[:, :2].reshape(-1, 4)
    left = np.argsort(-scores, kind="stable")
    palms = []
    while left.size:
        same = overlap(boxes[left[0]], boxes[left]) > iou
        same[0] = True
        group = left[same]
        weight = scores[group] / scores[group].sum()
        mean = np.einsum("n,nij->ij", weight, points[group]).astype(np.float32)
        palms.append(Palm(float(scores[group[0]]), mean[:2].reshape(4), mean[2:]))
        left = left[~same]
    return palms


class PalmDetector:
    """Finds palms in square views of an image."""

    def __init__(self, network: Network) -> None:
        self._network = network
        self._anchors = anchors()

    def __call__(self, rgb: NDArray[np.uint8], views: Sequence[View], floor: float) -> list[Palm]:
        """Palms scoring at least ``floor`` in any of ``views``, merged over the views, best first."""
        scores, points = [], []
        side = self._network.size
        for view in views:
            k = view.size / side
            matrix = np.array([[k, 0.0, view.x], [0.0, k, view.y]])
            crop = cv2.warpAffine(rgb, matrix, (side, side), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
            raw, logits = self._network(np.asarray(crop, np.uint8), ("Identity", "Identity_1"))
            found, places = decode(raw, logits, self._anchors, side, floor)
            scores.append(found)
            points.append(places * np.float32(view.size) + np.array([view.x, view.y], np.float32))
        if not scores:
            return []
        return merge(np.concatenate(scores), np.concatenate(points))
