"""`mass-engine bench raster --device cuda`: the CPU's table on a GPU, gsplat beside it, memory, the floor.

Times are between CUDA events on the GPU. "graph" is the same step captured once and replayed: what it costs
when the host adds nothing. gsplat's 2DGS rasteriser runs the same scenes in the same run when it is
installed.
"""

from __future__ import annotations

import importlib.util
import statistics
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from mass_engine.camera import Camera
from mass_engine.errors import EngineError
from mass_engine.evaluation.raster_profile import INSTRUCTIONS, evaluations
from mass_engine.evaluation.raster_scene import Scene
from mass_engine.evaluation.timing import Timing, forward_step, summary, training_step
from mass_engine.raster import RasterOptions, cuda
from mass_engine.surfel.inellipse import principal_scales_quats

Run = Callable[[], object]

#: Bytes a surfel brings in, its splat, box, key and index, as they are written and read.
_SURFEL_BYTES = 52 + 2 * (64 + 8 + 4 + 4)
#: Four passes of a radix sort over (depth, index): read and written.
_DEPTH_SORT_BYTES = 4 * 2 * 8
#: A pair: written once, sorted by tile in two passes, its splat read once.
_PAIR_BYTES = 8 + 2 * 2 * 8 + 64
#: A pair's sums of the backward pass, written and read, and its splat once more.
_PAIR_BYTES_BACKWARD = 2 * 64 + 64
_LANES_PER_MULTIPROCESSOR = 128


@dataclass(frozen=True)
class Figure:
    timing: Timing
    peak_bytes: int  # above what the scene itself takes


def require() -> torch.device:
    """The GPU. Raises ``EngineError`` ``device.unavailable`` that says what is missing."""
    cuda.import_kernels()
    if not torch.cuda.is_available():
        raise EngineError(
            "device.unavailable",
            f"This PyTorch ({torch.__version__}) cannot use a GPU.",
            "Install a build of PyTorch with CUDA.",
        )
    return torch.device("cuda")


def captured(step: Run) -> Run:
    """The step as one CUDA graph."""
    side = torch.cuda.Stream()
    side.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(side):
        for _ in range(3):
            step()
    torch.cuda.current_stream().wait_stream(side)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        step()
    return graph.replay


def measure(steps: dict[str, Run], seconds: float, most: int = 200) -> dict[str, Figure]:
    """Interleave the steps until each had its share of ``seconds`` (at least 5 runs after 3 to warm up)."""
    peaks: dict[str, int] = {}
    for name, step in steps.items():
        for _ in range(3):
            step()
        torch.cuda.synchronize()
        before = torch.cuda.memory_allocated()
        torch.cuda.reset_peak_memory_stats()
        step()
        torch.cuda.synchronize()
        peaks[name] = torch.cuda.max_memory_allocated() - before
    times: dict[str, list[float]] = {name: [] for name in steps}
    while True:
        due = [n for n, t in times.items() if len(t) < 5 or (sum(t) < 1e3 * seconds and len(t) < most)]
        if not due:
            return {name: Figure(summary(t), peaks[name]) for name, t in times.items()}
        for name in due:
            start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
            start.record()
            steps[name]()
            end.record()
            end.synchronize()
            times[name].append(start.elapsed_time(end))


