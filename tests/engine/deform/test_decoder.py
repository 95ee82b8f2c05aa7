"""The compiled decoder against its specification, in value and in gradient, on every instruction set."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from mass_engine.deform import _kernels
from mass_engine.deform.decoder import OUTPUTS, Layers, decode, decode_reference
from mass_engine.errors import BadArgumentError


def inputs(count: int, batch: int, hidden: int, seed: int = 0) -> list[Tensor]:
    generator = torch.Generator().manual_seed(seed)
    shapes = ((count, hidden), (batch, hidden), (hidden, hidden), (hidden,), (hidden, OUTPUTS), (OUTPUTS,))
    return [torch.randn(shape, generator=generator) * 0.5 for shape in shapes]


def run(tensors: list[Tensor], weight: Tensor, **options: object) -> list[Tensor]:
    """Outputs and the six gradients of a weighted sum of them."""
    given = [tensor.clone().requires_grad_() for tensor in tensors]
    out = decode(given[0], given[1], Layers(*given[2:]), **options)  # type: ignore[arg-type]
    return [out.detach(), *torch.autograd.grad((out * weight).sum(), given)]


@pytest.mark.parametrize("instruction_set", _kernels.instruction_sets())
@pytest.mark.parametrize(
    ("count", "batch", "hidden"), [(1, 1, 16), (49, 2, 32), (1003, 3, 48), (2000, 1, 64)]
)
def test_it_agrees_with_the_specification(instruction_set: str, count: int, batch: int, hidden: int) -> None:
    tensors = inputs(count, batch, hidden)
    weight = torch.randn(batch, count, OUTPUTS, generator=torch.Generator().manual_seed(1))
    got = run(tensors, weight, instruction_set=instruction_set)
    exact = [tensor.double().requires_grad_() for tensor in tensors]
    out = decode_reference(exact[0], exact[1], Layers(*exact[2:]))
    expected = [out.detach(), *torch.autograd.grad((out * weight).sum(), exact)]
    for value, truth in zip(got, expected, strict=True):
        assert value.shape == truth.shape
        # Near zero a rectifier may open in one and not in the other: the sums hardly notice.
        assert float((value - truth).norm()) <= 2e-5 * float(truth.norm())


def test_any_number_of_threads_gives_the_same_bits() -> None:
    tensors = inputs(5000, 3, 32)
    weight = torch.randn(3, 5000, OUTPUTS, generator=torch.Generator().manual_seed(1))
    one = run(tensors, weight, threads=1)
    for _ in range(3):
        for value, other in zip(one, run(tensors, weight, threads=3), strict=True):
            assert torch.equal(value, other)


def test_gradients_agree_with_finite_differences() -> None:
    tensors = [tensor.double() for tensor in inputs(5, 2, 16)]
    weight = torch.randn(2, 5, OUTPUTS, generator=torch.Generator().manual_seed(1))
    gradients = run([tensor.float() for tensor in tensors], weight)[1:]

    def total(values: list[Tensor]) -> float:
        return float((decode_reference(values[0], values[1], Layers(*values[2:])) * weight).sum())

    step = 1e-6
    for index, gradient in enumerate(gradients):
        for place in range(0, tensors[index].numel(), 7):
            moved = [tensor.clone() for tensor in tensors]
            moved[index].view(-1)[place] += step
            high = total(moved)
            moved[index].view(-1)[place] -= 2 * step
            slope = (high - total(moved)) / (2 * step)
            assert float(gradient.reshape(-1)[place]) == pytest.approx(slope, rel=1e-3, abs=1e-3)


def test_nothing_at_all_and_bad_input() -> None:
    tensors = inputs(0, 2, 16)
    out = run(tensors, torch.zeros(2, 0, OUTPUTS))
    assert out[0].shape == (2, 0, OUTPUTS)
    assert not bool(out[3].any())
    share, pose, *layers = inputs(4, 1, 16)
    with pytest.raises(BadArgumentError, match=r"deform\.shape"):
        decode(share, pose[:, :8], Layers(*layers))
    with pytest.raises(BadArgumentError, match=r"deform\.instruction_set"):
        decode(share, pose, Layers(*layers), instruction_set="mmx")
