"""Axis-angle to rotation matrix, finite in value and gradient at zero."""

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
