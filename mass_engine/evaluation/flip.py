"""LDR-FLIP (Andersson et al. 2020, "FLIP: A difference evaluator for alternating images"): 0 same, 1 far.

Both pictures are filtered by the eye's contrast sensitivity and compared as colours (HyAB in Lab with Hunt's
adjustment); where edges or points differ, the difference is raised.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
import torch
from torch import Tensor

#: Monitor 0.7 m wide with 3840 pixels, seen from 0.7 m: the authors' default.
PIXELS_PER_DEGREE = 0.7 * 3840 / 0.7 * math.pi / 180

#: (weight, width) of the two Gaussians of each opponent channel's sensitivity.
_SENSITIVITY = (
    ((1.0, 0.0047), (0.0, 1e-5)),
    ((1.0, 0.0053), (0.0, 1e-5)),
    ((34.1, 0.04), (13.5, 0.025)),
)
_WIDEST = 0.04
_COLOR_POWER, _FEATURE_POWER = 0.7, 0.5
_KNEE, _KNEE_VALUE = 0.4, 0.95
_FEATURE_WIDTH = 0.082  # degrees

#: Linear sRGB to XYZ (IEC 61966-2-1), D65.
_TO_XYZ = (
    (10135552 / 24577794, 8788810 / 24577794, 4435075 / 24577794),
    (2613072 / 12288897, 8788810 / 12288897, 887015 / 12288897),
    (1425312 / 73733382, 8788810 / 73733382, 70074185 / 73733382),
)


def flip(image: Tensor, target: Tensor, pixels_per_degree: float = PIXELS_PER_DEGREE) -> float:
    """Mean FLIP of two sRGB pictures [H,W,3] in 0..1."""
    return float(flip_map(image, target, pixels_per_degree).mean())


def flip_map(image: Tensor, target: Tensor, pixels_per_degree: float = PIXELS_PER_DEGREE) -> Tensor:
    """FLIP [H,W] of each pixel."""
    pictures = [_opponent(_linear(p.double().clamp(0, 1))) for p in (image, target)]
    seen = [_hunt(_lab(_filtered(p, pixels_per_degree))) for p in pictures]
    color = _hyab(seen[0], seen[1]) ** _COLOR_POWER
    corners = torch.tensor([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    green, blue = _hunt(_lab(corners))
    most = float(_hyab(green, blue)) ** _COLOR_POWER
    knee = _KNEE * most
    beyond = _KNEE_VALUE + (color - knee) / (most - knee) * (1 - _KNEE_VALUE)
    color = torch.where(color < knee, _KNEE_VALUE / knee * color, beyond)
    grey = [(p[..., 0] + 16) / 116 for p in pictures]
    apart = []
    for order in (1, 2):
        one, two = (_feature(g, order, pixels_per_degree) for g in grey)
        apart.append((one - two).abs())
    feature = (torch.maximum(*apart) / math.sqrt(2)) ** _FEATURE_POWER
    result: Tensor = color ** (1 - feature)
    return result


def _linear(srgb: Tensor) -> Tensor:
    return torch.where(srgb > 0.04045, ((srgb + 0.055) / 1.055) ** 2.4, srgb / 12.92)


def _matrix(like: Tensor) -> Tensor:
    return torch.tensor(_TO_XYZ, dtype=like.dtype)


def _opponent(linear: Tensor) -> Tensor:
    """Linear RGB [...,3] -> YCxCz."""
    matrix = _matrix(linear)
    x, y, z = (linear @ matrix.T / matrix.sum(1)).unbind(-1)
    return torch.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], -1)


def _filtered(opponent: Tensor, ppd: float) -> Tensor:
    """The opponent picture as the eye resolves it, back in linear RGB, 0..1."""
    radius = math.ceil(3 * math.sqrt(_WIDEST / (2 * math.pi**2)) * ppd)
    at = torch.arange(-radius, radius + 1, dtype=torch.float64) / ppd
    planes = []
    for channel, gaussians in enumerate(_SENSITIVITY):
        total = torch.zeros_like(opponent[..., channel])
        weight = 0.0
        for height, width in gaussians:
            if height > 0:
                row = torch.exp(-(math.pi**2) * at.square() / width)
                part = height * math.sqrt(math.pi / width)
                total = total + part * _separable(opponent[..., channel], row, row)
                weight += part * float(row.sum()) ** 2
        planes.append(total / weight)
    y, x, z = planes
    y = (y + 16) / 116
    matrix = _matrix(opponent)
    xyz = torch.stack([y + x / 500, y, y - z / 200], -1) * matrix.sum(1)
    result: Tensor = (xyz @ torch.linalg.inv(matrix).T).clamp(0, 1)
    return result


def _separable(plane: Tensor, row: Tensor, column: Tensor) -> Tensor:
    """``plane`` [H,W] by ``row`` along x and ``column`` along y; the border is repeated."""
    kernels = row.numpy(), column.numpy()
    filtered = cv2.sepFilter2D(
        np.ascontiguousarray(plane.numpy()), cv2.CV_64F, *kernels, borderType=cv2.BORDER_REPLICATE
    )
    return torch.from_numpy(filtered)


def _lab(linear: Tensor) -> Tensor:
    matrix = _matrix(linear)
    ratio = linear @ matrix.T / matrix.sum(1)
    delta = 6 / 29
    f = torch.where(ratio > delta**3, ratio.clamp_min(1e-12) ** (1 / 3), ratio / (3 * delta**2) + 4 / 29)
    x, y, z = f.unbind(-1)
    return torch.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], -1)


def _hunt(lab: Tensor) -> Tensor:
    """Colours look paler in the dark."""
    light = lab[..., :1]
    return torch.cat([light, 0.01 * light * lab[..., 1:]], -1)


def _hyab(one: Tensor, two: Tensor) -> Tensor:
    apart = one - two
    distance: Tensor = apart[..., 0].abs() + apart[..., 1:].norm(dim=-1)
    return distance


def _feature(grey: Tensor, order: int, ppd: float) -> Tensor:
    """Strength [H,W] of edges (``order`` 1) or points (2): the Gaussian's derivatives along x and y."""
    sigma = 0.5 * _FEATURE_WIDTH * ppd
    radius = math.ceil(3 * sigma)
    at = torch.arange(-radius, radius + 1, dtype=torch.float64)
    bell = torch.exp(-0.5 * (at / sigma) ** 2)
    wave = -at * bell if order == 1 else ((at / sigma) ** 2 - 1) * bell
    # Positive weights sum to one, negative ones to minus one, over the whole window.
    wave = torch.where(wave < 0, wave / -wave.clamp(max=0).sum(), wave / wave.clamp_min(0).sum())
    bell = bell / bell.sum()
    return (_separable(grey, wave, bell).square() + _separable(grey, bell, wave).square()).sqrt()
