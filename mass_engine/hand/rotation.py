"""Rotations between axis-angle and matrix form, finite in value and gradient at zero."""

from __future__ import annotations

import torch
from torch import Tensor

#: Below this squared angle the Taylor series is exact to float32 and the square root is avoided.
_SMALL = 1e-6


def axis_angle_to_matrix(axis_angle: Tensor) -> Tensor:
    """Axis-angle [...,3] in radians to rotation matrices [...,3,3] (Rodrigues' formula).

    R = I + a [w] + b [w]^2 with a = sin t / t and b = (1 - cos t) / t^2. The half-angle form of b keeps
    its digits in float32, and the series below ``_SMALL`` keeps the gradient finite at zero.
    """
    squared = (axis_angle * axis_angle).sum(-1)
    small = squared < _SMALL
    angle = torch.where(small, torch.ones_like(squared), squared).sqrt()
    half = torch.sin(0.5 * angle) / angle
    a = torch.where(small, 1 - squared / 6, torch.sin(angle) / angle)
    b = torch.where(small, 0.5 - squared / 24, 2 * half * half)
    x, y, z = axis_angle.unbind(-1)
    ax, ay, az = a * x, a * y, a * z
    bx, by = b * x, b * y
    xy, xz, yz = bx * y, bx * z, by * z
    xx, yy, zz = bx * x, by * y, b * z * z
    rows = (1 - yy - zz, xy - az, xz + ay, xy + az, 1 - xx - zz, yz - ax, xz - ay, yz + ax, 1 - xx - yy)
    return torch.stack(rows, -1).reshape(*axis_angle.shape[:-1], 3, 3)


def axis_angle_from_matrix(rotation: Tensor) -> Tensor:
    """Rotation matrices [...,3,3] to axis-angle [...,3] with angle in [0, pi].

    For reading tracks, not for optimisation: no useful gradient at the identity or at half a turn.
    Goes through the largest quaternion component, so every angle is well conditioned.
    """
    m = rotation
    trace = m[..., 0, 0] + m[..., 1, 1] + m[..., 2, 2]
    diagonal = torch.stack((m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]), -1)
    # Rows of 4 q qT, one per choice of the component to divide by.
    w = torch.stack(
        (1 + trace, m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]), -1
    )
    xy, xz, yz = m[..., 0, 1] + m[..., 1, 0], m[..., 0, 2] + m[..., 2, 0], m[..., 1, 2] + m[..., 2, 1]
    d = 1 + 2 * diagonal - trace[..., None]
    rows = torch.stack(
        (
            w,
            torch.stack((w[..., 1], d[..., 0], xy, xz), -1),
            torch.stack((w[..., 2], xy, d[..., 1], yz), -1),
            torch.stack((w[..., 3], xz, yz, d[..., 2]), -1),
        ),
        -2,
    )
    best = torch.cat((trace[..., None], diagonal), -1).argmax(-1)
    row = torch.take_along_dim(rows, best[..., None, None].expand(*best.shape, 1, 4), -2).squeeze(-2)
    quaternion = torch.nn.functional.normalize(row, dim=-1)
    quaternion = torch.where(quaternion[..., :1] < 0, -quaternion, quaternion)
    vector = quaternion[..., 1:]
    sine = vector.norm(dim=-1, keepdim=True)
    angle = 2 * torch.atan2(sine, quaternion[..., :1])
    return torch.where(sine > 1e-9, vector * angle / sine.clamp_min(1e-30), 2 * vector)
