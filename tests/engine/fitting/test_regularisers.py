"""Geometric losses: known values, gradients against finite differences, what the paper's binding lacks."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor
from torch.autograd import gradcheck

from mass_engine.camera import Camera
from mass_engine.fitting import regularisers
from mass_engine.raster import RasterOptions, rasterize

FACE = torch.tensor([[0.0, 0.0, 0.0], [0.01, 0.0, 0.0], [0.0, 0.01, 0.0]], dtype=torch.float64)
UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)


def bound(height: float, tilt: float) -> tuple[Tensor, Tensor, Tensor]:
    """One surfel ``height`` over the middle of the face, its normal ``tilt`` radians off the face's."""
    mean = FACE.mean(0) + height * UP
    normal = torch.tensor([math.sin(tilt), 0.0, math.cos(tilt)], dtype=torch.float64)
    return mean[None], normal[None], FACE[None]


@pytest.mark.parametrize(
    ("point", "distance"),
    [
        ((0.003, 0.003, 0.002), 0.002),  # over the face
        ((0.003, 0.003, -0.002), 0.002),
        ((0.005, -0.003, 0.004), 0.005),  # beyond an edge
        ((-0.003, -0.004, 0.0), 0.005),  # beyond a corner
        ((0.010, 0.010, 0.0), math.hypot(0.005, 0.005)),  # beyond the long edge
        ((0.002, 0.002, 0.0), 0.0),
    ],
)
def test_distance_to_a_triangle(point: tuple[float, float, float], distance: float) -> None:
    got = regularisers.triangle_distance(torch.tensor(point, dtype=torch.float64), FACE)
    assert float(got) == pytest.approx(distance, abs=1e-12)


def test_the_papers_binding_is_as_printed() -> None:
    delta = 0.001
    far, near = bound(0.004, 0.5), bound(0.0002, 0.5)
    assert float(regularisers.binding_paper(*far, delta)) == pytest.approx(0.004 * (1 - math.cos(0.5)))
    assert float(regularisers.binding_paper(*near, delta)) == pytest.approx(delta * (1 - math.cos(0.5)))
    mean, normal, face = (torch.cat(pair) for pair in zip(far, near, strict=True))
    assert float(regularisers.binding_paper(mean, normal, face, delta)) == pytest.approx(
        0.005 * (1 - math.cos(0.5))
    )


def test_with_the_papers_binding_an_aligned_surfel_pays_nothing_at_any_distance() -> None:
    mean, normal, face = bound(10.0, 0.0)
    mean.requires_grad_()
    loss = regularisers.binding_paper(mean, normal, face, 0.001)
    assert float(loss.detach()) == 0
    (pull,) = torch.autograd.grad(loss, mean)
    assert not bool(pull.any())
    added = regularisers.binding_additive(mean, normal, face, 0.001)
    assert float(added.detach()) == pytest.approx(9999)
    (pull,) = torch.autograd.grad(added, mean)
    assert float(pull[0, 2]) == pytest.approx(1000)


def test_additive_binding_is_zero_within_reach_and_weighs_its_parts() -> None:
    assert float(regularisers.binding_additive(*bound(0.0005, 0.0), 0.001)) == pytest.approx(0, abs=1e-12)
    value = regularisers.binding_additive(*bound(0.003, 0.5), 0.001, distance_weight=2.0, normal_weight=3.0)
    assert float(value) == pytest.approx(2 * 2 + 3 * (1 - math.cos(0.5)))


def test_gradients_of_the_bindings_agree_with_finite_differences() -> None:
    generator = torch.Generator().manual_seed(0)
    count = 12
    triangles = torch.randn(count, 3, 3, generator=generator, dtype=torch.float64, requires_grad=True)
    means = torch.randn(count, 3, generator=generator, dtype=torch.float64, requires_grad=True)
    normals = torch.randn(count, 3, generator=generator, dtype=torch.float64, requires_grad=True)
    assert gradcheck(lambda m, n, f: regularisers.binding_paper(m, n, f, 0.3), (means, normals, triangles))
    assert gradcheck(lambda m, n, f: regularisers.binding_additive(m, n, f, 0.3), (means, normals, triangles))


def two_layers(distance: float, scale: float, focal: float) -> tuple[Tensor, Camera]:
    """Means [2,3] of two disks behind one another, the nearer at ``distance``, everything ``scale`` large."""
    K = torch.tensor([[focal, 0.0, 8.0], [0.0, focal, 8.0], [0.0, 0.0, 1.0]])
    means = torch.tensor([[0.0, 0.0, distance], [0.0, 0.0, distance + 0.01 * scale]])
    return means, Camera(K, torch.eye(4), 16, 16)


