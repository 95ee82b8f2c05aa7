"""The guard of a descent: NaN and divergence are undone, a lone outlier is only left out."""

from __future__ import annotations

import torch

from mass_engine.fitting.guard import IN_A_ROW, LEAP, Guard


def descended(guard: Guard, value: torch.Tensor, steps: int) -> None:
    for _ in range(steps):
        value.grad = torch.ones_like(value)
        assert guard.good(torch.tensor(1.0))
        with torch.no_grad():
            value -= 0.1


def test_a_nan_goes_back_at_half_the_rate() -> None:
    value = torch.zeros(3)
    guard = Guard([value])
    descended(guard, value, 5)
    value.grad = torch.full((3,), torch.nan)
    assert not guard.good(torch.tensor(1.0))
    assert torch.isfinite(value).all()
    assert guard.rate == 0.5
    assert guard.undone == 1
    assert not guard.good(torch.tensor(torch.nan))
    assert guard.rate == 0.25


def test_a_leap_that_lasts_is_undone_and_a_single_one_left_out() -> None:
    value = torch.zeros(1)
    guard = Guard([value])
    descended(guard, value, 30)
    kept = value.clone()
    value.grad = torch.zeros(1)
    high = torch.tensor(2 * LEAP)
    assert not guard.good(high)
    assert (guard.undone, guard.skipped) == (0, 1)
    assert torch.equal(value, kept)
    descended(guard, value, 1)
    for _ in range(IN_A_ROW):
        assert not guard.good(high)
    assert guard.undone == 1
    assert float(value) > float(kept), "further back, where it was good"