def variants(scene: Scene, camera: Camera) -> tuple[dict[str, Run], int]:
    """What to time, and the pairs of surfel and tile. The room is fixed, so that no step waits."""
    call = cuda.Call(camera.width, camera.height, RasterOptions(), cuda.shared_backend())
    with torch.no_grad():
        call.run(*scene.tensors(), camera.world_to_camera, camera.K)
    color = RasterOptions(pair_capacity=call.pairs + call.pairs // 8)
    everything = RasterOptions(outputs="all", pair_capacity=color.pair_capacity)
    culled = RasterOptions(cull_backfaces=True, pair_capacity=color.pair_capacity)
    steps: dict[str, Run] = {
        "forward": forward_step(scene, camera, color),
        "forward culled": forward_step(scene, camera, culled),
        "forward all": forward_step(scene, camera, everything),
        "fwd+bwd": training_step(scene, camera, color),
        "fwd+bwd all": training_step(scene, camera, everything),
    }
    for name in ("forward", "fwd+bwd all"):
        steps[f"{name}, graph"] = captured(steps[name])
    return steps, call.pairs


def gsplat_variants(scene: Scene, camera: Camera) -> dict[str, Run]:
    """gsplat's 2DGS on the same surfels; nothing when it is not installed.

    With every output its forward pass also takes normals from its depth map, which nobody asks for here.
    """
    if importlib.util.find_spec("gsplat") is None:
        return {}
    from gsplat import rasterization_2dgs

    scales, quats = principal_scales_quats(*scene.tangents.unbind(1))
    given = (scene.means, quats, torch.cat([scales, torch.ones_like(scales[:, :1])], -1), scene.opacities)
    leaves = [t.detach().clone().requires_grad_() for t in (*given, scene.colors)]
    view, K = camera.world_to_camera[None], camera.K[None]
    size = {"width": camera.width, "height": camera.height}

    def draw(tensors: list[Tensor], everything: bool) -> list[Tensor]:
        mode = "RGB+ED" if everything else "RGB"
        out = rasterization_2dgs(
            *tensors, viewmats=view, Ks=K, render_mode=mode, distloss=everything, packed=False, **size
        )
        colors, alphas, normals, _, distortion, median, _ = out
        images = [colors, alphas, *((normals, distortion, median) if everything else ())]
        return [
            t for t in images if isinstance(t, Tensor) and (t.requires_grad or not torch.is_grad_enabled())
        ]

    def forward(everything: bool) -> Run:
        def step() -> None:
            with torch.no_grad():
                draw(leaves, everything)

        return step

    def training(everything: bool) -> Run:
        def step() -> None:
            images = draw(leaves, everything)
            ones = [torch.ones_like(i) / i.numel() for i in images]
            torch.autograd.grad(images, leaves, ones, allow_unused=True)

        return step

    return {
        "gsplat forward": forward(False),
        "gsplat forward all": forward(True),
        "gsplat fwd+bwd": training(False),
        "gsplat fwd+bwd all": training(True),
    }


def copy_bandwidth() -> float:
    """Bytes a second that the GPU moves from one large array to another, read and write counted."""
    source = torch.zeros(64 << 20, device="cuda")
    target = torch.empty_like(source)
    times: list[float] = []
    for _ in range(10):
        start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
        start.record()
        target.copy_(source)
        end.record()
        end.synchronize()
        times.append(1e-3 * start.elapsed_time(end))
    return 2 * source.numel() * 4 / statistics.median(times)


def floor(scene: Scene, camera: Camera, pairs: int) -> str:
    """The least the steps could take on this GPU: bytes over bandwidth, instructions over their rate.

    The instructions are those of evaluating 4 x 4 blocks, counted by the CPU's kernels on the same scene.
    """
    count, pixels = len(scene.means), camera.width * camera.height
    bandwidth = copy_bandwidth()
    forward = count * (_SURFEL_BYTES + _DEPTH_SORT_BYTES) + pairs * _PAIR_BYTES + pixels * 5 * 4
    backward = pairs * _PAIR_BYTES_BACKWARD + count * 2 * 52 + pixels * 7 * 4
    lines = [
        f"Memory floor at {bandwidth / 1e9:.0f} GB/s (measured by a copy): forward "
        f"{1e3 * forward / bandwidth:.3f} ms, backward {1e3 * backward / bandwidth:.3f} ms."
    ]
    properties = torch.cuda.get_device_properties(0)
    clock = 1e3 * getattr(properties, "clock_rate", 0)
    blocks = evaluations(scene, camera)
    for name, (low, high) in INSTRUCTIONS.items():
        least, most = (16 * blocks[name] * n for n in (low, high))
        text = f"Arithmetic of the {name} blending: {least / 1e9:.3f} to {most / 1e9:.3f} G lane instructions"
        if clock:
            rate = properties.multi_processor_count * _LANES_PER_MULTIPROCESSOR * clock
            text += (
                f", at {rate / 1e12:.1f} T a second {1e3 * least / rate:.3f} to {1e3 * most / rate:.3f} ms"
            )
        lines.append(text + ".")
    return "\n".join(lines) + "\n"
