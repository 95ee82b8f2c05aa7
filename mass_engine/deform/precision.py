"""Matrix products of fewer bits, where a GPU is faster at them; everything around them stays float32."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor

from mass_engine.device import Precision


def product(rows: Tensor, weights: Tensor, precision: Precision) -> Tensor:
    """``rows`` [...,K] @ ``weights`` [K,C] in float32 or with less; differentiable, the gradients alike."""
    if precision == "float32":
        return rows @ weights
    if precision == "bf16":
        return (rows.bfloat16() @ weights.bfloat16()).float()
    out: Tensor = _Tf32.apply(rows, weights)  # type: ignore[no-untyped-call]
    return out


@contextmanager
def _tf32() -> Iterator[None]:
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("high")
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)


class _Tf32(torch.autograd.Function):
    """The setting is the process's: it is made around each product alone, those of the backward pass, too."""

    @staticmethod
    def forward(ctx: Any, rows: Tensor, weights: Tensor) -> Tensor:
        ctx.save_for_backward(rows, weights)
        with _tf32():
            return rows @ weights

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor]:
        rows, weights = ctx.saved_tensors
        with _tf32():
            return gradient @ weights.mT, rows.flatten(0, -2).mT @ gradient.flatten(0, -2)
