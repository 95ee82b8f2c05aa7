"""The layers after the hash grid: from a surfel's and a pose's share of the first layer to residuals.

The first layer is linear in the hash features and in the pose features, and neither knows of the other: the
one's share is a row per surfel, the other's a row per pose, and their sum is what the layer gives.

``decode`` is compiled (``kernels/decoder.hpp``): activations never leave the cache and the backward pass
computes them again, where torch writes [B,N,H] numbers half a dozen times. Every sum has a fixed order, hence
the same bits with any number of threads. ``decode_reference`` is its specification in plain torch.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor

from mass_engine import gpu
from mass_engine.deform import _kernels
from mass_engine.deform.native import shared_kernels
from mass_engine.deform.precision import product
from mass_engine.deform.residuals import Residuals
from mass_engine.device import Precision
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


class Units(NamedTuple):
    """What one unit of the head's output is: ``offset`` in metres, ``rotation`` in radians."""

    offset: float
    rotation: float


def decode(
    surfel_share: Tensor,
    pose_share: Tensor,
    layers: Layers,
    units: Units,
    *,
    threads: int | None = None,
    instruction_set: str = "auto",
) -> Residuals:
    """``surfel_share`` [N,H] and ``pose_share`` [B,H] of the first layer -> residuals [B,N]; differentiable.

    x = head(relu(second(relu(surfel_share + pose_share)))); offset and rotation are x in their units, the
    log-scale is log 2 tanh x: no factor leaves [1/2, 2]. On the CPU float32 with H a multiple of 16 up to 128
    is compiled, anything else is ``decode_reference``. ``threads``: None is every core this process may use.
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
    plain = all(tensor.dtype == torch.float32 for tensor in tensors)
    on_gpu = gpu.kernels_for(surfel_share)
    if on_gpu is not None and plain and hidden in gpu.DECODER_WIDTHS and len(surfel_share):
        return Residuals(*gpu.decode(on_gpu, units, *tensors))
    if hidden % 16 or hidden > 128 or not plain or surfel_share.device.type != "cpu":
        return decode_reference(surfel_share, pose_share, layers, units)
    kernels = shared_kernels(instruction_set)
    out = _Decode.apply(kernels, threads or available_threads(), units, *tensors)  # type: ignore[no-untyped-call]
    return Residuals(*out)


def decode_reference(
    surfel_share: Tensor,
    pose_share: Tensor,
    layers: Layers,
    units: Units,
    precision: Precision = "float32",
) -> Residuals:
    """As ``decode``, in plain torch and any dtype, with matrix products of some ``precision``."""
    hidden = torch.relu(surfel_share + pose_share.unsqueeze(-2))
    refined = torch.relu(product(hidden, layers.second, precision) + layers.second_bias)
    out = product(refined, layers.head, precision) + layers.head_bias
    offset, log_scale, rotation, mask_logit = out.split([3, 2, 3, 1], -1)
    return Residuals(
        offset * units.offset,
        torch.tanh(log_scale) * math.log(2),
        rotation * units.rotation,
        mask_logit.squeeze(-1),
    )


class _Decode(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, kernels: _kernels.Kernels, threads: int, units: Units, *tensors: Tensor
    ) -> tuple[Tensor, ...]:
        given = [tensor.detach().contiguous() for tensor in tensors]
        lead = (len(given[1]), len(given[0]))
        out = [torch.empty(*lead, *end) for end in ((3,), (2,), (3,), ())]
        kernels.decode(*given, *units, *out, threads)  # type: ignore[call-arg, arg-type]
        ctx.kernels, ctx.threads, ctx.units = kernels, threads, units
        ctx.save_for_backward(*given, out[1])
        return tuple(out)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        *given, log_scale = ctx.saved_tensors
        arrived = [gradient.contiguous() for gradient in gradients]
        out = [torch.empty_like(tensor) for tensor in given]
        ctx.kernels.decode_backward(*given[:5], *ctx.units, *arrived, log_scale, *out, ctx.threads)
        return (None, None, None, *out)
