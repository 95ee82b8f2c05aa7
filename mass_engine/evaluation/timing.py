"""Interleaved timings of rasteriser calls: medians and quartiles in milliseconds."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from mass_engine.camera import Camera
from mass_engine.evaluation.raster_scene import Scene
from mass_engine.raster import RasterOptions, RenderOutput, rasterize

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
    return {name: summary(t) for name, t in times.items()}


def summary(times: list[float]) -> Timing:
    """Of ``times`` in milliseconds, two or more."""
    quartiles = statistics.quantiles(times, n=4)
    return Timing(statistics.median(times), (quartiles[0], quartiles[2]), len(times))
