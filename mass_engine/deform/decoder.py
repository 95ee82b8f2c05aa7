"""The layers after the hash grid: from a surfel's and a pose's share of the first layer to outputs.

The first layer is linear in the hash features and in the pose features, and neither knows of the other: the
one's share is a row per surfel, the other's a row per pose, and their sum is what the layer gives.

``decode`` is compiled (``kernels/``): activations never leave the cache and the backward pass computes them
again, where torch writes [B,N,H] numbers half a dozen times. Every sum has a fixed order, hence the same bits
with any number of threads. ``decode_reference`` is its specification in plain torch.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import torch
from torch import Tensor

from mass_engine.deform import _kernels
from mass_engine.errors import BadArgumentError
from mass_engine.raster.cpu import available_threads

#: offset 3, log-scale 2, rotation 3, mask logit 1
OUTPUTS = 9


class Layers(NamedTuple):
    """Second layer [H,H] and [H], head [H,O] and [O] (inputs along the rows)."""

    second: Tensor
    second_bias: Tensor
    head: Tensor
    head_bias: Tensor


def decode(
    surfel_share: Tensor,
    pose_share: Tensor,
    layers: Layers,
    *,
    threads: int | None = None,
    instruction_set: str = "auto",
) -> Tensor:
    """``surfel_share`` [N,H] and ``pose_share`` [B,H] of the first layer -> outputs [B,N,O]; differentiable.

    head(relu(second(relu(surfel_share + pose_share)))). float32 with H a multiple of 16 up to 128 is
    compiled, anything else is ``decode_reference``. ``threads``: None is every core this process may use.
    Raises BadArgumentError ``deform.shape`` and ``deform.instruction_set``.
    """
    tensors = (surfel_share, pose_share, *layers)
    hidden = surfel_share.shape[-1]
    wanted = ((len(surfel_share), hidden), (len(pose_share), hidden), (hidden, hidden), (hidden,))
    shapes = tuple(tuple(tensor.shape) for tensor in tensors)
    if shapes != (*wanted, (hidden, OUTPUTS), (OUTPUTS,)):
        raise BadArgumentError(
            "deform.shape", f"The decoder's tensors are {shapes}.", "Give N,H; B,H; H,H; H; H,9 and 9."
        )
    if hidden % 16 or hidden > 128 or any(tensor.dtype != torch.float32 for tensor in tensors):
        return decode_reference(surfel_share, pose_share, layers)
    kernels = shared_kernels(instruction_set)
    out: Tensor = _Decode.apply(kernels, threads or available_threads(), *tensors)  # type: ignore[no-untyped-call]
    return out


def decode_reference(surfel_share: Tensor, pose_share: Tensor, layers: Layers) -> Tensor:
    """As ``decode``, in plain torch and any dtype."""
    hidden = torch.relu(surfel_share + pose_share.unsqueeze(-2))
    refined = torch.relu(hidden @ layers.second + layers.second_bias)
    return refined @ layers.head + layers.head_bias


@functools.cache
def shared_kernels(instruction_set: str = "auto") -> _kernels.Kernels:
    """The process's kernels; their threads are made on first use.

    Raises BadArgumentError ``deform.instruction_set`` when this machine lacks it.
    """
    if instruction_set != "auto" and instruction_set not in _kernels.instruction_sets():
        raise BadArgumentError(
            "deform.instruction_set",
            f"This machine has no {instruction_set}.",
            f"Use auto, {', '.join(_kernels.instruction_sets())}.",
        )
    return _kernels.Kernels(instruction_set)


class _Decode(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, kernels: _kernels.Kernels, threads: int, *tensors: Tensor) -> Tensor:
        given = [tensor.detach().contiguous() for tensor in tensors]
        out = torch.empty(len(given[1]), len(given[0]), OUTPUTS)
        kernels.decode(*given, out, threads)  # type: ignore[call-arg, arg-type]
        ctx.kernels, ctx.threads = kernels, threads
        ctx.save_for_backward(*given)
        return out

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        given = ctx.saved_tensors
        out = [torch.empty_like(tensor) for tensor in given]
        ctx.kernels.decode_backward(*given[:5], gradient.contiguous(), *out, ctx.threads)
        return (None, None, *out)
