"""Channels: everything the rasteriser puts out, as numbers to compute with and as a picture to look at.

| channel | numbers, float32 | picture |
|---|---|---|
| rgb | [H,W,3] colour over black (premultiplied) | straight-alpha colour |
| alpha | [H,W] in 0..1 | grey, opaque |
| depth | [H,W] metres along the camera's z, 0 where nothing is | near bright, far dark (viridis) |
| normal | [H,W,3] sum(w n), camera axes: x right, y down, z forward | x right, y up, z to the viewer |
| distortion | [H,W] sum over pairs of w_i w_j (m_i - m_j)^2 | black none, bright much (inferno) |
| surfels | [M,3] centres of visible surfels: column, row (pixels), depth (metres) | white disks |

The numbers are the rasteriser's own (``raster.RenderOutput``). In the distortion m is 0 at the nearest surfel
of the hand and 1 at the farthest, linear in 1/z. Pictures show the hand on a transparent ground, except for
alpha; the scales of depth and distortion are the picture's own, so their colours compare within one picture.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, cast, get_args

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mass_engine.camera import Camera
from mass_engine.errors import BadArgumentError
from mass_engine.raster import RasterOptions, RenderOutput

Channel = Literal["rgb", "alpha", "depth", "normal", "distortion", "surfels"]
CHANNELS: tuple[Channel, ...] = get_args(Channel)

#: Pixels with at least this alpha are the hand when a scale is chosen: fainter ones hold stray values.
_COVERED = 0.5
#: A centre farther than this behind the surface drawn at its pixel is hidden. Less than a finger is thick,
#: more than the depth across a pixel and the spread of the surfels that are blended there.
_HIDDEN_BEHIND = 0.004
#: Radius of a disk by the mean distance between neighbouring centres, and at most by the picture's side.
_DISK_OF_SPACING = 0.3
_DISK_OF_SIDE = 1 / 128
_DISK_GROUND = (44, 52, 66)


def parse_channel(name: str) -> Channel:
    """The channel called ``name``. Raises BadArgumentError ``channel.invalid``."""
    for channel in CHANNELS:
        if name == channel:
            return channel
    raise BadArgumentError(
        "channel.invalid", f"There is no channel {name[:40]!r}.", f"Use one of {', '.join(CHANNELS)}."
    )


@dataclass(frozen=True)
class ChannelImage:
    """One channel of one render: its ``values`` (see the module) and the render's ``alpha`` [H,W]."""

    channel: Channel
    values: Tensor
    alpha: Tensor

    def numbers(self) -> NDArray[np.float32]:
        """The channel's numbers."""
        return cast("NDArray[np.float32]", self.values.numpy().astype(np.float32, copy=False))

    def picture(self) -> NDArray[np.uint8]:
        """The channel to look at: straight-alpha RGBA uint8 [H,W,4]."""
        alpha = self.alpha.clamp(0, 1)
        match self.channel:
            case "rgb":
                color = self.values
            case "alpha":
                color, alpha = alpha.unsqueeze(-1).expand(-1, -1, 3), torch.ones_like(alpha)
            case "depth":
                color = _depth_colors(self.values, alpha)
            case "normal":
                # From the camera's axes (x right, y down, z forward) to the ones normal maps are drawn in.
                normal = torch.nn.functional.normalize(self.values, dim=-1) * torch.tensor([1.0, -1.0, -1.0])
                color = normal * 0.5 + 0.5
            case "distortion":
                color = _distortion_colors(self.values, alpha)
            case "surfels":
                color, alpha = _surfel_map(self.values, alpha)
        # Most of a picture is empty: only the rest of it is worked on.
        seen = (alpha > 1e-4).flatten().nonzero().squeeze(1)
        cover = alpha.reshape(-1, 1)[seen]
        shown = color.reshape(-1, 3)[seen]
        if self.channel == "rgb":
            shown = shown / cover
        picture = torch.zeros(alpha.numel(), 4, dtype=torch.uint8)
        picture[seen] = (torch.cat([shown.clamp(0, 1), cover], -1) * 255).round().to(torch.uint8)
        return cast("NDArray[np.uint8]", picture.view(*alpha.shape, 4).numpy())


def raster_options(channel: Channel, means: Tensor, camera: Camera) -> RasterOptions:
    """How to rasterise surfels with ``means`` [N,3] so that ``channel`` can be taken from the result."""
    plain = RasterOptions(cull_backfaces=True)
    if channel in ("rgb", "alpha", "depth"):
        return plain
    z = means @ camera.world_to_camera[2, :3] + camera.world_to_camera[2, 3]
    z = z[z > plain.near_plane]
    if len(z) == 0:
        return RasterOptions(cull_backfaces=True, outputs="all")
    near = float(z.min())
    around = (near, max(float(z.max()), near * 1.001))
    return RasterOptions(cull_backfaces=True, outputs="all", distortion_range=around)


