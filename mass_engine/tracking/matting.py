"""Soft edges: how much of each pixel near a rough outline is hand, from the colours on either side."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

_SURE = 1.7  # pixels of the rough mask from its edge where a colour is taken as known
_REACH = 5.0  # pixels from the edge in which colours are collected
_CONTRAST = 12.0  # colour distance (of 255) at which the two sides are told apart half and half
_GAIN = 2.0  # lens, codec and chroma make an edge in a video this much wider than its pixels' coverage
_BAND = 1.6  # pixels from the final edge beyond which coverage is whole or nothing


def refine_edge(
    rgb: NDArray[np.uint8], rough: NDArray[np.float32], ignore: NDArray[np.bool_], blur: float
) -> NDArray[np.float32]:
    """Coverage [h,w] in 0..1 of the hand in ``rgb`` uint8 [h,w,3].

    ``rough`` [h,w] is a first mask in 0..1, good to about ``blur`` pixels. Within that of its edge each pixel
    is laid on the line between the mean colours of hand and background nearby (compositing equation); where
    these are alike, the rough mask stands. Next to ``ignore`` it stands as well.
    """
    hand = rough > 0.5
    edge = _distance(hand)
    sure, reach = max(_SURE, 1.2 * blur), max(_REACH, 4.0 * blur)
    near = np.abs(edge) < reach
    if not near.any():
        return hand.astype(np.float32)
    rows, columns = np.flatnonzero(near.any(1)), np.flatnonzero(near.any(0))
    window = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    out = hand.astype(np.float32)
    out[window] = _matte(rgb[window], rough[window], edge[window], ignore[window], sure, reach)
    return out


def _distance(inside: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Pixels to the edge, positive inside; 0 lies between the pixels."""
    flat = inside.astype(np.uint8)
    within = cv2.distanceTransform(flat, cv2.DIST_L2, 3)
    without = cv2.distanceTransform(1 - flat, cv2.DIST_L2, 3)
    return np.asarray(np.where(inside, within - 0.5, 0.5 - without), np.float32)


def _matte(
    rgb: NDArray[np.uint8],
    rough: NDArray[np.float32],
    edge: NDArray[np.float32],
    ignore: NDArray[np.bool_],
    sure: float,
    reach: float,
) -> NDArray[np.float32]:
    color = rgb.astype(np.float32)
    known_hand = (edge > sure) & (edge < 2.5 * reach) & ~ignore
    known_rest = (edge < -sure) & (edge > -2.5 * reach) & ~ignore
    fore, back = (_local_mean(color, side, reach) for side in (known_hand, known_rest))
    line = fore[..., :3] - back[..., :3]
    contrast = np.einsum("hwc,hwc->hw", line, line)
    place = np.einsum("hwc,hwc->hw", color - back[..., :3], line) / np.maximum(contrast, 1.0)
    place = 0.5 + _GAIN * (place - 0.5)
    known = np.minimum(fore[..., 3], back[..., 3]) > 0.01
    trust = np.where(known, contrast / (contrast + _CONTRAST**2), 0.0).astype(np.float32)
    alpha = trust * np.clip(place, 0.0, 1.0) + (1 - trust) * rough
    alpha = np.where(np.abs(edge) < 1.5 * sure, alpha, edge > 0).astype(np.float32)
    # The contour this gives decides; softness only beside it.
    final = cv2.medianBlur((alpha > 0.5).astype(np.uint8), 3)
    far = _distance(final > 0)
    return np.where(np.abs(far) <= _BAND, alpha, far > 0).astype(np.float32)


def _local_mean(color: NDArray[np.float32], use: NDArray[np.bool_], reach: float) -> NDArray[np.float32]:
    """Mean colour of the used pixels up to ``reach`` away, and their share: [h,w,4].

    Sums are taken at half the size: a mean over so many pixels loses nothing by it.
    """
    height, width = use.shape
    half = max(1, width // 2), max(1, height // 2)
    weight = use.astype(np.float32)
    stack = cv2.merge([*cv2.split(color * weight[..., None]), weight])
    halved = cv2.resize(stack, half, interpolation=cv2.INTER_AREA)
    size = 2 * max(1, round(reach / 2)) + 1
    small = np.asarray(cv2.blur(halved, (size, size), borderType=cv2.BORDER_CONSTANT), np.float32)
    small[..., :3] /= np.maximum(small[..., 3:], 1e-6)
    return np.asarray(cv2.resize(small, (width, height)), np.float32)
