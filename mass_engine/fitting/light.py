"""The clip's light and a rough albedo by alternating least squares, on the vertices of the refined mesh."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

from mass_engine.surfel.shading import irradiance_basis, white_light


@dataclass(frozen=True)
class LightSample:
    """Vertices of one frame seen as hand: ``index`` [S] of the vertex, ``color`` [S,3], ``normal`` [S,3]."""

    index: Tensor
    color: Tensor
    normal: Tensor


def solve_light(samples: Sequence[LightSample], count: int, rounds: int = 8, ridge: float = 0.02) -> Tensor:
    """Light [9,3] under which ``count`` vertices keep one albedo over all frames.

    Albedo and light are known only up to a factor a channel: the constant term is one. ``ridge`` (a share of
    the evidence) holds the other terms at zero where the hand has not turned enough to tell.
    """
    light = white_light()
    if not samples:
        return light
    index = torch.cat([sample.index for sample in samples])
    color = torch.cat([sample.color for sample in samples])
    basis = irradiance_basis(torch.cat([sample.normal for sample in samples]))
    weight = torch.ones(len(index))
    for _ in range(rounds):
        shading = (basis @ light).clamp_min(0.05)
        top = torch.zeros(count, 3).index_add(0, index, weight[:, None] * shading * color)
        bottom = torch.zeros(count, 3).index_add(0, index, weight[:, None] * shading.square())
        albedo = (top / bottom.clamp_min(1e-6))[index]
        columns = []
        for channel in range(3):
            rows = basis * albedo[:, channel : channel + 1]
            matrix = (rows.T * weight) @ rows
            hold = ridge * float(matrix[0, 0]) * torch.eye(9)
            columns.append(torch.linalg.solve(matrix + hold, (rows.T * weight) @ color[:, channel] + hold[0] * 1.0))
        light = torch.stack(columns, -1)
        light = light / light[:1].clamp_min(1e-3)
        error = (albedo * (basis @ light) - color).abs().mean(-1)
        weight = 1 / (1 + (error / 0.08).square())  # shadows and other skin are not this light's
    return light


def sample_colors(rgb: Tensor, usable: Tensor, pixels: Tensor, normals: Tensor, seen: Tensor) -> LightSample:
    """Colours of the ``seen`` [V] vertices at ``pixels`` [V,2] of a picture [h,w,3], where ``usable`` [h,w]."""
    at = (pixels - 0.5).numpy().astype(np.float32)
    inside = cv2.remap(usable.numpy(), at[:, None, 0], at[:, None, 1], cv2.INTER_LINEAR)[:, 0] > 0.99
    colors = cv2.remap(rgb.numpy(), at[:, None, 0], at[:, None, 1], cv2.INTER_LINEAR)[:, 0]
    index = torch.nonzero(seen & torch.from_numpy(inside))[:, 0]
    return LightSample(index, torch.from_numpy(colors)[index], normals[index])
