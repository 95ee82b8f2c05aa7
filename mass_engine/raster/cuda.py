"""The GPU kernels behind an autograd function.

The same method as ``cpu``, from the same headers: a thread per surfel where surfels are projected, a block
per 16 x 16 tile and a thread per pixel where they are blended. Every sum has a fixed order, so the same step
gives the same bits.

Sizes are fixed before a step starts: a frame's memory is one tensor with room for ``pair_capacity`` pairs of
surfel and tile. Without ``RasterOptions.pair_capacity`` the pairs are counted on the GPU, the host waits for
the count, and a frame that needs more room is drawn again with more. With it nothing waits, so a step can be
captured in a CUDA graph; ``check_counters`` says afterwards whether the room was enough.
"""

from __future__ import annotations

import functools
from contextlib import AbstractContextManager, nullcontext
from typing import TYPE_CHECKING, Any, get_args

import torch
from torch import Tensor

from mass_engine.camera import Camera
from mass_engine.errors import BadArgumentError, EngineError
from mass_engine.raster.types import Convention, Extras, RasterOptions, RenderOutput

if TYPE_CHECKING:
    from mass_engine.raster import _cuda_kernels

#: Where a frame's counters say what went wrong (0: nothing), and what they say.
STATUS = 2
_OVERFLOW, _BAD_CAMERA = 1, 2
#: Room for more pairs than this cannot be asked for.
MOST_PAIRS = (1 << 31) - 1
# Room in the first frame: pairs a surfel, and pairs whatever the number of surfels.
_PAIRS_PER_SURFEL, _LEAST_PAIRS = 4, 1 << 16


