"""The compiled decoder against its specification, in value and in gradient, on every instruction set."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from mass_engine.deform import _kernels
from mass_engine.deform.decoder import OUTPUTS, Layers, Units, decode, decode_reference
from mass_engine.deform.residuals import Residuals
from mass_engine.errors import BadArgumentError

UNITS = Units(0.5, 2.0)


def inputs(count: int, batch: int, hidden: int, seed: int = 0) -> list[Tensor]:
    generator = torch.Generator().manual_seed(seed)
    shapes = ((count, hidden), (batch, hidden), (hidden, hidden), (hidden,), (hidden, OUTPUTS), (OUTPUTS,))
    # The head's small: a hyperbolic tangent at its end has no gradient to compare.
    scales = (0.5, 0.5, 0.5, 0.5, 0.1, 0.5)
    return [torch.randn(s, generator=generator) * x for s, x in zip(shapes, scales, strict=True)]


def weights(count: int, batch: int) -> Tensor:
    return torch.randn(batch, count, OUTPUTS, generator=torch.Generator().manual_seed(1))


def flat(residuals: Residuals) -> Tensor:
    """All nine numbers [B,N,9]."""
    mask_logit = residuals.mask_logit.unsqueeze(-1)
    return torch.cat([residuals.offset, residuals.log_scale, residuals.rotation, mask_logit], -1)


def run(tensors: list[Tensor], weight: Tensor, **options: object) -> list[Tensor]:
    """Outputs and the six gradients of a weighted sum of them."""
    given = [tensor.clone().requires_grad_() for tensor in tensors]
    out = flat(decode(given[0], given[1], Layers(*given[2:]), UNITS, **options))  # type: ignore[arg-type]
    return [out.detach(), *torch.autograd.grad((out * weight).sum(), given)]


@pytest.mark.parametrize("instruction_set", _kernels.instruction_sets())
@pytest.mark.parametrize(
    ("count", "batch", "hidden"), [(1, 1, 16), (49, 2, 32), (1003, 3, 48), (2000, 1, 64)]
)
def test_it_agrees_with_the_specification(instruction_set: str, count: int, batch: int, hidden: int) -> None:
    tensors, weight = inputs(count, batch, hidden), weights(count, batch)
    got = run(tensors, weight, instruction_set=instruction_set)
    exact = [tensor.double().requires_grad_() for tensor in tensors]
    out = flat(decode_reference(exact[0], exact[1], Layers(*exact[2:]), UNITS))
    expected = [out.detach(), *torch.autograd.grad((out * weight).sum(), exact)]
    for value, truth in zip(got, expected, strict=True):
        assert value.shape == truth.shape
        # Near zero a rectifier may open in one and not in the other: the sums hardly notice.
        assert float((value - truth).norm()) <= 2e-5 * float(truth.norm())


def test_any_number_of_threads_gives_the_same_bits() -> None:
    tensors, weight = inputs(5000, 3, 32), weights(5000, 3)
    one = run(tensors, weight, threads=1)
    for _ in range(3):
        for value, other in zip(one, run(tensors, weight, threads=3), strict=True):
            assert torch.equal(value, other)


def test_gradients_agree_with_finite_differences() -> None:
    tensors, weight = [tensor.double() for tensor in inputs(5, 2, 16)], weights(5, 2)
    gradients = run([tensor.float() for tensor in tensors], weight)[1:]

    def total(values: list[Tensor]) -> float:
        out = flat(decode_reference(values[0], values[1], Layers(*values[2:]), UNITS))
        return float((out * weight).sum())

    step = 1e-6
    for index, gradient in enumerate(gradients):
        for place in range(0, tensors[index].numel(), 7):
            moved = [tensor.clone() for tensor in tensors]
            moved[index].view(-1)[place] += step
            high = total(moved)
            moved[index].view(-1)[place] -= 2 * step
            slope = (high - total(moved)) / (2 * step)
            assert float(gradient.reshape(-1)[place]) == pytest.approx(slope, rel=1e-3, abs=1e-3)


def test_one_output_alone_has_its_gradient() -> None:
    tensors = [tensor.requires_grad_() for tensor in inputs(70, 2, 32)]
    out = decode(tensors[0], tensors[1], Layers(*tensors[2:]), UNITS)
    got = torch.autograd.grad(out.mask_logit.sum(), tensors)
    truth = decode_reference(tensors[0], tensors[1], Layers(*tensors[2:]), UNITS)
    for value, other in zip(got, torch.autograd.grad(truth.mask_logit.sum(), tensors), strict=True):
        assert torch.allclose(value, other, rtol=1e-4, atol=1e-4)


def test_nothing_at_all_and_bad_input() -> None:
    out = run(inputs(0, 2, 16), torch.zeros(2, 0, OUTPUTS))
    assert out[0].shape == (2, 0, OUTPUTS)
    assert not bool(out[3].any())
    share, pose, *layers = inputs(4, 1, 16)
    with pytest.raises(BadArgumentError, match=r"deform\.shape"):
        decode(share, pose[:, :8], Layers(*layers), UNITS)
    with pytest.raises(BadArgumentError, match=r"deform\.instruction_set"):
        decode(share, pose, Layers(*layers), UNITS, instruction_set="mmx")
