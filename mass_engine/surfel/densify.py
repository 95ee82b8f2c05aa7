"""Fractal densification: a face's own inellipse and, in the corners it leaves free, smaller triangles'."""

from __future__ import annotations

import torch
from torch import Tensor

#: Surfels a face gets at each depth: 1, 1 + 3, 1 + 3 + 9.
SURFELS_PER_FACE = (1, 4, 13)


def fractal_corners(depth: int) -> Tensor:
    """Barycentric corners [K,3 corners,3] of the K triangles whose inellipses cover a face.

    Depth 0 is the face itself. Each further depth adds, Sierpinski's way, the three half-size triangles in
    the corners of every triangle of the depth before: the inellipse touches the edges' midpoints, so what it
    leaves free lies in those corners.
    """
    if not 0 <= depth < len(SURFELS_PER_FACE):
        raise ValueError(f"depth must be 0 to {len(SURFELS_PER_FACE) - 1}, not {depth}")
    newest = torch.eye(3).unsqueeze(0)
    triangles = [newest]
    for _ in range(depth):
        # Corner i of each triangle, and the midpoints of the two edges that meet there.
        newest = torch.stack([(newest + newest[:, [i]]) / 2 for i in range(3)], 1).flatten(0, 1)
        triangles.append(newest)
    return torch.cat(triangles)
