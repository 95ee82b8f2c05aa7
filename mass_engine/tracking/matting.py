"""Soft edges: how much of each pixel near a rough outline is hand, from the colours on either side."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

_SURE = 1.7  # pixels of the rough mask from its edge where a colour is taken as known
_REACH = 5.0  # pixels from the edge in which colours are collected
_CONTRAST = 12.0  # colour distance (of 255) at which the two sides are told apart half and half
_GAIN = 2.0  # lens, codec and chroma make an edge in a video this much wider than its pixels' coverage
# Where between the colours on both sides a half covered pixel lies: a hand turns away at its edge, which is
# less like its inside for that (0.1 pixel on rendered clips).
_HALF = 0.46
_WHOLE = 0.85  # share of hand from which a pixel beside a sleeve shows the hand's colour
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


def refine_seam(
    rgb: NDArray[np.uint8], hand: NDArray[np.bool_], ignore: NDArray[np.bool_], blur: float
) -> NDArray[np.bool_]:
    """Pixels [h,w] of ``hand`` that belong to what is ignored beside it (a sleeve), by their colour.

    Within twice ``blur`` pixels of ``ignore`` each pixel of the hand is laid on the line between the mean
    colours of both sides, as in :func:`refine_edge`. What is not nearly all hand goes; where the sides are
    alike (a bare forearm), nothing does.
    """
    out = np.zeros_like(hand)
    sure, reach = max(_SURE, 1.2 * blur), max(_REACH, 4.0 * blur)
    away = cv2.distanceTransform((~ignore).astype(np.uint8), cv2.DIST_L2, 3)
    # Pixels at the outline are mixed with the background, and softly so: they stay.
    rest = cv2.distanceTransform((hand | ignore).astype(np.uint8), cv2.DIST_L2, 3)
    rows, columns = np.nonzero(hand & (away <= 2.0 * sure) & (rest > sure))
    if len(rows) == 0:
        return out
    skin = hand & (away > 2.0 * sure) & (away < 3.0 * reach)
    means = (_local_mean(rgb, side, 1.5 * reach) for side in (skin, ignore))
    fore, back = (
        mean[np.minimum(rows // 2, mean.shape[0] - 1), np.minimum(columns // 2, mean.shape[1] - 1)]
        for mean in means
    )
    line = fore[:, :3] - back[:, :3]
    contrast = (line * line).sum(1)
    place = ((rgb[rows, columns] - back[:, :3]) * line).sum(1) / np.maximum(contrast, 1.0)
    known = (np.minimum(fore[:, 3], back[:, 3]) > 0.01) & (contrast > (2 * _CONTRAST) ** 2)
    out[rows, columns] = known & (place < _WHOLE)
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
    known_hand = (edge > sure) & (edge < 2.5 * reach) & ~ignore
    known_rest = (edge < -sure) & (edge > -2.5 * reach) & ~ignore
    rows, columns = np.nonzero(np.abs(edge) < 1.5 * sure)
    means = (_local_mean(rgb, side, reach) for side in (known_hand, known_rest))
    fore, back = (
        mean[np.minimum(rows // 2, mean.shape[0] - 1), np.minimum(columns // 2, mean.shape[1] - 1)]
        for mean in means
    )
    line = fore[:, :3] - back[:, :3]
    contrast = (line * line).sum(1)
    place = ((rgb[rows, columns] - back[:, :3]) * line).sum(1) / np.maximum(contrast, 1.0)
    place = np.clip(0.5 + _GAIN * (place - _HALF), 0.0, 1.0)
    known = np.minimum(fore[:, 3], back[:, 3]) > 0.01
    trust = np.where(known, contrast / (contrast + _CONTRAST**2), 0.0)
    alpha = (edge > 0).astype(np.float32)
    alpha[rows, columns] = trust * place + (1 - trust) * rough[rows, columns]
    # The contour this gives decides; softness only beside it.
    final = cv2.medianBlur((alpha > 0.5).astype(np.uint8), 3)
    far = _distance(final > 0)
    return np.where(np.abs(far) <= _BAND, alpha, far > 0).astype(np.float32)


def _local_mean(rgb: NDArray[np.uint8], use: NDArray[np.bool_], reach: float) -> NDArray[np.float32]:
    """Mean colour of the used pixels up to ``reach`` away, and their share: [h/2,w/2,4].

    At half the size: a mean over so many pixels loses nothing by it.
    """
    height, width = use.shape
    half = max(1, width // 2), max(1, height // 2)
    weight = use.astype(np.uint8)
    masked = cv2.bitwise_and(rgb, rgb, mask=weight)
    stack = cv2.merge([*cv2.split(masked), 255 * weight])
    halved = cv2.resize(stack, half, interpolation=cv2.INTER_AREA).astype(np.float32)
    size = 2 * max(1, round(reach / 2)) + 1
    mean = np.asarray(cv2.blur(halved, (size, size), borderType=cv2.BORDER_CONSTANT), np.float32)
    mean[..., 3] /= 255
    mean[..., :3] /= np.maximum(mean[..., 3:], 1e-6)
    return mean
