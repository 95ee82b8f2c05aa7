"""How well a silhouette agrees with another. Masks are bool [H,W]; ``valid`` leaves pixels out of the sum."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from torch import Tensor

Bools = NDArray[np.bool_]


def iou(mask: Tensor, target: Tensor, valid: Tensor | None = None) -> float:
    """Intersection over union of two bool masks [H,W], over the ``valid`` pixels; 1 when both are empty."""
    if valid is not None:
        mask, target = mask & valid, target & valid
    union = int((mask | target).sum())
    return 1.0 if union == 0 else int((mask & target).sum()) / union


def signed_distance(inside: Bools) -> NDArray[np.float32]:
    """Pixels from each pixel's centre to the nearest one of the other kind, positive inside."""
    if inside.all() or not inside.any():
        return np.full(inside.shape, np.inf if inside.all() else -np.inf, np.float32)
    flat = inside.astype(np.uint8)
    within, without = (cv2.distanceTransform(side, cv2.DIST_L2, 5) for side in (flat, 1 - flat))
    return np.asarray(within - without, np.float32)


def border(inside: Bools) -> Bools:
    """Pixels inside that touch the outside."""
    core = np.asarray(cv2.erode(inside.astype(np.uint8), np.ones((3, 3), np.uint8)))
    return np.asarray(inside & (core == 0))


def free_border(valid: Bools) -> Bools:
    """Where an outline is the silhouette's own: 4 pixels from what is not ``valid``, 3 from the edge."""
    near = cv2.dilate((~valid).astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    near[:3] = near[-3:] = near[:, :3] = near[:, -3:] = True
    return np.asarray(~near)


def boundary_f(mask: Tensor, target: Tensor, reach: float, valid: Tensor | None = None) -> float:
    """F of the outlines: harmonic mean of the shares of either within ``reach`` pixels of the other.

    As in DAVIS (Perazzi et al. 2016), by distance transform instead of dilation. 1 when neither has an
    outline, 0 when only one has.
    """
    mine, true = mask.numpy(), target.numpy()
    free = free_border(np.ones(mine.shape, bool) if valid is None else valid.numpy())
    my_border, true_border = border(mine) & free, border(true) & free
    if not my_border.any() and not true_border.any():
        return 1.0
    if not my_border.any() or not true_border.any():
        return 0.0
    precision = float((_apart(true_border)[my_border] <= reach).mean())
    recall = float((_apart(my_border)[true_border] <= reach).mean())
    return 2 * precision * recall / max(precision + recall, 1e-9)


def _apart(pixels: Bools) -> NDArray[np.float32]:
    """Pixels from every pixel to the nearest of ``pixels``."""
    nothing = (~pixels).astype(np.uint8)
    return np.asarray(cv2.distanceTransform(nothing, cv2.DIST_L2, cv2.DIST_MASK_PRECISE), np.float32)
