"""Where the rasteriser's time goes, how far that is from the floor, and what each optimisation is worth."""

from __future__ import annotations

import statistics
import time
from dataclasses import replace

import torch

from mass_engine.camera import Camera
from mass_engine.evaluation.raster_scene import Scene
from mass_engine.evaluation.timing import Step, Timing, forward_step, training_step
from mass_engine.raster import RasterOptions
from mass_engine.raster._kernels import instruction_sets
from mass_engine.raster.cpu import Call
from mass_engine.raster.types import OPTIMIZATIONS

_REPETITIONS = 15
#: 512-bit instructions of one (surfel, block) evaluation, counted in the loops g++ 12 makes: the low-pass
#: part alone, the whole. Colour, alpha and depth; the sum over lanes, once a pair, is not in it.
INSTRUCTIONS = {"forward": (42, 63), "backward": (57, 110)}
#: Bytes a surfel brings in (mean, tangents, opacity, colour) and its splat, box and key.
_INPUT_BYTES, _SPLAT_BYTES = 52, 64 + 8 + 4
#: Bytes a pair of surfel and tile takes while it is listed and sorted: written, read and moved once.
_PAIR_BYTES = 8 * 3 + 4


def ablations(scene: Scene, camera: Camera, threads: int) -> dict[str, Step]:
    """Forward (culled, colour) and training (all outputs) with one thing left out at a time."""
    base = RasterOptions(cull_backfaces=True, threads=threads)
    variants = {"everything on": base, "without backface culling": replace(base, cull_backfaces=False)}
    for optimization in OPTIMIZATIONS:
        variants[f"without {optimization}"] = replace(base, without=frozenset({optimization}))
    if threads > 1:
        variants["one thread"] = replace(base, threads=1)
    for instructions in instruction_sets()[1:]:
        variants[instructions] = replace(base, instruction_set=instructions)  # type: ignore[arg-type]
    steps: dict[str, Step] = {}
    for name, options in variants.items():
        steps[f"forward, {name}"] = forward_step(scene, camera, options)
        steps[f"training, {name}"] = training_step(scene, camera, replace(options, outputs="all"))
    return steps


def ablation_table(timings: dict[str, Timing]) -> str:
    """Markdown of what ``ablations`` took; the ratio is to everything on."""
    lines = ["| | forward ms | ratio | forward + backward, all ms | ratio |", "|---|---|---|---|---|"]
    names = [name.removeprefix("forward, ") for name in timings if name.startswith("forward, ")]
    for name in names:
        cells = []
        for kind in ("forward", "training"):
            timing, base = timings[f"{kind}, {name}"], timings[f"{kind}, everything on"]
            cells.append(f"{timing} | {timing.median / base.median:.2f}")
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def copy_bandwidth() -> float:
    """Bytes a second that torch moves from one large array to another, read and write counted."""
    source = torch.zeros(32 << 20)
    target = torch.empty_like(source)
    times = []
    for _ in range(7):
        start = time.perf_counter()
        target.copy_(source)
        times.append(time.perf_counter() - start)
    return 2 * source.numel() * 4 / statistics.median(times)


def evaluations(scene: Scene, camera: Camera) -> dict[str, float]:
    """(Surfel, 4 x 4 block) evaluations of the forward and of the backward pass, counted on the CPU."""
    tensors = [t.detach().cpu() for t in (*scene.tensors(), camera.world_to_camera, camera.K)]
    leaves = [t.requires_grad_() for t in tensors]
    call = Call(camera.width, camera.height, RasterOptions(), keep_frame=True)
    images = call.run(*leaves)
    torch.autograd.grad(images, leaves, [torch.ones_like(image) for image in images])
    assert call.frame is not None
    profile = call.frame.profile
    return {"forward": profile["blocks"], "backward": profile["blocks_backward"]}


def report(scene: Scene, camera: Camera, threads: int) -> str:
    """Markdown: milliseconds of each pass, the work done, and the floor by memory and by instructions."""
    options = RasterOptions(cull_backfaces=True, threads=threads)
    tensors = [*scene.tensors(), camera.world_to_camera, camera.K]
    leaves = [t.clone().requires_grad_() for t in tensors]
    profiles: list[dict[str, float]] = []
    for _ in range(_REPETITIONS):
        call = Call(camera.width, camera.height, options, keep_frame=True)
        images = call.run(*leaves)
        torch.autograd.grad(images, leaves, [torch.ones_like(image) for image in images])
        assert call.frame is not None
        memory, pairs = call.frame.bytes, call.frame.pairs
        profiles.append(call.frame.profile)
    median = {name: statistics.median(p[name] for p in profiles) for name in profiles[0]}
    count, pixels = len(scene.means), camera.width * camera.height
    moved = count * (_INPUT_BYTES + 2 * _SPLAT_BYTES) + pairs * _PAIR_BYTES + pixels * 5 * 4
    bandwidth = copy_bandwidth()
    lines = [
        f"{count} surfels, {camera.width}x{camera.height}, culled: {pairs} pairs of surfel and tile, "
        f"{median['blocks']:.0f} evaluations of a 4x4 block ({16 * median['blocks'] / pixels:.1f} a pixel), "
        f"{memory >> 20} MiB of buffers",
        "",
        "| pass | ms |",
        "|---|---|",
    ]
    passes = {"project": "project", "list": "list tiles", "blend": "sort and blend"}
    passes |= {"blend_backward": "blend, backward", "project_backward": "project, backward"}
    lines += [f"| {text} | {1e3 * median[name]:.2f} |" for name, text in passes.items()]
    lines += [
        "",
        f"Sorting is {1e3 * median['sort']:.2f} ms of core time. Per evaluation and core: forward "
        f"{_per_block(median['blend'] * threads - median['sort'], median['blocks']):.1f} ns, backward "
        f"{_per_block(median['blend_backward'] * threads, median['blocks_backward']):.1f} ns.",
        f"Memory floor of the forward pass: {moved / 1e6:.1f} MB at {bandwidth / 1e9:.1f} GB/s is "
        f"{1e3 * moved / bandwidth:.2f} ms.",
    ]
    for name, blocks in (("forward", median["blocks"]), ("backward", median["blocks_backward"])):
        low, high = (blocks * n / threads / 1e9 for n in INSTRUCTIONS[name])
        lines.append(
            f"Instructions of the {name} blending: {low:.4f} to {high:.4f} G vector instructions a core; at "
            f"5.2 G a second (two a cycle at 2.6 GHz) {1e3 * low / 5.2:.2f} to {1e3 * high / 5.2:.2f} ms."
        )
    return "\n".join(lines) + "\n"


def _per_block(seconds: float, blocks: float) -> float:
    return 1e9 * seconds / max(blocks, 1.0)
