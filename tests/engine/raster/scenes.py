"""Random surfels of many kinds, and how tests run the rasteriser over them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import torch
from torch import Tensor

from mass_engine.camera import Camera
from mass_engine.raster import RasterOptions, RenderOutput, rasterize
from mass_engine.surfel.inellipse import principal_tangents

NAMES = ("means", "tangents", "opacities", "colors", "world_to_camera", "K")
IMAGES = ("rgb", "alpha", "depth", "median_depth", "normal", "distortion")
EVERYTHING = RasterOptions(outputs="all", distortion_range=(0.3, 1.5))


@dataclass(frozen=True)
class Surfels:
    means: Tensor
    tangents: Tensor
    opacities: Tensor
    colors: Tensor

    def tensors(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        return self.means, self.tangents, self.opacities, self.colors

    def map(self, change: Callable[[Tensor], Tensor]) -> Surfels:
        return Surfels(*(change(t) for t in self.tensors()))


def camera(width: int = 61, height: int = 43, off_center: bool = True) -> Camera:
    """A camera with unequal focal lengths, skew, a principal point off the centre, and a general pose."""
    made = Camera.from_fov(width, height, 60.0)
    K = made.K.clone()
    pose = torch.eye(4)
    if off_center:
        K[1, 1] *= 1.05
        K[0, 1] = 0.8
        K[0, 2] += 2.3
        K[1, 2] -= 1.7
        axis = torch.tensor([[0.0, -0.1, 0.2], [0.1, 0.0, -0.05], [-0.2, 0.05, 0.0]])
        pose[:3, :3] = torch.linalg.matrix_exp(axis)
        pose[:3, 3] = torch.tensor([0.03, -0.02, 0.05])
    return replace(made, K=K, world_to_camera=pose)


def surfels(kind: str, count: int, seed: int, harmonics: int = 0) -> Surfels:
    """``count`` of them; ``harmonics`` 1, 4, 9 or 16 instead of plain colours."""
    g = torch.Generator().manual_seed(seed)

    def rand(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=g)

    depth = 0.6 + 0.5 * rand(count)
    means = torch.stack([(rand(count) - 0.5) * 1.1 * depth, (rand(count) - 0.5) * 0.8 * depth, depth], -1)
    if count == 1:  # a single one stays in view
        means = torch.tensor([[0.02, 0.01, 0.7]])
    quats = torch.randn(count, 4, generator=g)
    scales = 0.01 + 0.05 * rand(count, 2)
    opacities = 0.05 + 0.9 * rand(count)
    colors = rand(count, 3)
    if kind == "grazing":  # normals nearly perpendicular to the viewing direction
        half = 0.5 * (torch.pi / 2 + 0.02 * torch.randn(count, generator=g))
        quats = torch.stack([half.cos(), half.sin(), torch.zeros(count), torch.zeros(count)], -1)
    elif kind == "behind":
        means[:, 2] -= 0.8
    elif kind == "huge":  # many cross the camera plane
        scales = 0.3 + rand(count, 2)
        opacities = 0.02 + 0.3 * rand(count)
    elif kind == "tiny":
        scales = 10 ** (-6 + 3 * rand(count, 2))
    elif kind == "needles":
        scales = torch.stack([0.0005 + 0.001 * rand(count), 0.05 + 0.1 * rand(count)], -1)
    elif kind == "opaque":
        opacities = 0.97 + 0.05 * rand(count)
    elif kind == "faint":
        opacities = 0.02 * rand(count)
    elif kind == "twins":  # exact ties in depth
        half_count = (count + 1) // 2
        means, quats, scales = (t[:half_count].repeat(2, 1)[:count] for t in (means, quats, scales))
    else:
        assert kind == "overlapping"
    tangents = principal_tangents(scales, quats)
    if kind == "overlapping":  # conjugate half-diameters need not be the axes
        shear = torch.tensor([[1.0, 0.6], [-0.3, 0.9]])
        tangents = shear @ tangents
    if harmonics:
        colors = 0.4 * torch.randn(count, harmonics, 3, generator=g)
    return Surfels(means, tangents, opacities, colors)


KINDS = ("overlapping", "grazing", "behind", "huge", "tiny", "needles", "opaque", "faint", "twins")


def images(out: RenderOutput) -> dict[str, Tensor]:
    names = IMAGES if out.extras is not None else IMAGES[:3]
    return {name: getattr(out, name) for name in names}


class Draw(Protocol):
    """``rasterize``, or what stands in for it."""

    def __call__(
        self,
        means: Tensor,
        tangents: Tensor,
        opacities: Tensor,
        colors: Tensor,
        camera: Camera,
        *,
        options: RasterOptions,
    ) -> RenderOutput: ...


def render(
    scene: Surfels, view: Camera, options: RasterOptions = EVERYTHING, draw: Draw = rasterize
) -> RenderOutput:
    return draw(*scene.tensors(), view, options=options)


def with_gradients(
    scene: Surfels,
    view: Camera,
    options: RasterOptions,
    dtype: torch.dtype,
    weights: dict[str, Tensor] | None = None,
    draw: Draw = rasterize,
) -> tuple[RenderOutput, dict[str, Tensor]]:
    """Render, then the gradient of a fixed random combination of all images in every input and the camera."""
    leaves = [t.detach().to(dtype).clone().requires_grad_() for t in scene.tensors()]
    pose = view.world_to_camera.to(dtype).clone().requires_grad_()
    K = view.K.to(dtype).clone().requires_grad_()
    out = render(Surfels(*leaves), Camera(K, pose, view.width, view.height), options, draw)
    g = torch.Generator().manual_seed(99)
    loss = torch.zeros((), dtype=dtype)
    for name, image in images(out).items():
        weight = torch.randn(image.shape, generator=g)
        if weights is not None:
            weight = weight * weights[name]
        loss = loss + (image * weight.to(dtype)).sum()
    gradients = torch.autograd.grad(loss, [*leaves, pose, K], allow_unused=True)
    made = {
        name: torch.zeros_like(leaf) if gradient is None else gradient
        for name, leaf, gradient in zip(NAMES, [*leaves, pose, K], gradients, strict=True)
    }
    return out, made
