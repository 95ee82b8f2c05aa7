"""Shading: albedo times second-order spherical-harmonic irradiance of the posed normal.

A hand turns under a fixed light, so a colour fixed to the skin is wrong from frame to frame. Nine numbers
a colour channel describe the irradiance of any distant light on a matt surface to about one percent
(Ramamoorthi and Hanrahan 2001).
"""

from __future__ import annotations

import torch
from torch import Tensor


def irradiance_basis(normals: Tensor) -> Tensor:
    """The nine unnormalised second-order harmonics of unit normals [...,3] -> [...,9]; the first is 1."""
    x, y, z = normals.unbind(-1)
    return torch.stack([torch.ones_like(x), y, z, x, x * y, y * z, 3 * z * z - 1, x * z, x * x - y * y], -1)


def white_light() -> Tensor:
    """Light [9,3] under which shaded colour equals albedo."""
    light = torch.zeros(9, 3)
    light[0] = 1.0
    return light


def shade(albedo: Tensor, light: Tensor, normals: Tensor) -> Tensor:
    """Colour [...,N,3] of surfels with ``albedo`` [N,3], normals [...,N,3] under ``light`` [9,3]."""
    return albedo * (irradiance_basis(normals) @ light).clamp_min(0.0)
