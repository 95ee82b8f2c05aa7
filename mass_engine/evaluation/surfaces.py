"""Errors of geometry where the truth is known: depth, normals, distances between surfaces. Metres."""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

Array = NDArray[np.float64]


def depth_error(depth: Tensor, target: Tensor, mask: Tensor) -> float:
    """Mean absolute difference in metres of two depth maps [H,W] over ``mask``; NaN where that is empty."""
    return float((depth - target).abs()[mask].mean()) if bool(mask.any()) else math.nan


def normal_error(normals: Tensor, target: Tensor, mask: Tensor) -> float:
    """Mean angle in degrees between two normal maps [H,W,3] (of any length) over ``mask``; NaN without."""
    if not bool(mask.any()):
        return math.nan
    a, b = (torch.nn.functional.normalize(n[mask].double(), dim=-1) for n in (normals, target))
    # The arc of the chord is exact for small angles, where an arc cosine is not.
    return math.degrees(float(2 * torch.asin(((a - b).norm(dim=-1) / 2).clamp(max=1)).mean()))


def surface_distance(points: Array, vertices: Array, faces: NDArray[np.int64], near: int = 16) -> Array:
    """Distance [P] of points to the nearest of the ``near`` triangles with the closest centroids."""
    corners = vertices[faces]
    candidates = cKDTree(corners.mean(1)).query(points, k=min(near, len(faces)))[1]
    return np.asarray(_point_triangle(points[:, None], corners[candidates]).min(1))


def similarity(source: Array, target: Array) -> tuple[float, Array, Array]:
    """Scale, rotation [3,3] and shift [3] that lay points [N,3] on points (Umeyama 1991)."""
    a, b = source - source.mean(0), target - target.mean(0)
    u, d, vt = np.linalg.svd(b.T @ a)
    flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = u @ flip @ vt
    scale = float((d * np.diag(flip)).sum() / (a * a).sum())
    return scale, rotation, target.mean(0) - scale * rotation @ source.mean(0)


def _point_triangle(p: Array, corners: Array) -> Array:
    """Distances of points [...,3] to triangles [...,3,3]: inside by the plane, else the nearest edge."""
    a, b, c = np.moveaxis(corners, -2, 0)
    n = np.cross(b - a, c - a)
    area = np.maximum((n * n).sum(-1), 1e-30)
    inside = np.ones(p.shape[:1] + corners.shape[1:2], bool)
    nearest = np.full(inside.shape, np.inf)
    for u, v in ((a, b), (b, c), (c, a)):
        edge = v - u
        inside &= (np.cross(edge, p - u) * n).sum(-1) >= 0
        place = np.clip(((p - u) * edge).sum(-1) / np.maximum((edge * edge).sum(-1), 1e-30), 0, 1)
        nearest = np.minimum(nearest, np.linalg.norm(p - u - place[..., None] * edge, axis=-1))
    plane = np.abs(((p - a) * n).sum(-1)) / np.sqrt(area)
    return np.where(inside, plane, nearest)
