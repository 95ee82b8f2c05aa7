"""The specification of the rasteriser in plain torch: every surfel at every pixel, any dtype, autograd.

Slow on purpose: it has no tiles, no bounds and no early exit, so that it can be read and trusted. The
compiled kernels are held against it in value and in gradient.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from mass_engine.camera import Camera
from mass_engine.raster.types import (
    ALPHA_CUT,
    ALPHA_MAX,
    EDGE_ON_COSINE,
    GSPLAT_REACH,
    INRIA_REACH,
    LEAST_AREA2,
    LEAST_SINE2,
    LOW_PASS,
    MEDIAN_TRANSMITTANCE,
    TRANSMITTANCE_STOP,
    Extras,
    RasterOptions,
    RenderOutput,
)
from mass_engine.surfel.harmonics import evaluate_sh

_ELEMENTS_PER_CHUNK = 1 << 21
_TILE = 16  # pixels; only the conventions of other renderers see it


@dataclass(frozen=True)
class ProjectedSurfels:
    """The surfels that can be seen, nearest first (M of them).

    With d the pixel minus ``center`` [M,2] and pz = 1 + g.d, the ray through a pixel meets the disk's plane
    at disk coordinates (u, v) = ab d / pz (in standard deviations) and at depth z / pz. This is the
    splat-to-pixel matrix of 2DGS (eq. 7-9) inverted and taken relative to the projected centre.
    """

    index: Tensor  # [M] row in the input
    center: Tensor  # [M,2] pixels
    ab: Tensor  # [M,2,2]
    g: Tensor  # [M,2]
    z: Tensor  # [M]
    solid: Tensor  # [M] bool; False is edge-on: only the low-pass part is drawn
    normal: Tensor  # [M,3] camera space, towards the camera
    opacity: Tensor  # [M]
    color: Tensor  # [M,3]
    box: Tensor | None  # [M,4] first and last column, first and last row it may touch; None: all


def _evaluated(colors: Tensor, means: Tensor, camera: Camera) -> Tensor:
    """Plain colours [N,3] of what ``rasterize`` takes, not yet clamped."""
    if colors.ndim == 2:
        return colors
    center = -camera.world_to_camera[:3, :3].T @ camera.world_to_camera[:3, 3]
    away = means - center
    directions = away / away.square().sum(-1, keepdim=True).clamp_min(1e-30).sqrt()
    return evaluate_sh(colors, directions)


def _box(t: Tensor, c: Tensor, camera: Camera, inria: bool) -> Tensor:
    """Whole tiles [M,4] as other renderers list a surfel with camera tangents ``t`` [M,2,3], centre ``c``."""
    K = torch.eye(3, dtype=t.dtype)
    K[:2] = camera.K[:2]
    T = torch.cat([t, c[:, None]], 1) @ K.T  # rows: tangents and centre; columns: Tu, Tv, Tw of 2DGS
    reach = INRIA_REACH if inria else 1.0
    weight = torch.tensor([reach**2, reach**2, -1.0], dtype=t.dtype)
    f = weight / (weight * T[:, :, 2].square()).sum(-1, keepdim=True)
    middle = (f[:, :, None] * T[:, :, :2] * T[:, :, 2:]).sum(1)
    half = (middle.square() - (f[:, :, None] * T[:, :, :2].square()).sum(1)).clamp_min(1e-4).sqrt()
    if inria:
        half = half.amax(-1, keepdim=True).clamp_min(INRIA_REACH * math.sqrt(0.5)).ceil()
        middle = middle - 0.5
        end = ((middle + half + (_TILE - 1)) / _TILE).floor()
    else:
        half = (GSPLAT_REACH * half).ceil()
        end = ((middle + half) / _TILE).ceil()
    first = ((middle - half) / _TILE).floor().clamp_min(0) * _TILE
    last = end * _TILE - 1
    return torch.stack([first[:, 0], last[:, 0], first[:, 1], last[:, 1]], -1)


def project(
    means: Tensor, tangents: Tensor, opacities: Tensor, colors: Tensor, camera: Camera, options: RasterOptions
) -> tuple[ProjectedSurfels, int]:
    """Camera-space geometry of every surfel that can be seen, and how many were dropped for bad numbers."""
    A, shift = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
    harmonics = colors.ndim == 3
    colors = _evaluated(colors, means, camera)
    everything = torch.cat([means, tangents.flatten(1), opacities[:, None], colors], -1)
    area2 = torch.linalg.cross(tangents[:, 0], tangents[:, 1]).square().sum(-1)
    least = (LEAST_SINE2 * tangents.square().sum(-1).prod(-1)).clamp_min(LEAST_AREA2)
    usable = everything.isfinite().all(-1) & (area2 > least)
    colors = colors.clamp_min(0.0) if harmonics else colors
    z = means.detach() @ A[2].detach() + shift[2].detach()
    index = torch.nonzero(usable & (z > options.near_plane) & (opacities >= ALPHA_CUT))[:, 0]
    index = index[torch.argsort(z[index], stable=True)]

    c = means[index] @ A.T + shift
    t = tangents[index] @ A.T
    normal = torch.linalg.cross(t[:, 0], t[:, 1])
    normal = normal / normal.norm(dim=-1, keepdim=True)
    facing = (normal * c).sum(-1)
    if options.cull_backfaces:
        front = facing <= 0
        index, c, t, normal, facing = index[front], c[front], t[front], normal[front], facing[front]

    z = c[:, 2]
    ray = c[:, :2] / z[:, None]
    center = ray @ camera.K[:2, :2].T + camera.K[:2, 2]
    # Derivative of the pixel by movement along the tangents, times z.
    J = camera.K[:2, :2] @ (t[:, :, :2] - t[:, :, 2:] * ray[:, None]).mT
    det = torch.linalg.det(J)
    solid = (facing.square() > EDGE_ON_COSINE**2 * c.square().sum(-1)) & (det != 0)
    # Edge-on surfels get any invertible matrix: nothing they compute from it is used.
    J = torch.where(solid[:, None, None], J, torch.eye(2, dtype=J.dtype))
    G = torch.linalg.inv(J)
    ab = z[:, None, None] * G
    g = -(t[:, None, :, 2] @ G)[:, 0]
    normal = torch.where((facing > 0)[:, None], -normal, normal)
    box = None
    if options.convention != "exact":
        box = _box(t.detach(), c.detach(), camera, options.convention == "inria")
    projected = ProjectedSurfels(index, center, ab, g, z, solid, normal, opacities[index], colors[index], box)
    return projected, int((~usable).sum())


@dataclass(frozen=True)
class _Pixels:
    rgb: Tensor
    alpha: Tensor
    depth: Tensor
    median_depth: Tensor
    normal: Tensor
    distortion: Tensor
    weights: Tensor  # [M] summed over these pixels


def _blend(s: ProjectedSurfels, pixels: Tensor, options: RasterOptions) -> _Pixels:
    """Front-to-back blending at pixel positions [P,2]; intermediate tensors are [P,M]."""
    d = pixels[:, None] - s.center
    pz = 1 + (s.g * d).sum(-1)
    # Beyond the near plane and before the horizon of the disk's plane.
    met = s.solid & (pz > 0) & (s.z >= options.near_plane * pz)
    safe_pz = torch.where(met, pz, torch.ones_like(pz))
    uv = (s.ab @ d[..., None])[..., 0] / safe_pz[..., None]
    rho3 = uv.square().sum(-1)
    rho2 = LOW_PASS * d.square().sum(-1)
    solid = met & (rho3 <= rho2)
    rho = torch.where(solid, rho3, rho2)
    inclined = solid & (not options.center_depth)
    z = torch.where(inclined, s.z / safe_pz, s.z.expand_as(pz))

    alpha = (s.opacity * torch.exp(-0.5 * rho)).clamp(max=ALPHA_MAX)
    drawn = alpha >= ALPHA_CUT
    if s.box is not None:
        x, y = pixels[:, None].floor().unbind(-1)
        drawn = drawn & (s.box[:, 0] <= x) & (x <= s.box[:, 1]) & (s.box[:, 2] <= y) & (y <= s.box[:, 3])
    alpha = torch.where(drawn, alpha, torch.zeros_like(alpha))
    after = torch.cumprod(1 - alpha, dim=-1)
    before = torch.cat([torch.ones_like(after[:, :1]), after[:, :-1]], -1)
    blended = (alpha > 0) & (after >= TRANSMITTANCE_STOP)
    w = torch.where(blended, before * alpha, torch.zeros_like(alpha))

    total = w.sum(-1)
    weighted_z = (w * z).sum(-1)
    depth = torch.where(total > 0, weighted_z / torch.where(total > 0, total, torch.ones_like(total)), total)

    count = w.shape[1]
    rank = torch.where(blended & (before > MEDIAN_TRANSMITTANCE), torch.arange(1, count + 1), 0)
    last = rank.amax(-1) if count else torch.zeros(len(w), dtype=torch.long)
    padded = torch.cat([torch.zeros_like(z[:, :1]) if count else z.new_zeros(len(w), 1), z], -1)
    median = padded.gather(-1, last[:, None])[:, 0]

    # sum over j < i of w_i w_j (m_i - m_j)^2 by running moments; the first surfel's m is subtracted from all.
    m = -options.distortion_scale / z
    if count:
        first = blended.to(torch.uint8).argmax(-1, keepdim=True)
        m = m - m.gather(-1, first).detach()
    m0, m1, m2 = w, w * m, w * m * m
    c0, c1, c2 = (x.cumsum(-1) - x for x in (m0, m1, m2))
    distortion = (w * (m * m * c0 - 2 * m * c1 + c2)).sum(-1)
    return _Pixels(w @ s.color, total, depth, median, w @ s.normal, distortion, w.detach().sum(0))


def rasterize(
    means: Tensor, tangents: Tensor, opacities: Tensor, colors: Tensor, camera: Camera, options: RasterOptions
) -> RenderOutput:
    """As ``mass_engine.raster.rasterize``, in the dtype of ``means`` and without background."""
    dtype, H, W = means.dtype, camera.height, camera.width
    camera = Camera(camera.K.to(dtype), camera.world_to_camera.to(dtype), W, H)
    surfels, dropped = project(
        means, tangents.to(dtype), opacities.to(dtype), colors.to(dtype), camera, options
    )
    y, x = torch.meshgrid(torch.arange(H, dtype=dtype), torch.arange(W, dtype=dtype), indexing="ij")
    pixels = torch.stack([x, y], -1).reshape(-1, 2) + 0.5
    size = max(1, _ELEMENTS_PER_CHUNK // max(1, len(surfels.z)))
    parts = [_blend(surfels, chunk, options) for chunk in torch.split(pixels, size)]

    def image(name: str, *channels: int) -> Tensor:
        return torch.cat([getattr(p, name) for p in parts]).reshape(H, W, *channels)

    extras = None
    if options.outputs == "all":
        weight_sum = means.new_zeros(len(means)).detach()
        weight_sum[surfels.index] = torch.stack([p.weights for p in parts]).sum(0)
        extras = Extras(image("median_depth"), image("normal", 3), image("distortion"), weight_sum)
    return RenderOutput(image("rgb", 3), image("alpha"), image("depth"), dropped, extras)
