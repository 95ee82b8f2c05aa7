"""What the deformation changes about a surfel, and how: p' = p + dp, r' = r + dr, s' = s + ds, a' = a M_a.

Everything is said in the surfel's own posed frame (first tangent, bitangent, normal), so that it travels with
the hand.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from mass_engine import gpu
from mass_engine.deform.native import shared_kernels
from mass_engine.errors import BadArgumentError
from mass_engine.raster.cpu import available_threads
from mass_engine.surfel.binding import AttachedSurfels


@dataclass(frozen=True)
class Residuals:
    """Changes of surfels [B,N], all zero for none.

    ``offset`` [B,N,3] metres along (tangent, bitangent, normal); ``log_scale`` [B,N,2] natural logarithms of
    the factors on the two tangents; ``rotation`` [B,N,3], small angles in radians about the same three axes;
    ``mask_logit`` [B,N].
    """

    offset: Tensor
    log_scale: Tensor
    rotation: Tensor
    mask_logit: Tensor

    @property
    def mask(self) -> Tensor:
        """The opacity mask M_alpha [B,N] in [0,1], which multiplies the opacities."""
        return opacity_mask(self.mask_logit)


def opacity_mask(logit: Tensor) -> Tensor:
    """M = min(1, 2 sigmoid(x)): exactly 1 at zero, and everything down to 0 within reach.

    A logistic alone cannot be 1 at a finite logit. The gradient is the projected one: where x > 0 the mask
    stays 1, but a loss that wants less of it still draws x back, so no surfel is stuck there.
    """
    mask: Tensor = _Mask.apply(logit)  # type: ignore[no-untyped-call]
    return mask


class _Mask(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, logit: Tensor) -> Tensor:
        ctx.save_for_backward(logit)
        return (2 * torch.sigmoid(logit)).clamp_max(1.0)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        (logit,) = ctx.saved_tensors
        half = torch.sigmoid(logit)
        slope = 2 * half * (1 - half)
        return torch.where((logit <= 0) | (gradient > 0), gradient * slope, torch.zeros_like(slope))


def deform(
    surfels: AttachedSurfels,
    residuals: Residuals,
    *,
    threads: int | None = None,
    instruction_set: str = "auto",
) -> AttachedSurfels:
    """The deformed surfels; differentiable in both. Shapes [B,N] as in ``Residuals``, or any other [...].

    float32 is compiled (for a GPU if its kernels are built), anything else is ``deform_reference``.
    ``threads``: None is every core this process may use. Raises BadArgumentError ``deform.shape`` and
    ``deform.instruction_set``.
    """
    tensors = (
        surfels.means,
        surfels.tangents,
        surfels.normals,
        residuals.offset,
        residuals.log_scale,
        residuals.rotation,
    )
    lead = surfels.means.shape[:-1]
    shapes = tuple(tuple(tensor.shape) for tensor in tensors)
    if shapes != tuple((*lead, *end) for end in ((3,), (2, 3), (3,), (3,), (2,), (3,))):
        raise BadArgumentError(
            "deform.shape", f"Surfels and residuals are {shapes}.", "Give a residual for each surfel."
        )
    kernels = gpu.kernels_for(surfels.means)
    if any(tensor.dtype != torch.float32 for tensor in tensors):
        return deform_reference(surfels, residuals)
    if kernels is not None:
        return deform_by(gpu.deform_passes(kernels), surfels, residuals)
    if surfels.means.device.type != "cpu":
        return deform_reference(surfels, residuals)
    compiled: Any = shared_kernels(instruction_set)
    count = threads or available_threads()
    passes = (
        lambda *given: compiled.deform(*given, count),
        lambda *given: compiled.deform_backward(*given, count),
    )
    return deform_by(passes, surfels, residuals)


def deform_by(
    passes: tuple[Callable[..., None], Callable[..., None]], surfels: AttachedSurfels, residuals: Residuals
) -> AttachedSurfels:
    """As ``deform``, by a compiled forward and backward pass: given tensors first, then those to fill."""
    given = (surfels.means, surfels.tangents, surfels.normals)
    changes = (residuals.offset, residuals.log_scale, residuals.rotation)
    out = _Deform.apply(passes, *given, *changes)  # type: ignore[no-untyped-call]
    return AttachedSurfels(*out)


class _Deform(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, passes: tuple[Callable[..., None], Callable[..., None]], *tensors: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        given = [tensor.detach().contiguous() for tensor in tensors]
        means, tangents, normals = (torch.empty_like(tensor) for tensor in given[:3])
        passes[0](*given, means, tangents, normals)
        ctx.back = passes[1]
        ctx.save_for_backward(*given[1:])
        return means, tangents, normals

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        given = ctx.saved_tensors
        arrived = [gradient.contiguous() for gradient in gradients]
        out = [torch.empty_like(tensor) for tensor in given]
        ctx.back(*given, *arrived, *out)
        return (None, gradients[0], *out)


def deform_reference(surfels: AttachedSurfels, residuals: Residuals) -> AttachedSurfels:
    """As ``deform``, in plain torch and any dtype.

    The rotation by w is the Cayley one of a = w / 2, R v = v + 2 / (1 + |a|^2) (a x v + a x (a x v)): that of
    the quaternion (1, w / 2), normalised, exact and without a branch at zero. Scales multiply the tangents
    before it: with both factors within [1/2, 2] the ellipse's principal axes change within the same bounds,
    though the tangents are any conjugate pair of it.
    """
    # Components first and contiguous, [3,B,N]: several times faster than vectors of three.
    t0, t1, n = (_planes(v) for v in (*surfels.tangents.unbind(-2), surfels.normals))
    length = (t0.square().sum(0) + 1e-24).sqrt()
    t = t0 / length
    b = torch.stack([n[1] * t[2] - n[2] * t[1], n[2] * t[0] - n[0] * t[2], n[0] * t[1] - n[1] * t[0]])
    along, across = (t1 * t).sum(0), (t1 * b).sum(0)

    dx, dy, dz = _planes(residuals.offset)
    means = _planes(surfels.means) + (dx * t + dy * b + dz * n)

    # What the rotation adds to each axis of the frame: zero for none, to the last bit.
    x, y, z = 0.5 * _planes(residuals.rotation)
    k = 2 / (1 + x * x + y * y + z * z)
    add_t = (-k * (y * y + z * z)) * t + (k * (x * y + z)) * b + (k * (x * z - y)) * n
    add_b = (k * (x * y - z)) * t + (-k * (x * x + z * z)) * b + (k * (y * z + x)) * n
    add_n = (k * (x * z + y)) * t + (k * (y * z - x)) * b + (-k * (x * x + y * y)) * n

    s0, s1 = _planes(residuals.log_scale).exp()
    first = s0 * (t0 + length * add_t)
    second = s1 * (t1 + along * add_t + across * add_b)
    tangents = torch.stack([first, second]).movedim((0, 1), (-2, -1))
    return AttachedSurfels(means.movedim(0, -1), tangents, (n + add_n).movedim(0, -1))


def _planes(vectors: Tensor) -> Tensor:
    """[...,C] -> [C,...], contiguous."""
    return vectors.movedim(-1, 0).contiguous()
