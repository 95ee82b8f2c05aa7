"""The specification itself: gradients by finite differences, and values that can be worked out by hand."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from mass_engine.camera import Camera
from mass_engine.raster import RasterOptions, _kernels, rasterize, types
from mass_engine.raster.types import Backend, Convention
from mass_engine.surfel.inellipse import principal_tangents
from tests.engine.raster.scenes import Surfels, images

REFERENCE = RasterOptions(backend="reference", outputs="all", distortion_range=(0.3, 1.5))


def smooth_scene(seed: int, harmonics: int = 0) -> tuple[Surfels, Camera]:
    """Every surfel covers the whole image well inside its alpha cut and no pixel ends: all is smooth."""
    g = torch.Generator().manual_seed(seed)
    n = 4

    def rand(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=g, dtype=torch.float64)

    means = torch.stack([0.04 * (rand(n) - 0.5), 0.04 * (rand(n) - 0.5), torch.linspace(0.5, 0.9, n)], -1)
    quats = torch.cat([torch.ones(n, 1), 0.4 * (rand(n, 3) - 0.5)], -1) * (0.5 + rand(n, 1))
    shear = torch.tensor([[1.0, 0.2], [-0.1, 0.9]], dtype=torch.float64)
    tangents = shear @ principal_tangents(0.12 + 0.1 * rand(n, 2), quats)
    colors = 0.3 * (rand(n, harmonics, 3) - 0.5) if harmonics else rand(n, 3)
    scene = Surfels(means, tangents, 0.3 + 0.3 * rand(n), colors)
    K = torch.tensor([[9.0, 0.3, 3.7], [0.0, 10.0, 2.6], [0.0, 0.0, 1.0]], dtype=torch.float64)
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, 3] = torch.tensor([0.01, -0.02, 0.03])
    return scene, Camera(K, pose, 7, 5)


@pytest.mark.parametrize("name", ["rgb", "alpha", "depth", "median_depth", "normal", "distortion"])
@pytest.mark.parametrize(
    ("seed", "harmonics", "convention"),
    [(0, 0, "exact"), (1, 0, "gsplat"), (1, 4, "exact"), (0, 16, "inria")],
)
def test_gradients_match_finite_differences(
    name: str, seed: int, harmonics: int, convention: Convention
) -> None:
    scene, camera = smooth_scene(seed, harmonics)
    options = replace(REFERENCE, convention=convention)
    inputs = [t.clone().requires_grad_() for t in (*scene.tensors(), camera.world_to_camera, camera.K)]

    def image(*given: Tensor) -> Tensor:
        m, t, o, c, pose, K = given
        # Only the upper rows are parameters of the camera.
        pose = torch.cat([pose[:3], torch.zeros(1, 4, dtype=pose.dtype)])
        K = torch.cat([K[:2], torch.zeros(1, 3, dtype=K.dtype)])
        out = rasterize(m, t, o, c, Camera(K, pose, camera.width, camera.height), options=options)
        return images(out)[name]

    with torch.no_grad():
        assert float(image(*inputs).abs().max()) > 0
    assert torch.autograd.gradcheck(image, inputs, eps=1e-6, atol=1e-6, rtol=1e-4, nondet_tol=0.0)


def facing(depths: list[float], opacity: float, scale: float = 10.0) -> Surfels:
    n = len(depths)
    means = torch.tensor([[0.0, 0.0, z] for z in depths], dtype=torch.float64)
    quats = torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=torch.float64).repeat(n, 1)
    ones = torch.ones(n, dtype=torch.float64)
    tangents = principal_tangents(scale * ones[:, None].repeat(1, 2), quats)
    return Surfels(means, tangents, opacity * ones, torch.eye(3)[:n].double())


@pytest.mark.parametrize("backend", ["reference", "cpu"])
def test_two_wide_disks_blend_by_hand(backend: Backend) -> None:
    options = replace(REFERENCE, backend=backend)
    out = rasterize(*facing([2.0, 1.0], 0.5).tensors(), Camera.from_fov(3, 3, 10.0), options=options)
    center = {name: image[1, 1].double() for name, image in images(out).items()}
    # The nearer one (second in the list) has weight 0.5, the other 0.25.
    torch.testing.assert_close(center["rgb"], torch.tensor([0.25, 0.5, 0.0], dtype=torch.float64))
    assert float(center["alpha"]) == pytest.approx(0.75)
    assert float(center["depth"]) == pytest.approx((0.5 * 1 + 0.25 * 2) / 0.75)
    assert float(center["median_depth"]) == pytest.approx(1.0)  # the second is met with T = 0.5, not above
    torch.testing.assert_close(center["normal"], torch.tensor([0.0, 0.0, -0.75], dtype=torch.float64))
    b = 0.3 * 1.5 / 1.2
    assert float(center["distortion"]) == pytest.approx(0.5 * 0.25 * (b * (1 / 1.0 - 1 / 2.0)) ** 2)
    expected = torch.tensor([2.25, 4.5], dtype=torch.float64)
    torch.testing.assert_close(out.weight_sum.double(), expected, rtol=1e-2, atol=0)


def test_a_slanted_disk_gives_the_depth_of_its_plane() -> None:
    scene = facing([1.0], 0.9)
    angle = 0.5
    quats = torch.tensor([[math.cos(angle / 2), 0.0, math.sin(angle / 2), 0.0]], dtype=torch.float64)
    camera = Camera.from_fov(21, 11, 60.0)
    tangents = principal_tangents(torch.full((1, 2), 10.0, dtype=torch.float64), quats)
    out = rasterize(scene.means, tangents, *scene.tensors()[2:], camera, options=REFERENCE)
    x = (torch.arange(21) + 0.5 - 10.5) / camera.K[0, 0]
    normal = torch.tensor([math.sin(angle), math.cos(angle)])
    expected = normal[1] / (normal[0] * x + normal[1])  # z with n.(x z, z) = n.(0, 1)
    torch.testing.assert_close(out.depth[5], expected.double(), rtol=1e-6, atol=0)


def test_a_point_is_a_gaussian_of_half_a_square_pixel() -> None:
    scene = facing([1.0], 0.8, scale=1e-6)
    out = rasterize(*scene.tensors(), Camera.from_fov(9, 9, 30.0), options=REFERENCE)
    expected = [0.8 * math.exp(-(d**2)) if 0.8 * math.exp(-(d**2)) > 1 / 255 else 0.0 for d in range(5)]
    torch.testing.assert_close(out.alpha[4, 4:], torch.tensor(expected, dtype=torch.float64))


def test_weak_and_late_surfels_are_not_blended() -> None:
    out = rasterize(*facing([1.0, 2.0, 3.0], 1.0).tensors(), Camera.from_fov(1, 1, 10.0), options=REFERENCE)
    # 0.99, then 0.01 * 0.99; the third would leave 1e-6.
    torch.testing.assert_close(out.rgb[0, 0], torch.tensor([0.99, 0.0099, 0.0], dtype=torch.float64))
    weak = rasterize(*facing([1.0], 0.0039).tensors(), Camera.from_fov(1, 1, 10.0), options=REFERENCE)
    assert float(weak.alpha.max()) == 0.0


def test_the_clamp_passes_no_gradient() -> None:
    backends: tuple[Backend, ...] = ("reference", "cpu")
    for backend in backends:
        options = RasterOptions(backend=backend)
        scene = facing([1.0], 1.0).map(lambda t: t.float().requires_grad_())
        out = rasterize(*scene.tensors(), Camera.from_fov(3, 3, 10.0), options=options)
        out.alpha.sum().backward()
        for tensor in scene.tensors()[:3]:
            assert tensor.grad is not None
            assert float(tensor.grad.abs().max()) == 0.0


def test_the_reference_and_the_kernels_use_the_same_constants() -> None:
    for name, value in _kernels.CONSTANTS.items():
        assert getattr(types, name.upper()) == pytest.approx(value, rel=1e-7)
    assert len(_kernels.CONSTANTS) == 8
