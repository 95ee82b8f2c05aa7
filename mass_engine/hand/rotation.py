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


def matrix_to_axis_angle(matrix: Tensor) -> Tensor:
    """Rotation matrices [...,3,3] to axis-angle [...,3], angles in [0, pi]; not meant to be differentiated.

    The quaternion's largest component is taken from the diagonal first, which is exact near pi as well.
    """
    m = matrix.double()
    d = m.diagonal(dim1=-2, dim2=-1)
    trace = d.sum(-1)
    squares = torch.stack(
        [1 + trace, 1 + 2 * d[..., 0] - trace, 1 + 2 * d[..., 1] - trace, 1 + 2 * d[..., 2] - trace], -1
    )
    a, b, c = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    xy, xz, yz = m[..., 0, 1] + m[..., 1, 0], m[..., 0, 2] + m[..., 2, 0], m[..., 1, 2] + m[..., 2, 1]
    rows = torch.stack(
        [
            torch.stack([squares[..., 0], a, b, c], -1),
            torch.stack([a, squares[..., 1], xy, xz], -1),
            torch.stack([b, xy, squares[..., 2], yz], -1),
            torch.stack([c, xz, yz, squares[..., 3]], -1),
        ],
        -2,
    )
    best = squares.argmax(-1)[..., None, None].expand(*squares.shape[:-1], 1, 4)
    quaternion = torch.nn.functional.normalize(rows.gather(-2, best).squeeze(-2), dim=-1)
    quaternion = torch.where(quaternion[..., :1] < 0, -quaternion, quaternion)
    sine = quaternion[..., 1:].norm(dim=-1)
    angle = 2 * torch.atan2(sine, quaternion[..., 0])
    scale = torch.where(sine > 1e-9, angle / sine.clamp_min(1e-9), torch.full_like(sine, 2.0))
    return (quaternion[..., 1:] * scale.unsqueeze(-1)).to(matrix)
