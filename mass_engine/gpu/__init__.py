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
