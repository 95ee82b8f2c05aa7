"""The specification of the rasteriser in plain torch: every surfel at every pixel, any dtype, autograd.

Slow on purpose: it has no tiles, no bounds and no early exit, so that it can be read and trusted. The
compiled kernels are held against it in value and in gradient.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from mass_engine.camera import Camera
from mass_engine.raster.types import (
    ALPHA_CUT,
    ALPHA_MAX,
    EDGE_ON_COSINE,
    LOW_PASS,
    MEDIAN_TRANSMITTANCE,
    TRANSMITTANCE_STOP,
    Extras,
    RasterOptions,
    RenderOutput,
)

_ELEMENTS_PER_CHUNK = 1 << 21


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


def rotation_matrices(quats: Tensor) -> Tensor:
    """Quaternions [N,4] (w, x, y, z), any length -> rotations [N,3,3]."""
    w, x, y, z = (quats / quats.norm(dim=-1, keepdim=True)).unbind(-1)
    rows = [
        torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
        torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
        torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
    ]
    return torch.stack(rows, -2)


def _usable(means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, colors: Tensor) -> Tensor:
    finite = torch.cat([means, quats, scales, opacities[:, None], colors], -1).isfinite().all(-1)
    return finite & (scales > 0).all(-1) & (quats.square().sum(-1) > 1e-24)


def project(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    camera: Camera,
    options: RasterOptions,
) -> tuple[ProjectedSurfels, int]:
    """Camera-space geometry of every surfel that can be seen, and how many were dropped for bad numbers."""
    A, t = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
    usable = _usable(means, quats, scales, opacities, colors)
    z = means.detach() @ A[2].detach() + t[2].detach()
    index = torch.nonzero(usable & (z > options.near) & (opacities >= ALPHA_CUT))[:, 0]
    index = index[torch.argsort(z[index], stable=True)]

    c = means[index] @ A.T + t
    axes = A @ rotation_matrices(quats[index])  # columns: the two axes of the disk, the normal
    normal = axes[:, :, 2]
    facing = (normal * c).sum(-1)
    if options.cull_backfaces:
        front = facing <= 0
        index, c, axes, normal, facing = index[front], c[front], axes[front], normal[front], facing[front]

    z = c[:, 2]
    ray = c[:, :2] / z[:, None]
    center = ray @ camera.K[:2, :2].T + camera.K[:2, 2]
    # Derivative of the pixel by movement along the disk's unit axes, times z.
    J = camera.K[:2, :2] @ (axes[:, :2, :2] - ray[:, :, None] * axes[:, 2:, :2])
    det = torch.linalg.det(J)
    solid = (facing.square() > EDGE_ON_COSINE**2 * c.square().sum(-1)) & (det != 0)
    # Edge-on surfels get any invertible matrix: nothing they compute from it is used.
    J = torch.where(solid[:, None, None], J, torch.eye(2, dtype=J.dtype))
    G = torch.linalg.inv(J)
    ab = z[:, None, None] / scales[index][:, :, None] * G
    g = -(axes[:, 2:, :2] @ G)[:, 0]
    normal = torch.where((facing > 0)[:, None], -normal, normal)
    projected = ProjectedSurfels(index, center, ab, g, z, solid, normal, opacities[index], colors[index])
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
    met = s.solid & (pz > 0) & (s.z >= options.near * pz)
    safe_pz = torch.where(met, pz, torch.ones_like(pz))
    uv = (s.ab @ d[..., None])[..., 0] / safe_pz[..., None]
    rho3 = uv.square().sum(-1)
    rho2 = LOW_PASS * d.square().sum(-1)
    solid = met & (rho3 <= rho2)
    rho = torch.where(solid, rho3, rho2)
    z = torch.where(solid, s.z / safe_pz, s.z.expand_as(pz))

    alpha = (s.opacity * torch.exp(-0.5 * rho)).clamp(max=ALPHA_MAX)
    alpha = torch.where(alpha >= ALPHA_CUT, alpha, torch.zeros_like(alpha))
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
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    camera: Camera,
    options: RasterOptions,
) -> RenderOutput:
    """As ``mass_engine.raster.rasterize``, in the dtype of ``means`` and without background."""
    dtype, H, W = means.dtype, camera.height, camera.width
    camera = Camera(camera.K.to(dtype), camera.world_to_camera.to(dtype), W, H)
    surfels, dropped = project(
        means, quats.to(dtype), scales.to(dtype), opacities.to(dtype), colors.to(dtype), camera, options
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
