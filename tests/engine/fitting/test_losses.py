"""Losses: values known by hand, and gradients against finite differences."""

from __future__ import annotations

import torch
from torch.autograd import gradcheck

from mass_engine.fitting import losses


def pictures() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    random = torch.Generator().manual_seed(3)
    a = torch.rand(9, 8, 3, generator=random, dtype=torch.float64, requires_grad=True)
    b = torch.rand(9, 8, 3, generator=random, dtype=torch.float64)
    valid = (torch.rand(9, 8, generator=random) > 0.3).double()
    return a, b, valid


def test_equal_pictures_cost_nothing_and_ignored_pixels_do_not_count() -> None:
    a, b, valid = pictures()
    area = torch.tensor(10.0)
    assert float(losses.photometric(b, b, valid, area)) == 0
    assert abs(float(losses.dssim(b, b, valid))) < 1e-9
    changed = torch.where(valid.unsqueeze(-1) > 0, b, 1 - b)
    assert float(losses.photometric(changed, b, valid, area)) == 0
    alpha = torch.rand(9, 8, dtype=torch.float64)
    assert float(losses.silhouette(torch.where(valid > 0, b[..., 0], alpha), b[..., 0], valid, area)) == 0
    assert float(losses.photometric(a, b, valid, area)) > 0


def test_gradients_agree_with_finite_differences() -> None:
    a, b, valid = pictures()
    area = torch.tensor(20.0, dtype=torch.float64)
    assert gradcheck(lambda x: losses.photometric(x, b, valid, area), (a,))
    assert gradcheck(lambda x: losses.dssim(x, b, valid), (a,))
    assert gradcheck(lambda x: losses.silhouette(x[..., 0], b[..., 0], valid, area), (a,))
    values = torch.randn(6, dtype=torch.float64, requires_grad=True)
    edges = torch.tensor([[0, 1], [1, 2], [4, 5]])
    assert gradcheck(lambda x: losses.laplacian(x, edges), (values,))


def test_the_outline_pulls_from_far_away_both_ways() -> None:
    outside = torch.zeros(1, 1, 40, 40)
    outside[..., 20:] = torch.arange(20.0)  # hand on the left, background on the right
    inside = torch.tensor([[5.0, 20.0]], requires_grad=True)
    losses.outline_distance(inside, torch.tensor([[18.0, 20.0]]), outside).backward()
    assert inside.grad is not None
    assert float(inside.grad[0, 0]) < -0.5  # drawn right, towards the outline point 13 pixels away
    out = torch.tensor([[35.0, 20.0]], requires_grad=True)
    losses.outline_distance(out, torch.zeros(0, 2), outside).backward()
    assert out.grad is not None
    assert float(out.grad[0, 0]) > 0.5  # drawn left, back onto the hand
