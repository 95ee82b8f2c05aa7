"""Triangles in a picture by z-buffer: exact masks, depth and normals of a mesh. Plain numpy, no gradients."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mass_engine.camera import Camera

Array = NDArray[np.float64]

#: Candidates (triangle times pixel) looked at in one go: bounds memory.
_CHUNK = 4_000_000
_NEAR = 0.01


@dataclass(frozen=True)
class Fragments:
    """What each pixel [H,W] shows: ``face`` (-1: nothing), ``depth`` in metres (camera z, 0: nothing) and
    ``weights`` [H,W,3] of the face's corners, correct in perspective."""

    face: NDArray[np.int64]
    depth: Array
    weights: Array

    def interpolate(self, faces: NDArray[np.int64], values: Array) -> Array:
        """Values [V,C] of vertices at every pixel [H,W,C]; 0 where nothing is."""
        hit = self.face >= 0
        result = np.zeros((*hit.shape, values.shape[1]))
        result[hit] = (self.weights[hit][..., None] * values[faces[self.face[hit]]]).sum(-2)
        return result


def rasterize_mesh(
    vertices: Array, faces: NDArray[np.int64], camera: Camera, cull: bool = False
) -> Fragments:
    """The nearest triangle at every pixel centre. ``vertices`` [V,3] world metres, ``faces`` [F,3].

    ``cull``: leave out faces whose corners run clockwise as the camera sees them (from behind). Triangles
    that reach nearer than 1 cm are not drawn.
    """
    pose = camera.world_to_camera.double().numpy()
    K = camera.K.double().numpy()
    height, width = camera.height, camera.width
    seen = vertices @ pose[:3, :3].T + pose[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        pixels = seen[:, :2] / seen[:, 2:] @ K[:2, :2].T + K[:2, 2]
    corners, z = pixels[faces], seen[faces][..., 2]
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    area = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    with np.errstate(invalid="ignore"):
        low = np.maximum(np.ceil(corners.min(1) - 0.5), 0)
        high = np.minimum(np.floor(corners.max(1) - 0.5), (width - 1, height - 1))
        usable = (z > _NEAR).all(1) & np.isfinite(area) & (np.abs(area) > 1e-12) & (low <= high).all(1)
    if cull:
        usable &= area < 0  # y points down: outward faces turn clockwise on the screen
    index = np.flatnonzero(usable)
    low, high = low[index].astype(np.int64), high[index].astype(np.int64)
    spans = high - low + 1
    counts = spans[:, 0] * spans[:, 1]
    face = np.full(height * width, -1, np.int64)
    depth = np.full(height * width, np.inf)
    weights = np.zeros((height * width, 3))
    starts = np.concatenate([[0], np.cumsum(counts)])
    first = 0
    while first < len(index):
        last = max(first + 1, int(np.searchsorted(starts, starts[first] + _CHUNK, side="right")) - 1)
        owner = np.repeat(np.arange(first, last), counts[first:last])
        place = np.arange(len(owner)) - (starts[owner] - starts[first])
        x = low[owner, 0] + place % spans[owner, 0]
        y = low[owner, 1] + place // spans[owner, 0]
        triangle = index[owner]
        found = _inside(a[triangle], b[triangle], c[triangle], area[triangle], x + 0.5, y + 0.5)
        inside = (found >= 0).all(1)
        found, triangle = found[inside], triangle[inside]
        at = y[inside] * width + x[inside]
        over = found / z[triangle]  # screen weights to weights in space
        total = over.sum(1)
        d = 1 / total
        np.minimum.at(depth, at, d)
        nearest = d == depth[at]
        at = at[nearest]
        face[at] = triangle[nearest]
        weights[at] = over[nearest] / total[nearest, None]
        first = last
    depth[face < 0] = 0
    return Fragments(
        face.reshape(height, width), depth.reshape(height, width), weights.reshape(height, width, 3)
    )


def mesh_mask(vertices: Array, faces: NDArray[np.int64], camera: Camera) -> NDArray[np.bool_]:
    """Pixels [H,W] whose centre the mesh covers."""
    return np.asarray(rasterize_mesh(vertices, faces, camera).face >= 0)


def _inside(a: Array, b: Array, c: Array, area: Array, x: Array, y: Array) -> Array:
    """Screen weights [P,3] of the corners at points (x, y); negative outside."""
    one = (b[:, 0] - x) * (c[:, 1] - y) - (b[:, 1] - y) * (c[:, 0] - x)
    two = (c[:, 0] - x) * (a[:, 1] - y) - (c[:, 1] - y) * (a[:, 0] - x)
    weights = np.stack([one, two, area - one - two], -1) / area[:, None]
    return np.asarray(np.where(np.abs(weights) < 1e-12, 0.0, weights))
