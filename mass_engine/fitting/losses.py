"""Losses of the fit, one function each. Pictures are [h,w,3] in 0..1, masks [h,w] in 0..1."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from mass_engine import gpu

_C1, _C2 = 0.01**2, 0.03**2


def charbonnier(difference: Tensor, scale: float) -> Tensor:
    """Smooth absolute value: quadratic below ``scale``, linear above it; same shape as the input."""
    return ((difference / scale) ** 2 + 1).sqrt().sub(1).mul(scale)


def photometric(rgb: Tensor, target: Tensor, valid: Tensor, area: Tensor) -> Tensor:
    """Robust L1 over the valid pixels, per pixel of hand ``area`` (scalar): paper's L_c, first part."""
    return (charbonnier(rgb - target, 0.01).mean(-1) * valid).sum() / area


def silhouette(alpha: Tensor, hand: Tensor, valid: Tensor, area: Tensor, holes: float = 1.0) -> Tensor:
    """|alpha - hand| over the valid pixels, per pixel of hand area: paper's L_sil with ignore regions.

    A hole in the hand counts ``holes`` more than what sticks out.
    """
    return (charbonnier(alpha - hand, 0.05) * valid * (1 + holes * hand)).sum() / area


def outline_distance(vertices: Tensor, points: Tensor, outside: Tensor) -> Tensor:
    """How far a projected mesh is from an outline, in pixels (scalar), from any distance.

    ``vertices`` [V,2] pixels; ``points`` [C,2] on the outline, each drawn to its nearest vertex; ``outside``
    [1,1,h,w] distance map: vertices out there are drawn back in. What surfels cannot do, whose pull ends a
    few pixels from them.
    """
    height, width = outside.shape[-2:]
    total = vertices.sum() * 0.0
    if len(points) > 0:
        with torch.no_grad():
            nearest = torch.cdist(points, vertices).argmin(1)
        total = (
            total + charbonnier((vertices[nearest] - points).square().sum(-1).add(1e-6).sqrt(), 2.0).mean()
        )
    grid = vertices / torch.tensor([width / 2, height / 2]) - 1
    depth = functional.grid_sample(outside, grid[None, None], padding_mode="border", align_corners=False)
    return total + charbonnier(depth, 2.0).mean() * 2


def dssim(rgb: Tensor, target: Tensor, valid: Tensor) -> Tensor:
    """(1 - SSIM) / 2 of the pictures' grey values, 7x7 box window, averaged over the valid pixels.

    Grey and a box are what a CPU does fast, and structure is in the grey values; the reported metric uses
    three channels and the Gaussian window (evaluation.metrics).
    """
    kernels = gpu.kernels_for(rgb)
    if kernels is not None and not target.requires_grad:
        return gpu.dssim(kernels, rgb, target, valid)
    x, y = rgb.mean(-1), target.mean(-1)
    planes = torch.stack([x, y, x * x, y * y, x * y]).unsqueeze(0)
    row = torch.full((5, 1, 1, 7), 1 / 7, dtype=planes.dtype, device=planes.device)
    planes = functional.conv2d(planes, row, padding=(0, 3), groups=5)
    planes = functional.conv2d(planes, row.transpose(2, 3), padding=(3, 0), groups=5)
    mx, my, xx, yy, xy = planes[0]
    ssim = ((2 * mx * my + _C1) * (2 * (xy - mx * my) + _C2)) / (
        (mx * mx + my * my + _C1) * ((xx - mx * mx).clamp_min(0) + (yy - my * my).clamp_min(0) + _C2)
    )
    loss: Tensor = ((1 - ssim) * 0.5 * valid).sum() / valid.sum().clamp_min(1.0)
    return loss


def laplacian(values: Tensor, edges: Tensor) -> Tensor:
    """Mean squared difference of ``values`` [V] across the mesh's ``edges`` [E,2]."""
    return (values[edges[:, 0]] - values[edges[:, 1]]).square().mean()
