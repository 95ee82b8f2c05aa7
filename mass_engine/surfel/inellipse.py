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
from torch.nn.functional import normalize

#: Standard deviation of a surfel per semi-axis of its inellipse. Chosen by coverage, the share of a resting
#: hand's pixels with alpha > 0.99, against blur, the contrast left of 4 mm stripes (python
#: benchmarks/hand_surfels.py coverage). At 1.0, 1.25 and 1.5 coverage is 0.27, 0.94 and 0.99 and contrast
#: 0.62, 0.50 and 0.45 with one Loop level alone; 0.99, 1.00 and 1.00 and 0.59, 0.50 and 0.42 with one fractal
#: depth more. The least of these that leaves no model full of holes.
SIGMA_PER_SEMI_AXIS = 1.25

#: Rows: centroid, P and Q as combinations of the corners A, B, C.
CONJUGATE = (
    (1 / 3, 1 / 3, 1 / 3),
    (-1 / 6, -1 / 6, 1 / 3),
    (-0.5 / math.sqrt(3), 0.5 / math.sqrt(3), 0.0),
)


def conjugate_axes(triangles: Tensor) -> Tensor:
    """Triangles [...,3 corners,3] -> [...,3,3]: centroid, P and Q (see the module), in the input's units."""
    return torch.tensor(CONJUGATE, dtype=triangles.dtype) @ triangles


def principal_scales_quats(p: Tensor, q: Tensor) -> tuple[Tensor, Tensor]:
    """Semi-axes [...,2] (long, short) and unit quats [...,4] (wxyz) of their directions, normal third.

    ``p``, ``q`` [...,3] are conjugate half-diameters; the normal is along ``p`` x ``q``. Values and gradients
    stay finite for circles (any axes serve) and for degenerate triangles. The plane's own axes come from its
    normal without a branch (Duff et al. 2017, "Building an orthonormal basis, revisited"); within it the 2x2
    eigen-problem is solved in closed form, and the quaternion is the normal's times the turn in the plane.
    """
    # Component by component, each contiguous: several times faster than vectors of three.
    px, py, pz = p.movedim(-1, 0).contiguous()
    qx, qy, qz = q.movedim(-1, 0).contiguous()
    nx, ny, nz = py * qz - pz * qy, pz * qx - px * qz, px * qy - py * qx
    length = (nx * nx + ny * ny + nz * nz + 1e-24).sqrt()
    pp, qq = px * px + py * py + pz * pz, qx * qx + qy * qy + qz * qz
    flat = length < 1e-10 * (pp + qq) + 2e-12
    nx, ny, nz = nx / length, ny / length, nz / length
    if bool(flat.any()):  # slivers have no normal of their own: any direction across them will do
        across = _across(torch.where((pp > qq).unsqueeze(-1), p, q).detach())
        nx, ny, nz = (torch.where(flat, across[..., k], n) for k, n in enumerate((nx, ny, nz)))
    upper = nz >= 0
    sign = torch.where(upper, 1.0, -1.0).to(nz.dtype)
    a = -1 / (sign + nz)
    b = nx * ny * a
    first = (1 + sign * nx * nx * a, sign * b, -sign * nx)
    second = (b, sign + ny * ny * a, -ny)
    p1, p2 = (px * e[0] + py * e[1] + pz * e[2] for e in (first, second))
    q1, q2 = (qx * e[0] + qy * e[1] + qz * e[2] for e in (first, second))
    xx, xy, yy = p1 * p1 + q1 * q1, p1 * p2 + q1 * q2, p2 * p2 + q2 * q2
    half_difference = 0.5 * (xx - yy)
    # A circle has no axes: there any angle is right and the gradient of it is left out.
    circle = half_difference.abs() + xy.abs() < 1e-6 * (xx + yy) + 1e-30
    y = torch.where(circle, torch.zeros_like(xy), xy)
    x = torch.where(circle, torch.ones_like(xy), half_difference)
    # x and y may be far below one: their squares must not vanish.
    unit = (x.abs() + y.abs()).detach()
    spread = torch.where(
        circle, torch.zeros_like(xy), unit * ((x / unit).square() + (y / unit).square()).sqrt()
    )
    long_scale = (0.5 * (xx + yy) + spread + 1e-24).sqrt()
    scales = torch.stack([long_scale, length / long_scale], -1)
    # A quarter of atan2: half for the axes' angle, half again for the quaternion.
    turn = 0.25 * torch.atan2(y, x)
    c, s = turn.cos(), turn.sin()
    # The normal's quaternion: (1 + nz, -ny, nx, 0), or from below (-ny, 1 - nz, 0, nx).
    size = torch.rsqrt(2 * (1 + nz.abs()))
    w0 = torch.where(upper, 1 + nz, -ny) * size
    x0 = torch.where(upper, -ny, 1 - nz) * size
    y0 = torch.where(upper, nx, torch.zeros_like(nx)) * size
    z0 = torch.where(upper, torch.zeros_like(nx), nx) * size
    quats = torch.stack([w0 * c - z0 * s, x0 * c + y0 * s, y0 * c - x0 * s, z0 * c + w0 * s], -1)
    return scales, quats


def principal_tangents(scales: Tensor, quats: Tensor) -> Tensor:
    """Standard deviations [...,2] along the first two axes of quats [...,4] -> tangents [...,2,3].

    Quaternions are wxyz of any length. A scale that is not positive or a quaternion without length gives NaN,
    which the rasteriser drops and counts; no gradient passes there.
    """
    finite = torch.cat([scales, quats], -1).isfinite().all(-1)
    usable = finite & (scales > 0).all(-1) & (quats.square().sum(-1) > 1e-24)
    unit = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=quats.dtype)
    quats = torch.where(usable.unsqueeze(-1), quats, unit)
    scales = torch.where(usable.unsqueeze(-1), scales, torch.full_like(scales, torch.nan))
    rotation = quat_to_matrix(quats / quats.norm(dim=-1, keepdim=True))
    return rotation[..., :2].mT * scales.unsqueeze(-1)


def safe_norm(vectors: Tensor) -> Tensor:
    """Length [...] of vectors [...,3]; at zero it is tiny instead of having no gradient."""
    return ((vectors * vectors).sum(-1) + 1e-24).sqrt()


def _across(long: Tensor) -> Tensor:
    """Some unit vector perpendicular to ``long`` [...,3] (any at all where that is zero)."""
    axis = torch.nn.functional.one_hot(long.abs().argmin(-1), 3).to(long.dtype)
    across = torch.linalg.cross(long / safe_norm(long).unsqueeze(-1), axis)
    return torch.where(across.square().sum(-1, keepdim=True) > 0.25, normalize(across, dim=-1), axis)


def steiner_inellipse(triangles: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Triangles [...,3,3] -> centroid [...,3], semi-axes [...,2] (paper eq. 2), quats [...,4] (eq. 8).

    The third axis is the triangle's outward normal (corners counter-clockwise seen from outside).
    """
    centroid, p, q = conjugate_axes(triangles).unbind(-2)
    # P toward C and Q from A to B: (Q, P) turns counter-clockwise as A, B, C do.
    semi_axes, quats = principal_scales_quats(q, p)
    return centroid, semi_axes, quats


def quat_to_matrix(quats: Tensor) -> Tensor:
    """Unit quaternions [...,4] (wxyz) -> rotations [...,3,3]."""
    w, x, y, z = quats.unbind(-1)
    rows = [
        torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
        torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
        torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
    ]
    return torch.stack(rows, -2)
