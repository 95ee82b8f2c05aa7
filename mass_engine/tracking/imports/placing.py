"""Putting a posed hand where the picture shows it: projection, and the translation from image points."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def project(points: Array, K: Array, distortion: Array | None = None) -> Array:
    """Camera points [F,N,3] metres -> pixels [F,N,2], through the lens where ``distortion`` [8] is given."""
    if distortion is None:
        seen = points @ K.T
        return np.asarray(seen[..., :2] / seen[..., 2:])
    flat, _ = cv2.projectPoints(points.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), K, distortion)
    return np.asarray(flat, np.float64).reshape(*points.shape[:-1], 2)


def solve_translation(shape: Array, pixels: Array, K: Array) -> Array:
    """The shift [F,3] that brings points [F,N,3] (metres, camera axes) onto ``pixels`` [F,N,2].

    A point p lies on the viewing ray (x, y, 1) of its pixel when p_x + t_x = x (p_z + t_z), the same for y:
    linear in t, solved by least squares. That weighs a pixel by its depth; three Gauss-Newton steps from
    there end at the least pixel error.
    """
    rays = np.concatenate([pixels, np.ones((*pixels.shape[:-1], 1))], -1) @ np.linalg.inv(K).T
    seen = rays[..., :2]
    flat = np.broadcast_to(np.eye(2), (*seen.shape, 2))
    result = _least_squares(
        np.concatenate([flat, -seen[..., None]], -1), seen * shape[..., 2:] - shape[..., :2]
    )
    for _ in range(3):
        placed = shape + result[:, None]
        depth = np.where(np.abs(placed[..., 2:]) > 1e-6, placed[..., 2:], 1e-6)
        ratio = placed[..., :2] / depth
        slope = np.concatenate([flat, -ratio[..., None]], -1) / depth[..., None]
        result = result + _least_squares(K[:2, :2] @ slope, (seen - ratio) @ K[:2, :2].T)
    return result


def _least_squares(left: Array, right: Array) -> Array:
    """The x [F,3] nearest to ``left`` [F,N,2,3] x = ``right`` [F,N,2]."""
    normal = np.einsum("fnki,fnkj->fij", left, left)
    return np.asarray(np.linalg.solve(normal, np.einsum("fnki,fnk->fi", left, right)[..., None])[..., 0])


def seen_in(pixels: Array, size: tuple[int, int]) -> Array:
    """The share [F] of points [F,N,2] that lie inside a picture of ``size`` (width, height)."""
    inside = ((pixels >= 0) & (pixels < np.array(size))).all(-1)
    return np.asarray(inside.mean(-1), np.float64)
