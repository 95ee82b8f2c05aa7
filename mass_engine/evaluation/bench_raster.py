"""`mass-engine bench raster`: how fast the rasteriser is, next to its yardsticks, measured in one run.

The scene is a hand-shaped closed surface (a palm and five fingers, rounded cones) covered by two layers of
surfels that overlap as an avatar's do, seen so that it fills about a third of the image. Times are medians of
interleaved repetitions with their quartiles.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from mass_engine.camera import Camera
from mass_engine.raster import RasterOptions, RenderOutput, rasterize
from mass_engine.raster import cpu as cpu_backend
from mass_engine.raster._kernels import Renderer, instruction_sets

SIZES = ((256, 256), (512, 334), (700, 500), (1400, 1000))
COUNTS = (12_304, 49_216, 196_864)

# Rounded cones of a right hand in metres: start, end, radius at both. Palm first.
_LIMBS = (
    ((-0.028, 0.040, 0.0), (-0.030, -0.035, 0.0), 0.020, 0.017),
    ((0.000, 0.040, 0.0), (0.000, -0.040, 0.0), 0.020, 0.017),
    ((0.026, 0.035, 0.0), (0.030, -0.032, 0.0), 0.019, 0.015),
    ((-0.032, -0.035, 0.0), (-0.044, -0.115, -0.01), 0.011, 0.007),
    ((-0.010, -0.040, 0.0), (-0.012, -0.130, -0.01), 0.011, 0.007),
    ((0.012, -0.040, 0.0), (0.016, -0.122, -0.01), 0.011, 0.007),
    ((0.032, -0.032, 0.0), (0.044, -0.095, -0.01), 0.010, 0.006),
    ((-0.035, 0.025, -0.005), (-0.085, -0.030, -0.02), 0.014, 0.009),
)


@dataclass(frozen=True)
class Scene:
    """The tensors ``rasterize`` takes, in its order."""

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    colors: Tensor

    def tensors(self) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        return self.means, self.quats, self.scales, self.opacities, self.colors


def _spread(area: Tensor, count: int) -> tuple[Tensor, Tensor, Tensor]:
    """``count`` points over limbs by ``area``: limb, position along it and around it (0..1), each [count]."""
    edges = (area.cumsum(0) / area.sum() * count).round().long()
    sizes = torch.diff(edges, prepend=torch.zeros(1, dtype=torch.long))
    limb = torch.repeat_interleave(torch.arange(len(area)), sizes)
    rank = torch.cat([torch.arange(int(n)) for n in sizes])
    golden = 0.5 * (math.sqrt(5.0) - 1.0)
    return limb, (rank + 0.5) / sizes[limb], (rank.double() * golden).remainder(1.0).float()


def hand_scene(count: int, seed: int = 0) -> Scene:
    """``count`` surfels in two layers on the closed surface: normals outwards, scales from the spacing."""
    generator = torch.Generator().manual_seed(seed)

    def rand(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator)

    starts, ends = (torch.tensor([limb[i] for limb in _LIMBS]) for i in (0, 1))
    radii = torch.tensor([[limb[2], limb[3]] for limb in _LIMBS])
    lengths = (ends - starts).norm(dim=-1)
    area = 2 * math.pi * radii.mean(-1) * (lengths + 2 * radii.mean(-1))
    # Each layer is spread evenly (a golden-ratio lattice over each limb), in order along the limb.
    layers = [_spread(area, count // 2), _spread(area, count - count // 2)]
    limb, u, v = (torch.cat(parts) for parts in zip(*layers, strict=True))
    axis = ((ends - starts) / lengths[:, None])[limb]
    radius, length = radii[limb], lengths[limb]
    # Along the axis from cap to cap; the radius closes like a sphere's beyond the ends.
    along = u * (length + radius.sum(-1)) - radius[:, 0]
    t = (along / length).clamp(0, 1)
    base = radius[:, 0] + t * (radius[:, 1] - radius[:, 0])
    beyond = (along - along.clamp(min=0.0).minimum(length)).clamp(-1, 1)
    ring = (base**2 - beyond**2).clamp(min=1e-10).sqrt()
    side = torch.linalg.cross(axis, torch.tensor([0.0, 0.0, 1.0]).expand(count, 3))
    side = side / side.norm(dim=-1, keepdim=True)
    angle = (v + 0.1 * rand(count)) * 2 * math.pi
    radial = side * angle.cos()[:, None] + torch.linalg.cross(axis, side) * angle.sin()[:, None]
    normal = (radial * ring[:, None] + axis * beyond[:, None]) / base[:, None]
    normal = normal / normal.norm(dim=-1, keepdim=True)
    layer = 0.0003 * (rand(count) - 0.5)
    means = starts[limb] + axis * along[:, None] + radial * ring[:, None] + normal * layer[:, None]

    # Rotation from z to the normal, then a random turn about it.
    half = torch.cat([1 + normal[:, 2:], -normal[:, 1:2], normal[:, :1], torch.zeros(count, 1)], -1)
    half = half + 1e-6 * torch.tensor([0.0, 1.0, 0.0, 0.0])
    half = half / half.norm(dim=-1, keepdim=True)
    turn = rand(count) * math.pi
    c, s = turn.cos(), turn.sin()
    w, x, y, _ = half.unbind(-1)
    quats = torch.stack([w * c, x * c + y * s, y * c - x * s, w * s], -1)
    spacing = math.sqrt(float(area.sum()) / (count / 2) * 0.6 / math.pi)
    scales = 0.7 * spacing * (0.7 + 0.6 * rand(count, 2))
    colors = torch.tensor([0.8, 0.6, 0.5]) * (0.6 + 0.4 * rand(count, 3))
    return Scene(means, quats, scales, 0.5 + 0.49 * rand(count), colors)


def hand_camera(width: int, height: int) -> Camera:
    """Half a metre away; the hand fills the shorter image side."""
    focal = 0.5 / 0.2 * min(width, height)
    K = torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
    pose = torch.eye(4)
    pose[:3, 3] = torch.tensor([0.012, 0.035, 0.5])
    return Camera(K, pose, width, height)


Step = Callable[[], RenderOutput]


def forward_step(
    scene: Scene, camera: Camera, options: RasterOptions, renderer: Renderer | None = None
) -> Step:
    """One forward pass as a function; ``renderer`` None takes the public way in."""

    def step() -> RenderOutput:
        with torch.no_grad():
            if renderer is None:
                return rasterize(*scene.tensors(), camera, options=options)
            return cpu_backend.rasterize(*scene.tensors(), camera, options, renderer)

    return step


def training_step(
    scene: Scene, camera: Camera, options: RasterOptions, renderer: Renderer | None = None
) -> Step:
    """Forward and backward: a gradient into every output, and out of every surfel input and the pose."""
    leaves = [t.clone().requires_grad_() for t in scene.tensors()]
    learned = Scene(*leaves)
    pose = camera.world_to_camera.clone().requires_grad_()
    camera = Camera(camera.K, pose, camera.width, camera.height)
    gradients: list[Tensor] = []

    def step() -> RenderOutput:
        if renderer is None:
            out = rasterize(*learned.tensors(), camera, options=options)
        else:
            out = cpu_backend.rasterize(*learned.tensors(), camera, options, renderer)
        images = [out.rgb, out.alpha, out.depth]
        if out.extras is not None:
            images += [out.median_depth, out.normal, out.distortion]
        if not gradients:
            gradients.extend(torch.ones_like(i) / i.numel() for i in images)
        torch.autograd.grad(images, [*leaves, pose], gradients)
        return out

    return step


@dataclass(frozen=True)
class Timing:
    median: float  # milliseconds
    quartiles: tuple[float, float]
    repetitions: int

    def __str__(self) -> str:
        return f"{self.median:.2f} [{self.quartiles[0]:.2f}, {self.quartiles[1]:.2f}]"


def measure(steps: dict[str, Step], seconds: float, most: int = 60) -> dict[str, Timing]:
    """Interleave the steps until each had its share of ``seconds`` (at least 3 runs after one to warm up)."""
    for step in steps.values():
        step()
    times: dict[str, list[float]] = {name: [] for name in steps}
    spent = dict.fromkeys(steps, 0.0)
    while True:
        due = [n for n in steps if len(times[n]) < 3 or (spent[n] < seconds and len(times[n]) < most)]
        if not due:
            break
        for name in due:
            start = time.perf_counter()
            steps[name]()
            taken = time.perf_counter() - start
            times[name].append(1e3 * taken)
            spent[name] += taken
    return {name: _summary(t) for name, t in times.items()}


def _summary(times: list[float]) -> Timing:
    quartiles = statistics.quantiles(times, n=4)
    return Timing(statistics.median(times), (quartiles[0], quartiles[2]), len(times))


def _variants(scene: Scene, camera: Camera, args: argparse.Namespace) -> dict[str, Step]:
    color, everything = (
        RasterOptions(threads=args.threads),
        RasterOptions(outputs="all", threads=args.threads),
    )
    culled = RasterOptions(cull_backfaces=True, threads=args.threads)
    steps = {
        "forward": forward_step(scene, camera, color),
        "forward culled": forward_step(scene, camera, culled),
        "forward all": forward_step(scene, camera, everything),
        "fwd+bwd": training_step(scene, camera, color),
        "fwd+bwd all": training_step(scene, camera, everything),
    }
    for name in args.instruction_sets:
        options = RasterOptions(threads=1 if name == "scalar" else args.threads)
        label = f"forward {name}" + (" 1 thread" if name == "scalar" else "")
        steps[label] = forward_step(scene, camera, options, Renderer(name))
        steps[label.replace("forward", "fwd+bwd")] = training_step(scene, camera, options, Renderer(name))
    return steps


def run(argv: Sequence[str]) -> int:
    """Entry point; prints a Markdown table and, with ``--out``, writes the figures as JSON."""
    parser = argparse.ArgumentParser(prog="mass-engine bench raster", description=__doc__)
    parser.add_argument("--counts", type=int, nargs="+", default=list(COUNTS), metavar="N")
    parser.add_argument("--sizes", nargs="+", default=[f"{w}x{h}" for w, h in SIZES], metavar="WxH")
    parser.add_argument("--seconds", type=float, default=1.0, help="time per figure")
    parser.add_argument("--threads", type=int, default=None)
    parser.add_argument("--instruction-sets", nargs="*", default=["scalar"], choices=instruction_sets())
    parser.add_argument("--reference", action="store_true", help="also time the torch reference (minutes)")
    parser.add_argument("--out", type=Path, default=None, help="JSON file")
    args = parser.parse_args(argv)

    rows: list[dict[str, object]] = []
    threads = args.threads or cpu_backend.available_threads()
    print(f"{cpu_backend.shared_renderer().instruction_set}, {threads} threads; median ms [quartiles]")
    for count in args.counts:
        scene = hand_scene(count)
        for size in args.sizes:
            width, height = (int(x) for x in size.split("x"))
            camera = hand_camera(width, height)
            steps = _variants(scene, camera, args)
            timings = measure(steps, args.seconds)
            if args.reference:
                slow = RasterOptions(backend="reference")
                timings |= measure({"forward reference": forward_step(scene, camera, slow)}, 0.0)
            if not rows:
                names = list(timings)
                print("| surfels | size | " + " | ".join(names) + " |")
                print("|---" * (len(names) + 2) + "|")
            print(f"| {count} | {size} | " + " | ".join(str(timings[n]) for n in names) + " |", flush=True)
            for name, timing in timings.items():
                rows.append(
                    {
                        "surfels": count,
                        "size": size,
                        "what": name,
                        "median_ms": timing.median,
                        "quartiles_ms": timing.quartiles,
                        "repetitions": timing.repetitions,
                    }
                )
    if args.out:
        text = json.dumps({"threads": threads, "torch": torch.__version__, "rows": rows}, indent=1)
        args.out.write_text(text + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(run(sys.argv[1:]))
