"""What a fit does beside rasterising, on a GPU: fixed sparse products, the deformation, the structural loss.

The kernels (``kernels/``, CUDA C++17) are an optional module (docs/gpu.md); without them the same is done by
torch's operators. They run on torch's current stream, wait for nothing and sum in a fixed order.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

#: Rows with at most so many entries, on the mean, are summed by one thread each.
_FEW = 16


@functools.cache
def shared_kernels() -> Any:
    """The compiled module, or None where it was not built."""
    try:
        from mass_engine.gpu import _kernels
    except ImportError:
        return None
    return _kernels


def kernels_for(tensor: Tensor) -> Any:
    """The compiled module if it can work on ``tensor``: float32 on a GPU; else None."""
    return shared_kernels() if tensor.is_cuda and tensor.dtype == torch.float32 else None


def sparse_product(kernels: Any, matrix: Tensor, dense: Tensor) -> Tensor:
    """``matrix`` [N,T] (CSR, int32 indices) @ ``dense`` [T,C] -> [N,C]."""
    dense = dense.contiguous()
    out = dense.new_empty(matrix.shape[0], dense.shape[1])
    begins, columns, values = matrix.crow_indices(), matrix.col_indices(), matrix.values()
    few = len(values) <= _FEW * len(out)
    kernels.product(_stream(dense), begins, columns, values, dense, few, out)
    return out


def deform_passes(kernels: Any) -> tuple[Callable[..., None], Callable[..., None]]:
    """Forward and backward of what residuals do to surfels, for ``deform.residuals.deform_by``."""
    return (
        lambda *tensors: kernels.deform(_stream(tensors[0]), *tensors),
        lambda *tensors: kernels.deform_backward(_stream(tensors[0]), *tensors),
    )


#: Widths of the decoder that there are kernels for.
DECODER_WIDTHS = (16, 32, 48, 64)


def decode(
    kernels: Any, units: tuple[float, float], surfel_share: Tensor, pose_share: Tensor, *layers: Tensor
) -> tuple[Tensor, ...]:
    """As ``deform.decoder.decode``: offset [B,N,3], log-scale [B,N,2], rotation [B,N,3], mask logit [B,N].

    ``layers``: second, its bias, head, its bias. ``units`` of offset and rotation.
    """
    out: tuple[Tensor, ...] = _Decode.apply(kernels, units, surfel_share, pose_share, *layers)  # type: ignore[no-untyped-call]
    return out


class _Decode(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, kernels: Any, units: tuple[float, float], *tensors: Tensor) -> tuple[Tensor, ...]:
        given = [tensor.detach().contiguous() for tensor in tensors]
        share, pose = given[:2]
        lead = (len(pose), len(share))
        out = tuple(share.new_empty(*lead, *end) for end in ((3,), (2,), (3,), ()))
        kernels.decode(_stream(share), *given, *units, *out)
        ctx.kernels, ctx.units = kernels, units
        ctx.save_for_backward(*given, out[1])
        return out

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        *given, log_scale = ctx.saved_tensors
        share, pose, *layers = given
        arrived = [gradient.contiguous() for gradient in gradients]
        d_share = torch.empty_like(share)
        size = ctx.kernels.decoder_sums(share.shape[1], len(pose))
        partial = share.new_empty(ctx.kernels.decoder_blocks(len(share)), size)
        sums = share.new_empty(size)
        ctx.kernels.decode_backward(
            _stream(share), *given, *ctx.units, *arrived, log_scale, d_share, partial, sums
        )
        parts = sums.split([value.numel() for value in (*layers, pose)])
        *d_layers, d_pose = (part.view(v.shape) for part, v in zip(parts, (*layers, pose), strict=True))
        return (None, None, d_share, d_pose, *d_layers)


def dssim(kernels: Any, seen: Tensor, wanted: Tensor, inside: Tensor) -> Tensor:
    """As ``fitting.losses.dssim``; differentiable in ``seen`` alone."""
    loss: Tensor = _Dssim.apply(kernels, seen, wanted.detach(), inside.detach())  # type: ignore[no-untyped-call]
    return loss


class _Dssim(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, kernels: Any, *pictures: Tensor) -> Tensor:
        seen, wanted, inside = (picture.detach().contiguous() for picture in pictures)
        sums = seen.new_empty(kernels.ssim_blocks(*inside.shape), 2)
        slopes = seen.new_empty(3, *inside.shape)
        kernels.ssim(_stream(seen), seen, wanted, inside, sums, slopes)
        unlike, count = sums.sum(0).unbind()
        count = count.clamp_min(1.0)
        ctx.kernels = kernels
        ctx.save_for_backward(seen, wanted, inside, slopes, count)
        return unlike / count

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        seen, wanted, inside, slopes, count = ctx.saved_tensors
        d_seen = torch.empty_like(seen)
        ctx.kernels.ssim_backward(_stream(seen), seen, wanted, inside, slopes, gradient / count, d_seen)
        return None, d_seen, None, None


def _stream(tensor: Tensor) -> int:
    return torch.cuda.current_stream(tensor.device).cuda_stream if tensor.is_cuda else 0