@pytest.mark.parametrize("span", [(0.1, 10.0), (0.2, 100.0)])
@pytest.mark.parametrize(("distance", "focal"), [(0.4, 500.0), (137.0, 171250.0)])
def test_distortion_does_not_depend_on_camera_or_range(
    distance: float, focal: float, span: tuple[float, float]
) -> None:
    means, camera = two_layers(distance, 1.0, focal)
    tangents = torch.eye(3)[:2].expand(2, 2, 3) * 0.004
    options = RasterOptions(backend="reference", outputs="all", distortion_range=span)
    # Float64: the paper's own value is far below float32's resolution at the far camera.
    out = rasterize(
        means.double(),
        tangents.double(),
        torch.full((2,), 0.6, dtype=torch.float64),
        torch.zeros(2, 3, dtype=torch.float64),
        camera,
        options=options,
    )
    ones = torch.ones(16, 16)
    middle = out.distortion[8, 8] * torch.ones(1, 1)
    depth = means[:, 2].mean().double()
    value = regularisers.depth_distortion(middle, ones[:1, :1], torch.tensor(1.0), options, depth, 0.2)
    exact = float(out.alpha[8, 8])  # w1 w2 from alpha: 1 - (1 - a)^2
    a = 1 - math.sqrt(1 - exact)
    expected = a * a * (1 - a) * (0.01 / 0.2) ** 2
    assert float(value) == pytest.approx(expected, rel=0.02)
    paper = float(regularisers.depth_distortion_paper(middle, ones[:1, :1]))
    assert (paper < 1e-12) == (distance > 100)


def plane(K: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """Depth [s,s] and unit normal [3] towards the camera of a tilted plane."""
    normal = torch.nn.functional.normalize(torch.tensor([0.3, -0.2, -1.0], dtype=torch.float64), dim=0)
    axis = torch.arange(size, dtype=torch.float64) + 0.5
    pixels = torch.stack([axis.expand(size, size), axis[:, None].expand(size, size)], -1)
    rays = torch.cat([pixels, torch.ones(size, size, 1, dtype=torch.float64)], -1) @ torch.linalg.inv(K).T
    return -0.4 * normal[2].abs() / (rays @ normal), normal


def test_a_flat_plane_is_consistent_and_a_wrong_normal_is_not() -> None:
    K = torch.tensor([[50.0, 0.0, 6.0], [0.0, 50.0, 6.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    depth, normal = plane(K, 12)
    ones = torch.ones(12, 12, dtype=torch.float64)
    area = ones.sum()
    rendered = normal.expand(12, 12, 3)
    assert float(regularisers.normal_consistency(depth, rendered, ones, K, ones, area)) == pytest.approx(
        0, abs=1e-12
    )
    flipped = regularisers.normal_consistency(depth, -rendered, ones, K, ones, area)
    assert float(flipped) == pytest.approx(2 * 100 / 144)
    # Empty pixels and their neighbours say nothing.
    hole = ones.clone()
    hole[5, 5] = 0
    left = regularisers.normal_consistency(depth * hole, -rendered, hole, K, ones, area)
    assert float(left) == pytest.approx(2 * 95 / 144)


def test_gradients_of_normal_consistency_and_distortion_agree_with_finite_differences() -> None:
    generator = torch.Generator().manual_seed(1)
    K = torch.tensor([[20.0, 0.0, 3.0], [0.0, 20.0, 3.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    shape = (6, 6)
    depth = (1 + 0.1 * torch.rand(shape, generator=generator, dtype=torch.float64)).requires_grad_()
    normal = torch.randn(*shape, 3, generator=generator, dtype=torch.float64, requires_grad=True)
    alpha = 0.6 + 0.4 * torch.rand(shape, generator=generator, dtype=torch.float64)
    valid = (torch.rand(shape, generator=generator) > 0.2).double()
    area = torch.tensor(7.0, dtype=torch.float64)
    assert gradcheck(
        lambda d, n: regularisers.normal_consistency(d, n, alpha, K, valid, area), (depth, normal)
    )
    options = RasterOptions()
    assert gradcheck(
        lambda d: regularisers.depth_distortion(d, valid, area, options, torch.tensor(0.4), 0.2), (depth,)
    )
    assert gradcheck(lambda d: regularisers.depth_distortion_paper(d, valid), (depth,))
