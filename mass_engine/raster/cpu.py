"""The compiled CPU kernels behind an autograd function.

The kernels (``kernels/``, C++17) work in passes: project surfels, list them per 16 x 16 tile, order each
tile's list by depth, blend it front to back. The backward pass blends each tile back to front into one record
per (surfel, tile) pair, then adds a surfel's records in a fixed order and applies the chain rule. Every sum
has a fixed order, hence the same bits with any number of threads. A vector is a 4 x 4 block of pixels: hand
surfels are a few pixels wide, and a square block wastes fewer lanes on them than a row. A surfel so small on
screen that only its low-pass part can show takes a shorter path with the same result. The same code is
compiled for AVX-512, AVX2 and plain vectors, and chosen at run time.
"""

from __future__ import annotations

import functools
import os
from typing import Any, get_args

import torch
from torch import Tensor

from mass_engine.camera import Camera
from mass_engine.errors import BadArgumentError, EngineError
from mass_engine.raster import _kernels
from mass_engine.raster.types import OPTIMIZATIONS, Convention, Extras, RasterOptions, RenderOutput


@functools.cache
def shared_renderer(instruction_set: str = "auto") -> _kernels.Renderer:
    """The process's renderer: its threads and its reusable buffers are made on first use.

    Raises ``BadArgumentError`` ``raster.instruction_set`` when this machine lacks it.
    """
    if instruction_set != "auto" and instruction_set not in _kernels.instruction_sets():
        raise BadArgumentError(
            "raster.instruction_set",
            f"This machine has no {instruction_set}.",
            f"Use auto, {', '.join(_kernels.instruction_sets())}.",
        )
    return _kernels.Renderer(instruction_set)


def available_threads() -> int:
    """Cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def rasterize(
    means: Tensor,
    tangents: Tensor,
    opacities: Tensor,
    colors: Tensor,
    camera: Camera,
    options: RasterOptions,
) -> RenderOutput:
    """As ``mass_engine.raster.rasterize``, in float32 and without background."""
    given = (means, tangents, opacities, colors, camera.world_to_camera, camera.K)
    tensors = [t.to(torch.float32).contiguous() for t in given]
    call = Call(camera.width, camera.height, options)
    rgb, alpha, depth, *more = call.run(*tensors)
    extras = Extras(*more) if more else None
    return RenderOutput(rgb, alpha, depth, call.dropped, extras)


class Call:
    """One forward pass: its arguments that are not tensors, its count of dropped surfels, its frame.

    ``frame`` (its profile, its memory) is set only with ``keep_frame``.
    """

    def __init__(
        self,
        width: int,
        height: int,
        options: RasterOptions,
        keep_frame: bool = False,
    ) -> None:
        self.renderer = shared_renderer(options.instruction_set)
        self.width, self.height = width, height
        self.options = options
        self.differentiable = False
        self.keep_frame = keep_frame
        self.frame: _kernels.Frame | None = None
        self.threads = options.threads or available_threads()
        self.without = sum(1 << OPTIMIZATIONS.index(name) for name in options.without)
        self.dropped = 0

    def run(self, *tensors: Tensor) -> tuple[Tensor, ...]:
        """Render float32, contiguous ``rasterize`` tensors and the camera's pose and K."""
        self.differentiable = torch.is_grad_enabled() and any(t.requires_grad for t in tensors)
        images: tuple[Tensor, ...] = _Rasterize.apply(self, *tensors)  # type: ignore[no-untyped-call]
        return images


def _camera_numbers(world_to_camera: Tensor, K: Tensor, options: RasterOptions) -> list[float]:
    pose: list[list[float]] = world_to_camera.tolist()
    k: list[list[float]] = K.tolist()
    rotation = [x for row in pose[:3] for x in row[:3]]
    translation = [row[3] for row in pose[:3]]
    return [
        *rotation,
        *translation,
        *k[0][:2],
        *k[1][:2],
        k[0][2],
        k[1][2],
        options.near_plane,
        options.distortion_scale,
    ]


def _empty(*shape: int) -> Tensor:
    return torch.empty(shape, dtype=torch.float32)


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, call: Call, *tensors: Tensor) -> tuple[Tensor, ...]:
        means, tangents, opacities, colors, pose, K = (t.detach() for t in tensors)
        H, W, options = call.height, call.width, call.options
        rgb, alpha, depth = _empty(H, W, 3), _empty(H, W), _empty(H, W)
        median = normal = distortion = weights = None
        if options.outputs == "all":
            median, normal, distortion = _empty(H, W), _empty(H, W, 3), _empty(H, W)
            weights = _empty(len(means))
        try:
            frame = call.renderer.forward(
                _camera_numbers(pose, K, options),
                W,
                H,
                options.cull_backfaces,
                get_args(Convention).index(options.convention),
                options.center_depth,
                call.without,
                means,
                tangents,
                opacities,
                colors,
                rgb,
                alpha,
                depth,
                median,
                normal,
                distortion,
                weights,
                call.differentiable,
                call.threads,
            )
        except _kernels.TooManyPairsError as error:
            raise EngineError(
                "raster.too_many_pairs",
                f"The scene needs {error}.",
                "Render smaller surfels or a smaller image.",
            ) from error
        call.dropped = frame.dropped
        if call.keep_frame:
            call.frame = frame
        if call.differentiable:
            ctx.call, ctx.frame = call, frame
            ctx.save_for_backward(*tensors, alpha, depth)
            ctx.set_materialize_grads(False)
            if weights is not None:
                ctx.mark_non_differentiable(weights)
        extras = (median, normal, distortion, weights)
        return (rgb, alpha, depth, *(t for t in extras if t is not None))

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        means, tangents, opacities, colors, pose, _, alpha, depth = (t.detach() for t in ctx.saved_tensors)
        call: Call = ctx.call
        images = [None if g is None else g.contiguous() for g in gradients[:6]]
        d_rgb, d_alpha, d_depth, d_median, d_normal, d_distortion = images + [None] * (6 - len(images))
        out = [torch.empty_like(t) for t in (means, tangents, opacities, colors)]
        d_means, d_tangents, d_opacities, d_colors = out
        d_camera = _empty(21)
        call.renderer.backward(
            ctx.frame,
            means,
            tangents,
            opacities,
            colors,
            alpha,
            depth,
            d_rgb,
            d_alpha,
            d_depth,
            d_median,
            d_normal,
            d_distortion,
            d_means,
            d_tangents,
            d_opacities,
            d_colors,
            d_camera,
            call.threads,
        )
        d_pose, d_K = d_camera.new_zeros(4, 4), d_camera.new_zeros(3, 3)
        # The camera's centre, from which harmonics are seen, is -A^T t.
        d_center = d_camera[18:21]
        d_pose[:3, :3] = d_camera[:9].view(3, 3) - torch.outer(pose[:3, 3], d_center)
        d_pose[:3, 3] = d_camera[9:12] - pose[:3, :3] @ d_center
        d_K[:2, :2] = d_camera[12:16].view(2, 2)
        d_K[:2, 2] = d_camera[16:18]
        return (None, *out, d_pose, d_K)
