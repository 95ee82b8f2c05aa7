"""The Steiner inellipse of a triangle: the ellipse inside it that touches its edges at their midpoints.

With centroid G, the vectors P = (C - G) / 2 and Q = (B - A) / (2 sqrt 3) are conjugate half-diameters of it:
G + P cos t + Q sin t runs along the ellipse. A Gaussian over G + u P + v Q with weight exp(-(u^2 + v^2) / 2)
does not change when (u, v) is rotated, so (P, Q) describe the surfel as well as the principal axes do, and
they are *linear* in the vertices: no eigen-decomposition, nothing singular for equilateral or sliver
triangles. The principal axes (the paper's eqs. 2 to 8) are taken only where scales and rotation are wanted.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

#: Standard deviation of a surfel per semi-axis of its inellipse.
SIGMA_PER_SEMI_AXIS = 1.0

#: Rows: centroid, P and Q as combinations of the corners A, B, C.
CONJUGATE = (
    (1 / 3, 1 / 3, 1 / 3),
    (-1 / 6, -1 / 6, 1 / 3),
    (-0.5 / math.sqrt(3), 0.5 / math.sqrt(3), 0.0),
)


def conjugate_axes(triangles: Tensor) -> Tensor:
    """Triangles [...,3 corners,3] -> [...,3,3]: centroid, P and Q (see the module), in the input's units."""
    return torch.tensor(CONJUGATE, dtype=triangles.dtype) @ triangles


def principal_axes(p: Tensor, q: Tensor) -> tuple[Tensor, Tensor]:
    """Semi-axes [...,2] (long, short) and their unit directions with the normal, a rotation [...,3,3] by columns.

    ``p``, ``q`` [...,3] are conjugate half-diameters. The extremes of |P cos t + Q sin t| lie at
    tan 2t = 2 P.Q / (|P|^2 - |Q|^2), which is the 2x2 symmetric eigen-problem in closed form. Values and
    gradients stay finite for circles (any axes serve) and for degenerate triangles.
    """
    cross = 2 * (p * q).sum(-1)
    difference = (p * p).sum(-1) - (q * q).sum(-1)
    # atan2 has no gradient at the origin: there (a circle) every angle is right, take 0.
    circle = (cross.abs() + difference.abs()) < 1e-12 * ((p * p).sum(-1) + (q * q).sum(-1)) + 1e-30
    angle = 0.5 * torch.atan2(
        torch.where(circle, torch.zeros_like(cross), cross),
        torch.where(circle, torch.ones_like(difference), difference),
    )
    cos, sin = angle.cos().unsqueeze(-1), angle.sin().unsqueeze(-1)
    long, short = p * cos + q * sin, q * cos - p * sin
    long_length, short_length = safe_norm(long), safe_norm(short)
    u = long / long_length.unsqueeze(-1)
    normal = torch.linalg.cross(long, short)
    normal_length = safe_norm(normal).unsqueeze(-1)
    # A sliver has no normal of its own; any direction across its long axis will do.
    n = torch.where(normal_length > 1e-20, normal / normal_length, _across(u))
    return torch.stack([long_length, short_length], -1), torch.stack([u, torch.linalg.cross(n, u), n], -1)


def safe_norm(vectors: Tensor) -> Tensor:
    """Length [...] of vectors [...,3]; at zero it is tiny instead of having no gradient."""
    return ((vectors * vectors).sum(-1) + 1e-24).sqrt()


def _across(u: Tensor) -> Tensor:
    """Some unit vector perpendicular to unit ``u`` [...,3]."""
    axis = torch.nn.functional.one_hot(u.abs().argmin(-1), 3).to(u.dtype)
    return torch.nn.functional.normalize(torch.linalg.cross(u, axis), dim=-1)


def matrix_to_quat(rotation: Tensor) -> Tensor:
    """Rotations [...,3,3] -> unit quaternions [...,4] (wxyz), by the largest of the four components."""
    m = rotation
    trace = m[..., 0, 0] + m[..., 1, 1] + m[..., 2, 2]
    four = torch.stack([trace, m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]], -1)
    diagonal = torch.cat([1 + trace.unsqueeze(-1), 1 + 2 * four[..., 1:] - trace.unsqueeze(-1)], -1)
    a = m[..., 2, 1] - m[..., 1, 2]
    b = m[..., 0, 2] - m[..., 2, 0]
    c = m[..., 1, 0] - m[..., 0, 1]
    d = m[..., 0, 1] + m[..., 1, 0]
    e = m[..., 0, 2] + m[..., 2, 0]
    f = m[..., 1, 2] + m[..., 2, 1]
    w2, x2, y2, z2 = diagonal.unbind(-1)
    rows = torch.stack(
        [
            torch.stack([w2, a, b, c], -1),
            torch.stack([a, x2, d, e], -1),
            torch.stack([b, d, y2, f], -1),
            torch.stack([c, e, f, z2], -1),
        ],
        -2,
    )
    best = diagonal.argmax(-1)[..., None, None].expand(*diagonal.shape[:-1], 1, 4)
    return torch.nn.functional.normalize(torch.gather(rows, -2, best).squeeze(-2), dim=-1)


def steiner_inellipse(triangles: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Triangles [...,3,3] -> centroid [...,3], semi-axes [...,2] (paper eq. 2), quats [...,4] (eq. 8).

    The third axis is the triangle's outward normal (corners counter-clockwise seen from outside).
    """
    centroid, p, q = conjugate_axes(triangles).unbind(-2)
    # P toward C and Q from A to B: (Q, P) turns counter-clockwise as A, B, C do.
    semi_axes, rotation = principal_axes(q, p)
    return centroid, semi_axes, matrix_to_quat(rotation)


def quat_to_matrix(quats: Tensor) -> Tensor:
    """Unit quaternions [...,4] (wxyz) -> rotations [...,3,3]."""
    w, x, y, z = quats.unbind(-1)
    rows = [
        torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
        torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
        torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
    ]
    return torch.stack(rows, -2)
