"""`mass-engine bench raster`: how fast the rasteriser is, next to its yardsticks, measured in one run.

The scene is the built-in hand in a pose, its surface covered by two layers of surfels as an avatar's
attached and detached ones lie. Times are medians of interleaved repetitions with their quartiles.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from mass_engine.camera import Camera
from mass_engine.hand.builtin import load_builtin
from mass_engine.hand.pose import HandPose
from mass_engine.hand.poses import named_pose
from mass_engine.raster import RasterOptions, RenderOutput, rasterize
from mass_engine.raster import cpu as cpu_backend
from mass_engine.raster._kernels import instruction_sets
from mass_engine.surfel.binding import MeshBinding

SIZES = ((256, 256), (512, 334), (700, 500), (1400, 1000))
#: The paper's counts: 1538 faces, one or two Loop levels, two layers, with and without densification.
COUNTS = (12_304, 49_216, 196_864)


@dataclass(frozen=True)
class Scene:
    """The tensors ``rasterize`` takes, in its order."""

    means: Tensor
    tangents: Tensor
    opacities: Tensor
    colors: Tensor

    def tensors(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        return self.means, self.tangents, self.opacities, self.colors


def hand_scene(count: int, pose_name: str = "point", seed: int = 0) -> Scene:
    """``count`` surfels in two layers on the posed hand, back of the hand towards -z, fingers up.

    Each layer takes the surfels of an even choice of the refined mesh's faces, widened so that together they
    have the area of all. The second layer lies up to 0.5 mm off and is a little tilted, as detached surfels
    are.
    """
    generator = torch.Generator().manual_seed(seed)
    model = load_builtin("right")
    named = named_pose(pose_name, "right")
    # Fingers up, back of the hand to the camera.
    orient = torch.tensor([[1.2092, -1.2092, -1.2092]])
    pose = HandPose(named.betas[None], orient, named.hand_pose[None], torch.zeros(1, 3), "right")
    vertices = model.posed(pose).vertices[0]
    half = count // 2
    levels = next(level for level in range(4) if len(model.faces) * 4**level >= count - half)
    surfels = MeshBinding.build(model, levels, 0).surfels(vertices)
    parts = []
    for layer, size in enumerate((half, count - half)):
        every = len(surfels.means)
        chosen = torch.randperm(every, generator=generator)[:size].sort().values
        means, tangents, normals = (t[chosen] for t in (surfels.means, surfels.tangents, surfels.normals))
        tangents = tangents * (every / size) ** 0.5
        if layer == 1:
            means = means + 0.0005 * (torch.rand(size, 1, generator=generator) - 0.5) * normals
            slope = 0.3 * (torch.rand(size, 2, 1, generator=generator) - 0.5)
            tangents = tangents + slope * tangents.norm(dim=-1, keepdim=True) * normals[:, None]
        parts.append((means, tangents))
    means, tangents = (torch.cat(x) for x in zip(*parts, strict=True))
    colors = torch.tensor([0.8, 0.6, 0.5]) * (0.6 + 0.4 * torch.rand(count, 3, generator=generator))
    return Scene(means, tangents, 0.5 + 0.49 * torch.rand(count, generator=generator), colors)


def hand_camera(scene: Scene, width: int, height: int) -> Camera:
    """Half a metre in front of the hand, which fills nine tenths of the picture."""
    low, high = scene.means.amin(0), scene.means.amax(0)
    center, size = (low + high) / 2, high - low
    distance = 0.5
    focal = 0.9 * distance * min(width / float(size[0]), height / float(size[1]))
    K = torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
    pose = torch.eye(4)
    pose[:3, 3] = torch.tensor([0.0, 0.0, distance]) - center
    return Camera(K, pose, width, height)


Step = Callable[[], RenderOutput]


def forward_step(scene: Scene, camera: Camera, options: RasterOptions) -> Step:
    """One forward pass as a function."""

    def step() -> RenderOutput:
        with torch.no_grad():
            return rasterize(*scene.tensors(), camera, options=options)

    return step


def training_step(scene: Scene, camera: Camera, options: RasterOptions) -> Step:
    """Forward and backward: a gradient into every output, and out of every surfel input and the pose."""
    leaves = [t.clone().requires_grad_() for t in scene.tensors()]
    learned = Scene(*leaves)
    pose = camera.world_to_camera.clone().requires_grad_()
    camera = Camera(camera.K, pose, camera.width, camera.height)
    gradients: list[Tensor] = []

    def step() -> RenderOutput:
        out = rasterize(*learned.tensors(), camera, options=options)
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
        options = replace(color, instruction_set=name, threads=1 if name == "scalar" else args.threads)
        label = name + (" 1 thread" if name == "scalar" else "")
        steps[f"forward {label}"] = forward_step(scene, camera, options)
        steps[f"fwd+bwd all {label}"] = training_step(scene, camera, replace(options, outputs="all"))
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
            camera = hand_camera(scene, width, height)
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
