"""Spherical harmonics against an independent definition."""

from __future__ import annotations

import math

import pytest
import torch
from scipy.special import sph_harm_y
from torch import Tensor

from mass_engine.surfel.harmonics import evaluate_sh, evaluate_sh_rest, rgb_to_sh0, sh_basis


def directions(count: int, seed: int = 0) -> Tensor:
    random = torch.Generator().manual_seed(seed)
    return torch.nn.functional.normalize(torch.randn(count, 3, generator=random, dtype=torch.float64), dim=1)


def test_basis_is_the_real_form_of_scipys_harmonics() -> None:
    d = directions(200)
    polar, azimuth = torch.arccos(d[:, 2]).numpy(), torch.atan2(d[:, 1], d[:, 0]).numpy()
    ours = sh_basis(d, 16)
    for degree in range(4):
        for order in range(-degree, degree + 1):
            value = sph_harm_y(degree, abs(order), polar, azimuth)
            # scipy's complex harmonics carry (-1)^m; so do the signs in splat files.
            real = value.real if order >= 0 else value.imag
            expected = torch.from_numpy(real * (math.sqrt(2) if order else 1))
            assert torch.allclose(ours[:, degree * degree + degree + order], expected, atol=1e-12), (
                degree,
                order,
            )


def test_first_coefficients_have_the_signs_of_splat_files() -> None:
    c1 = 0.4886025119029199
    basis = sh_basis(torch.eye(3, dtype=torch.float64), 4)
    expected = torch.tensor([[0, 0, -c1], [-c1, 0, 0], [0, c1, 0]], dtype=torch.float64)
    assert torch.allclose(basis[:, 1:], expected)


def test_basis_is_orthonormal_on_the_sphere() -> None:
    count = 20_000
    step = torch.arange(count, dtype=torch.float64)
    z = 1 - (2 * step + 1) / count
    angle = math.pi * (3 - math.sqrt(5)) * step
    d = torch.stack([(1 - z * z).sqrt() * angle.cos(), (1 - z * z).sqrt() * angle.sin(), z], 1)
    basis = sh_basis(d, 16)
    assert torch.allclose(
        basis.T @ basis * (4 * math.pi / count), torch.eye(16, dtype=torch.float64), atol=1e-3
    )


def test_a_colour_survives_degree_zero() -> None:
    rgb = torch.rand(50, 3, generator=torch.Generator().manual_seed(0))
    sh = rgb_to_sh0(rgb).unsqueeze(1)
    assert torch.allclose(evaluate_sh(sh, directions(50).float()), rgb, atol=1e-6)


def test_the_rest_is_what_degree_zero_leaves() -> None:
    sh = torch.randn(40, 9, 3, generator=torch.Generator().manual_seed(1))
    d = directions(40).float()
    whole = evaluate_sh(sh, d)
    parts = evaluate_sh(sh[:, :1], d) + evaluate_sh_rest(sh[:, 1:], d)
    assert torch.allclose(whole, parts, atol=1e-5)


def test_a_wrong_count_is_refused() -> None:
    with pytest.raises(ValueError, match="1, 4, 9 or 16"):
        sh_basis(directions(2), 5)
