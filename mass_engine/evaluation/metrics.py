"""Image metrics with their conventions in their names. Images are float [H,W,3] in 0..1."""

from __future__ import annotations

import math

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

#: The published weights of the five scales of MS-SSIM (Wang, Simoncelli and Bovik 2003).
MS_SSIM_WEIGHTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)
_C1, _C2 = 0.01**2, 0.03**2


def to_8bit(image: Tensor) -> Tensor:
    """Rounded to the 256 levels of a saved picture, still float in 0..1."""
    return (image.clamp(0, 1) * 255).round() / 255


def psnr(image: Tensor, target: Tensor, mask: Tensor | None = None) -> float:
    """Peak signal-to-noise ratio in dB over all pixels, or over those of ``mask`` bool [H,W]."""
    squared = (image - target).square().mean(-1)
    error = float(squared.mean() if mask is None else squared[mask].mean())
    return math.inf if error == 0 else -10 * math.log10(error)


def _blur(picture: NDArray[np.floating]) -> NDArray[np.floating]:
    """11x11 Gaussian, sigma 1.5, over zeros around the picture [H,W,C]."""
    offset = np.arange(11) - 5
    row = np.exp(-0.5 * (offset / 1.5) ** 2)
    row /= row.sum()
    planes = [
        cv2.sepFilter2D(np.ascontiguousarray(picture[..., c]), -1, row, row, borderType=cv2.BORDER_CONSTANT)
        for c in range(picture.shape[-1])
    ]
    return np.stack(planes, -1)


def ssim_maps(image: Tensor, target: Tensor, padding: int = 0) -> tuple[Tensor, Tensor]:
    """SSIM and its contrast-structure part, each [H-10,W-10,3] (without ``padding``): 11x11 Gaussian window,
    sigma 1.5."""
    x, y = image.numpy(), target.numpy()
    moments = (_blur(part) for part in (x, y, x * x, y * y, x * y))
    edge = 5 - padding
    inner = slice(edge, x.shape[0] - edge), slice(edge, x.shape[1] - edge)
    mx, my, xx, yy, xy = (torch.from_numpy(np.ascontiguousarray(part[inner])) for part in moments)
    structure = (2 * (xy - mx * my) + _C2) / (xx - mx * mx + yy - my * my + _C2)
    return structure * (2 * mx * my + _C1) / (mx * mx + my * my + _C1), structure


def ssim_valid(image: Tensor, target: Tensor) -> float:
    """Mean SSIM without padding (Wang et al. 2004; the convention of HandAvatar)."""
    return float(ssim_maps(image, target)[0].mean())


def ssim_zero_padded(image: Tensor, target: Tensor) -> float:
    """Mean SSIM with zeros around the picture (the convention of 3D Gaussian splatting)."""
    return float(ssim_maps(image, target, 5)[0].mean())


def ms_ssim(image: Tensor, target: Tensor) -> float:
    """Multi-scale SSIM, five scales, valid windows. NaN when a side is under 176 pixels."""
    if min(image.shape[:2]) < 176:
        return math.nan
    result = torch.ones(3, dtype=image.dtype)
    for scale, weight in enumerate(MS_SSIM_WEIGHTS):
        full, structure = ssim_maps(image, target)
        last = scale == len(MS_SSIM_WEIGHTS) - 1
        result = result * (full if last else structure).mean((0, 1)).clamp_min(0) ** weight
        if not last:
            image, target = (_halve(picture) for picture in (image, target))
    return float(result.mean())


def _halve(image: Tensor) -> Tensor:
    return functional.avg_pool2d(image.permute(2, 0, 1), 2).permute(1, 2, 0)
