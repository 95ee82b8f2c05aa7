"""The Steiner inellipse: its geometry, its invariances, and gradients where the axes are undefined."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from mass_engine.hand.model import axis_angle_to_matrix
from mass_engine.surfel.inellipse import (
    conjugate_axes,
    principal_scales_quats,
    quat_to_matrix,
    steiner_inellipse,
)

few = settings(max_examples=25, deadline=None, derandomize=True)
seeds = st.integers(0, 10_000)


def triangles(seed: int, count: int = 64) -> Tensor:
    """Well-conditioned random triangles [count,3,3] in double precision."""
    random = torch.Generator().manual_seed(seed)
    found = torch.randn(count * 8, 3, 3, generator=random, dtype=torch.float64)
    edges = found - found.roll(1, 1)
    area = torch.linalg.cross(edges[:, 0], edges[:, 1]).norm(dim=1)
    return found[area > 0.2 * edges.square().sum((1, 2))][:count]


def covariance(scales: Tensor, quats: Tensor) -> Tensor:
    """The ellipse as a matrix [...,3,3], whatever its axes are called."""
    axes = quat_to_matrix(quats)[..., :2] * scales.unsqueeze(-2)
    return axes @ axes.mT


@few
@given(seeds)
def test_scales_are_the_papers_formula(seed: int) -> None:
    corners = triangles(seed)
    _, scales, _ = steiner_inellipse(corners)
    a2, b2, c2 = ((corners[:, i] - corners[:, j]).square().sum(1) for i, j in ((1, 2), (2, 0), (0, 1)))
    f = (a2 * a2 + b2 * b2 + c2 * c2 - a2 * b2 - b2 * c2 - c2 * a2).sqrt()
    expected = torch.stack([(a2 + b2 + c2 + 2 * f).sqrt(), (a2 + b2 + c2 - 2 * f).sqrt()], 1) / 6
    assert torch.allclose(scales, expected, atol=1e-9)


@few
@given(seeds)
def test_it_touches_each_edge_at_its_midpoint_only(seed: int) -> None:
    corners = triangles(seed)
    center, scales, quats = steiner_inellipse(corners)
    axes = quat_to_matrix(quats)[..., :2]
    for i, j in ((0, 1), (1, 2), (2, 0)):
        for place in torch.linspace(0, 1, 21).tolist():
            point = corners[:, i] * (1 - place) + corners[:, j] * place - center
            inside = ((point.unsqueeze(1) @ axes).squeeze(1) / scales).square().sum(1)
            if abs(place - 0.5) < 1e-6:
                assert torch.allclose(inside, torch.ones_like(inside), atol=1e-8)
            else:
                assert (inside > 1).all()


@few
@given(seeds)
def test_area_ratio(seed: int) -> None:
    corners = triangles(seed)
    _, scales, _ = steiner_inellipse(corners)
    area = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).norm(dim=1) / 2
    ratio = math.pi * scales.prod(1) / area
    assert torch.allclose(ratio, torch.full_like(ratio, math.pi / (3 * math.sqrt(3))), atol=1e-9)


@few
@given(seeds)
def test_the_frame_is_a_rotation_with_the_outward_normal(seed: int) -> None:
    corners = triangles(seed)
    _, scales, quats = steiner_inellipse(corners)
    rotation = quat_to_matrix(quats)
    assert torch.allclose(quats.norm(dim=1), torch.ones(len(quats), dtype=torch.float64), atol=1e-12)
    assert torch.allclose(torch.linalg.det(rotation), torch.ones(len(quats), dtype=torch.float64), atol=1e-9)
    normal = torch.nn.functional.normalize(
        torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), dim=1
    )
    assert torch.allclose(rotation[..., 2], normal, atol=1e-9)
    assert (scales[:, 0] >= scales[:, 1]).all()


@few
@given(seeds, st.permutations(range(3)))
def test_the_order_of_the_corners_does_not_matter(seed: int, order: list[int]) -> None:
    corners = triangles(seed)
    one, two = steiner_inellipse(corners), steiner_inellipse(corners[:, order])
    assert torch.allclose(one[0], two[0], atol=1e-9)
    assert torch.allclose(one[1], two[1], atol=1e-9)
    assert torch.allclose(covariance(*one[1:]), covariance(*two[1:]), atol=1e-8)


@few
@given(seeds, st.floats(1e-3, 1e3))
def test_it_moves_turns_and_scales_with_the_triangle(seed: int, scale: float) -> None:
    corners = triangles(seed)
    random = torch.Generator().manual_seed(seed + 1)
    turn = axis_angle_to_matrix(torch.randn(3, generator=random, dtype=torch.float64) * 2)
    shift = torch.randn(3, generator=random, dtype=torch.float64)
    one, two = steiner_inellipse(corners), steiner_inellipse(scale * corners @ turn.T + shift)
    assert torch.allclose(two[0], scale * one[0] @ turn.T + shift, atol=1e-8 * max(1.0, scale))
    assert torch.allclose(two[1], scale * one[1], rtol=1e-8)
    expected = scale**2 * turn @ covariance(*one[1:]) @ turn.T
    assert torch.allclose(covariance(*two[1:]), expected, atol=1e-7 * scale**2)


def awkward() -> dict[str, Tensor]:
    root = math.sqrt(3) / 2
    equilateral = torch.tensor([[0, 0, 0], [1, 0, 0], [0.5, root, 0]], dtype=torch.float64)
    return {
        "equilateral": equilateral,
        "equilateral upside down": equilateral.flip(0),
        "facing straight down": equilateral * torch.tensor([1.0, -1.0, 1.0]),
        "millimetre": equilateral * 1e-3,
        "tiny": equilateral * 1e-6,
        "sliver": torch.tensor([[0, 0, 0], [1, 0, 0], [0.5, 1e-7, 0]], dtype=torch.float64),
        "steep sliver": torch.tensor([[0, 0, 0], [0, 1e-6, 1], [0, 0, 2]], dtype=torch.float64),
        "line": torch.tensor([[0, 0, 0], [0, 0, 1], [0, 0, 2]], dtype=torch.float64),
        "point": torch.ones(3, 3, dtype=torch.float64),
        "right isosceles": torch.tensor([[0, 0, 0], [1, 0, 0], [0, 1, 0]], dtype=torch.float64),
    }


@pytest.mark.parametrize("name", list(awkward()))
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_awkward_triangles_give_finite_values_and_gradients(name: str, dtype: torch.dtype) -> None:
    corners = awkward()[name].to(dtype).requires_grad_(True)
    center, scales, quats = steiner_inellipse(corners)
    random = torch.Generator().manual_seed(0)
    weights = [torch.randn(part.shape, generator=random, dtype=dtype) for part in (center, scales, quats)]
    total = sum(
        ((part * weight).sum() for part, weight in zip((center, scales, quats), weights, strict=True))
    )
    assert isinstance(total, Tensor)
    (gradient,) = torch.autograd.grad(total, corners)
    for part in (center, scales, quats, gradient):
        assert torch.isfinite(part).all()
    assert (scales >= 0).all()
    assert float(quats.detach().norm()) == pytest.approx(1, abs=1e-5)


@few
@given(seeds)
def test_gradient_of_the_ellipse_agrees_with_finite_differences(seed: int) -> None:
    corners = triangles(seed, 4).requires_grad_(True)

    def ellipse(x: Tensor) -> Tensor:
        _, scales, quats = steiner_inellipse(x)
        return covariance(scales, quats)

    assert torch.autograd.gradcheck(ellipse, (corners,), eps=1e-6, atol=1e-5)


@few
@given(seeds)
def test_scales_and_axes_agree_with_an_eigen_decomposition(seed: int) -> None:
    corners = triangles(seed)
    _, p, q = conjugate_axes(corners).unbind(-2)
    scales, quats = principal_scales_quats(q, p)
    matrix = p.unsqueeze(-1) * p.unsqueeze(-2) + q.unsqueeze(-1) * q.unsqueeze(-2)
    values = torch.linalg.eigvalsh(matrix)[:, [2, 1]]
    assert torch.allclose(scales.square(), values, atol=1e-9)
    assert torch.allclose(covariance(scales, quats), matrix, atol=1e-9)
