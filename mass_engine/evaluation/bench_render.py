"""``mass-engine bench render``: pose to pixels, milliseconds a picture on this machine."""

from __future__ import annotations

import argparse
import os
import platform
import statistics
import time
from collections.abc import Callable, Sequence

import torch

from mass_engine.camera import Camera
from mass_engine.fitting.subject import Appearance, Shape, pose_surfels, render_row
from mass_engine.hand.builtin import load_builtin
from mass_engine.hand.pose import HandPose
from mass_engine.hand.poses import named_pose
from mass_engine.raster import RasterOptions
from mass_engine.surfel.binding import MeshBinding
from mass_engine.surfel.shading import white_light

SIZES = ((256, 256), (512, 334), (512, 512), (1400, 1000))
MODELS = ((1, 0), (1, 1), (2, 1))


def run(argv: Sequence[str]) -> None:
    """Print a Markdown table of medians: posing and rasterising the built-in hand, three model sizes."""
    parser = argparse.ArgumentParser(prog="mass-engine bench render")
    parser.add_argument("--repeat", type=int, default=20)
    repeat: int = parser.parse_args(argv).repeat
    model = load_builtin("right")
    shape = Shape.mean(model, torch.zeros(10))
    fist = named_pose("point", "right")
    # Fingers up, back of the hand to the camera, filling the picture's height.
    orient = torch.tensor([1.2092, -1.2092, -1.2092])
    pose = HandPose(
        fist.betas[None], orient[None], fist.hand_pose[None], torch.tensor([[0.0, 0.08, 0.25]]), "right"
    )
    print(f"{platform.machine()}, {os.cpu_count()} cores, median of {repeat} (least to greatest), ms\n")
    print("| surfels | size | pose to surfels | pose to pixels | frames a second |")
    print("|---|---|---|---|---|")
    for levels, depth in MODELS:
        binding = MeshBinding.build(model, levels, depth)
        look = Appearance(
            torch.full((binding.count, 3), 0.6),
            torch.full((binding.count,), 3.0),
            torch.zeros(binding.count, 3, 3),
            white_light(),
        )
        for width, height in SIZES:
            camera = Camera.from_fov(width, height, 60.0)

            def posing(binding: MeshBinding = binding) -> None:
                with torch.no_grad():
                    pose_surfels(shape, binding, pose)

            def drawing(
                binding: MeshBinding = binding, look: Appearance = look, camera: Camera = camera
            ) -> None:
                with torch.no_grad():
                    surfels = pose_surfels(shape, binding, pose)
                    render_row(look, surfels, 0, binding.bones, camera, RasterOptions(cull_backfaces=True))

            first, _, _ = _times(posing, repeat)
            median, least, most = _times(drawing, repeat)
            print(
                f"| {binding.count} | {width}x{height} | {first:.1f} "
                f"| {median:.1f} ({least:.1f} to {most:.1f}) "
                f"| {1000 / median:.0f} |"
            )


def _times(action: Callable[[], None], repeat: int) -> tuple[float, float, float]:
    action()
    spent = []
    for _ in range(repeat):
        start = time.perf_counter()
        action()
        spent.append((time.perf_counter() - start) * 1000)
    return statistics.median(spent), min(spent), max(spent)