class Backend:
    """The compiled module, and how much room frames have needed so far."""

    def __init__(self, kernels: Any) -> None:
        self.kernels = kernels
        self._room = 0

    def room(self, surfels: int) -> int:
        """Pairs to make room for when nobody says how many."""
        return max(self._room, _PAIRS_PER_SURFEL * surfels, _LEAST_PAIRS)

    def needed(self, pairs: int) -> None:
        """Remember a frame's pairs, with an eighth to spare."""
        self._room = max(self._room, min(pairs + pairs // 8, MOST_PAIRS))


def import_kernels() -> Any:
    """The compiled module. Raises ``EngineError`` ``device.unavailable``: no build, no driver or no GPU."""
    try:
        from mass_engine.raster import _cuda_kernels
    except ImportError as error:
        raise EngineError(
            "device.unavailable",
            f"There are no GPU kernels in this build ({error}).",
            "Build them with `make cuda`, or use the CPU.",
        ) from error
    problem = _cuda_kernels.problem()
    if problem:
        raise EngineError(
            "device.unavailable",
            f"No GPU can be used: {problem}.",
            "Check the machine's NVIDIA driver with nvidia-smi, or use the CPU.",
        )
    return _cuda_kernels


@functools.cache
def shared_backend() -> Backend:
    """The process's backend, made on first use. Raises as ``import_kernels``."""
    return Backend(import_kernels())


def check_counters(counters: Tensor) -> int:
    """Wait for a frame's ``counters`` [3]; the number of surfels dropped for bad numbers.

    Raises ``EngineError`` ``raster.too_many_pairs`` when the frame had more pairs of surfel and tile than
    room, ``BadArgumentError`` ``raster.camera`` when its camera was not finite.
    """
    dropped, pairs, status = counters.tolist()
    if status & _BAD_CAMERA:
        raise BadArgumentError(
            "raster.camera", "The camera holds NaN or infinity.", "Check K and world_to_camera."
        )
    if status & _OVERFLOW:
        raise EngineError(
            "raster.too_many_pairs",
            f"The scene needs {pairs} pairs of surfel and tile, more than there is room for.",
            "Raise pair_capacity, or render smaller surfels or a smaller image.",
        )
    return int(dropped)


def rasterize(
    means: Tensor,
    tangents: Tensor,
    opacities: Tensor,
    colors: Tensor,
    camera: Camera,
    options: RasterOptions,
    backend: Backend | None = None,
) -> RenderOutput:
    """As ``mass_engine.raster.rasterize``, in float32 and without background.

    The camera may be on the CPU. Raises as ``import_kernels`` and ``check_counters``.
    """
    given = (means, tangents, opacities, colors, camera.world_to_camera, camera.K)
    tensors = [t.to(means.device, torch.float32).contiguous() for t in given]
    call = Call(camera.width, camera.height, options, backend or shared_backend())
    rgb, alpha, depth, *more = call.run(*tensors)
    extras = Extras(*more) if more else None
    return RenderOutput(rgb, alpha, depth, call.dropped, extras, call.counters)


class Call:
    """One forward pass: its arguments that are not tensors; afterwards its plan, memory and counters.

    ``dropped`` is -1 when it has not been read: with ``pair_capacity`` the host does not wait for it.
    """

    def __init__(self, width: int, height: int, options: RasterOptions, backend: Backend) -> None:
        self.backend = backend
        self.width, self.height = width, height
        self.options = options
        self.differentiable = False
        self.dropped = -1
        self.pairs = -1
        self.counters: Tensor | None = None

    def run(self, *tensors: Tensor) -> tuple[Tensor, ...]:
        """Render float32, contiguous ``rasterize`` tensors and the camera's pose and K, all on one device."""
        self.differentiable = torch.is_grad_enabled() and any(t.requires_grad for t in tensors)
        images: tuple[Tensor, ...] = _Rasterize.apply(self, *tensors)  # type: ignore[no-untyped-call]
        return images

    def plan(self, surfels: int, capacity: int) -> _cuda_kernels.Plan:
        """Sizes and settings of a frame with room for ``capacity`` pairs."""
        options = self.options
        made: _cuda_kernels.Plan = self.backend.kernels.Plan(
            surfels,
            self.width,
            self.height,
            capacity,
            options.outputs == "all",
            self.differentiable,
            options.near_plane,
            options.distortion_scale,
            options.cull_backfaces,
            get_args(Convention).index(options.convention),
            options.center_depth,
        )
        return made


def _on(device: torch.device) -> AbstractContextManager[Any]:
    return torch.cuda.device(device) if device.type == "cuda" else nullcontext()


def _stream(device: torch.device) -> int:
    return torch.cuda.current_stream(device).cuda_stream if device.type == "cuda" else 0


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, call: Call, *tensors: Tensor) -> tuple[Tensor, ...]:
        given = tuple(t.detach() for t in tensors)
        device, surfels = given[0].device, len(given[0])
        H, W, options, backend = call.height, call.width, call.options, call.backend

        def empty(*shape: int) -> Tensor:
            return torch.empty(shape, dtype=torch.float32, device=device)

        images: list[Tensor] = [empty(H, W, 3), empty(H, W), empty(H, W)]
        extras: list[Tensor | None] = [None] * 4
        if options.outputs == "all":
            extras = [empty(H, W), empty(H, W, 3), empty(H, W), empty(surfels)]
        counters = torch.empty(3, dtype=torch.int32, device=device)
        fixed = options.pair_capacity is not None
        capacity = options.pair_capacity if options.pair_capacity is not None else backend.room(surfels)
        with _on(device):
            while True:
                plan = call.plan(surfels, capacity)
                memory = torch.empty(plan.bytes, dtype=torch.uint8, device=device)
                plan.forward(_stream(device), memory, counters, *given, *images, *extras)
                if fixed:
                    break
                _, call.pairs, status = counters.tolist()
                if not status & _OVERFLOW or call.pairs >= MOST_PAIRS:
                    call.dropped = check_counters(counters)
                    break
                backend.needed(call.pairs)
                capacity = backend.room(surfels)
        call.counters = counters
        if call.differentiable:
            ctx.plan, ctx.memory = plan, memory
            ctx.save_for_backward(*tensors, images[1], images[2])
            ctx.set_materialize_grads(False)
            if extras[3] is not None:
                ctx.mark_non_differentiable(extras[3])
        return (*images, *(t for t in extras if t is not None))

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        *given, alpha, depth = (t.detach() for t in ctx.saved_tensors)
        images = [None if g is None else g.contiguous() for g in gradients[:6]]
        images += [None] * (6 - len(images))
        out = [torch.empty_like(t) for t in given]
        device = given[0].device
        with _on(device):
            ctx.plan.backward(_stream(device), ctx.memory, *given, alpha, depth, *images, *out)
        return (None, *out)