def extract(channel: Channel, out: RenderOutput, means: Tensor, camera: Camera) -> ChannelImage:
    """``channel`` of ``out``, the render of surfels with ``means`` [N,3] by ``camera`` over black.

    Rasterise with :func:`raster_options`.
    """
    match channel:
        case "rgb":
            values = out.rgb
        case "alpha":
            values = out.alpha
        case "depth":
            values = out.depth
        case "normal":
            values = out.normal
        case "distortion":
            values = out.distortion
        case "surfels":
            values = _visible_centers(out, means, camera)
    return ChannelImage(channel, values.detach(), out.alpha.detach())


def _visible_centers(out: RenderOutput, means: Tensor, camera: Camera) -> Tensor:
    """Column, row and depth [M,3] of the centres that can be seen.

    A weight says that a surfel shows *somewhere* (so it faces the camera); whether its centre does is for the
    depth test to say.
    """
    means = means[out.weight_sum > 0]
    z = means @ camera.world_to_camera[2, :3] + camera.world_to_camera[2, 3]
    centers = torch.cat([camera.project(means), z[:, None]], -1)
    size = torch.tensor([camera.width, camera.height], device=means.device)
    centers = centers[((centers[:, :2] >= 0) & (centers[:, :2] < size)).all(-1)]
    column, row = centers[:, :2].long().unbind(-1)
    surface = out.depth[row, column]
    return centers[(surface > 0) & (centers[:, 2] <= surface + _HIDDEN_BEHIND)]


def _color_map(values: Tensor, code: int) -> Tensor:
    """Colours [H,W,3] in 0..1 of ``values`` [H,W] in 0..1."""
    levels = (values.clamp(0, 1) * 255).round().to(torch.uint8).numpy()
    return torch.from_numpy(cv2.applyColorMap(levels, code)[..., ::-1].copy()).float() / 255


def _depth_colors(depth: Tensor, alpha: Tensor) -> Tensor:
    """Linear from the hand's farthest (0) to its nearest (1) depth.

    Viridis: its lightness rises evenly, so nearer always looks brighter (turbo is brightest in the middle),
    it shows finer steps than grey, and its dark end still stands out from black and white grounds.
    """
    covered = depth[alpha >= _COVERED]
    if len(covered) == 0:
        return torch.zeros(*depth.shape, 3)
    near, far = covered.min(), covered.max()
    return _color_map((far - depth) / (far - near).clamp_min(1e-9), cv2.COLORMAP_VIRIDIS)


def _distortion_colors(distortion: Tensor, alpha: Tensor) -> Tensor:
    """Linear from none (0) to the 99th percentile over the hand (1); few pixels are far above it."""
    covered = distortion[alpha >= _COVERED]
    if len(covered) == 0:
        return torch.zeros(*distortion.shape, 3)
    # By sorting: torch.quantile takes no more than 2^24 values.
    top = covered.kthvalue(math.ceil(0.99 * len(covered))).values
    return _color_map(distortion / top.clamp_min(1e-20), cv2.COLORMAP_INFERNO)


def _surfel_map(centers: Tensor, alpha: Tensor) -> tuple[Tensor, Tensor]:
    """White disks on the hand's silhouette: colour [H,W,3] and alpha [H,W].

    The disks shrink with the distance between the centres, so that they stay apart in any picture.
    """
    radius = min(alpha.shape) * _DISK_OF_SIDE
    if len(centers):
        spacing = math.sqrt(float(alpha.sum()) / len(centers))
        radius = min(radius, spacing * _DISK_OF_SPACING)
    white = _disks(centers[:, :2], radius, *alpha.shape)
    total = torch.maximum(alpha, white)
    ground = torch.tensor(_DISK_GROUND) / 255
    share = (white / total.clamp_min(1e-4)).unsqueeze(-1)
    return ground * (1 - share) + share, total


def _disks(centers: Tensor, radius: float, height: int, width: int) -> Tensor:
    """How much of each pixel [H,W] the union of disks around ``centers`` [M,2] covers, in 0..1."""
    cover = torch.zeros(height * width)
    reach = math.ceil(radius + 0.5)
    # A disk smaller than a pixel cannot cover it whole.
    full = min(1.0, math.pi * radius * radius)
    corner = centers.floor()
    for dy in range(-reach, reach + 1):
        for dx in range(-reach, reach + 1):
            pixel = corner + torch.tensor([dx, dy])
            apart = (pixel + 0.5 - centers).norm(dim=-1)
            share = (radius + 0.5 - apart).clamp(0, full)
            column, row = pixel.long().unbind(-1)
            inside = (column >= 0) & (column < width) & (row >= 0) & (row < height) & (share > 0)
            cover.scatter_reduce_(0, (row * width + column)[inside], share[inside], "amax")
    return cover.view(height, width)
