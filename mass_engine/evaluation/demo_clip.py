"""A clip of our own: the built-in hand, textured and moving over a cluttered background.

``python -m mass_engine.evaluation.demo_clip OUT.mp4`` writes it. The hand differs from the mean hand that
a fit starts from, and its skin comes from noise, so that a fit has something to find.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mass_engine.camera import Camera
from mass_engine.fitting.subject import Appearance, Shape, pose_surfels, render_row
from mass_engine.hand.builtin import load_builtin
from mass_engine.hand.model import HandModel
from mass_engine.hand.pose import HandPose
from mass_engine.hand.poses import named_pose
from mass_engine.raster import RasterOptions
from mass_engine.surfel.binding import MeshBinding
from mass_engine.video.writer import write_video

#: Hand shape of the clip, in standard deviations of the ten shape parameters.
BETAS = (0.6, -0.5, 0.4, 0.5, -0.4, 0.3, -0.5, 0.2, -0.3, 0.4)


@dataclass(frozen=True)
class ClipOptions:
    """Size in pixels, frames a second, seconds, and the seed of texture and background."""

    width: int = 640
    height: int = 480
    fps: int = 30
    seconds: float = 4.0
    seed: int = 0


def demo_frames(options: ClipOptions | None = None) -> Iterator[NDArray[np.uint8]]:
    """Frames uint8 [H,W,3] of the clip."""
    o = options or ClipOptions()
    random = np.random.default_rng(o.seed)
    model = load_builtin("right")
    shape = Shape.mean(model, torch.tensor(BETAS))
    binding = MeshBinding.build(model, 1, 1)
    rest = pose_surfels(shape, binding, _batch(HandPose.rest("right"), shape.betas))
    light = torch.zeros(9, 3)
    # Light from above and a little from the left; x right, y down, z away from the camera.
    light[0], light[1], light[2], light[3] = 0.82, -0.22, -0.20, -0.08
    look = Appearance(
        _skin(rest.attached.means[0], rest.attached.normals[0], random),
        torch.full((binding.count,), 4.0),
        torch.zeros(binding.count, 0, 3),
        light,
    )
    camera = Camera.from_fov(o.width, o.height, 55.0)
    table = background(o.width, o.height, random)
    count = max(2, round(o.seconds * o.fps))
    for number in range(count):
        pose = motion(number / count, model, shape.betas)
        out = render_row(look, pose_surfels(shape, binding, pose), 0, binding.bones, camera, RasterOptions())
        alpha = out.alpha.unsqueeze(-1).numpy()
        picture = out.rgb.numpy() + (1 - alpha) * table
        noisy = picture + random.normal(0, 0.006, picture.shape)
        yield (np.clip(noisy, 0, 1) * 255).round().astype(np.uint8)


def _batch(pose: HandPose, betas: Tensor) -> HandPose:
    return HandPose(betas[None], pose.global_orient[None], pose.hand_pose[None], pose.transl[None], pose.side)


def motion(phase: float, model: HandModel, betas: Tensor) -> HandPose:
    """A pose (a batch of one) of a right hand with ``betas`` [10], at ``phase`` 0..1 of a loop: an upright
    hand that sways, opens, counts and closes."""
    stops = ("spread", "rest", "point", "fist", "pinch", "spread")
    place = phase * (len(stops) - 1)
    first, mix = int(place), place - int(place)
    mix = mix * mix * (3 - 2 * mix)
    a, b = (named_pose(stops[i], "right").hand_pose for i in (first, min(first + 1, len(stops) - 1)))
    turn = 2 * math.pi * phase
    # Fingers up (rest points along -x), back of the hand (+y) to the camera, swaying about both axes.
    upright = _rotation([0, 0, 1], math.pi / 2) @ _rotation([1, 0, 0], 0.0)
    facing = _rotation([0, 1, 0], math.pi / 2)
    sway = _rotation([0, 1, 0], 0.5 * math.sin(turn)) @ _rotation([1, 0, 0], 0.35 * math.sin(2 * turn + 1))
    orient, _ = cv2.Rodrigues((sway @ facing @ upright).astype(np.float64))
    placed = HandPose(
        betas[None],
        torch.tensor(orient.ravel(), dtype=torch.float32)[None],
        (a * (1 - mix) + b * mix)[None],
        torch.zeros(1, 3),
        "right",
    )
    with torch.no_grad():
        joints = model.joints(placed)[0]
    drift = torch.tensor([0.03 * math.sin(turn), 0.02 * math.cos(turn), 0.42 + 0.04 * math.sin(turn + 2)])
    return HandPose(
        placed.betas, placed.global_orient, placed.hand_pose, (drift - joints.mean(0))[None], "right"
    )


def _rotation(axis: Sequence[float], angle: float) -> NDArray[np.float64]:
    return np.asarray(cv2.Rodrigues(np.array(axis, dtype=np.float64) * angle)[0], np.float64)


def _skin(means: Tensor, normals: Tensor, random: np.random.Generator) -> Tensor:
    """Albedo [N,3]: skin tone, mottled at three sizes, paler palm, a few moles."""
    points = means.numpy()
    tone = np.zeros(len(points))
    for wavelength, strength in ((0.030, 0.05), (0.010, 0.045), (0.004, 0.05)):
        for _ in range(6):
            direction = random.normal(size=3)
            direction *= 2 * math.pi / wavelength / np.linalg.norm(direction)
            tone += strength / 2.4 * np.sin(points @ direction + random.uniform(0, 2 * math.pi))
    palm = np.clip(-normals[:, 1].numpy(), 0, 1)[:, None]
    base = np.array([0.78, 0.55, 0.43]) * (1 - palm) + np.array([0.86, 0.64, 0.54]) * palm
    albedo = base * (1 + tone[:, None] * np.array([0.8, 1.1, 1.3]))
    for _ in range(14):
        mole = points[random.integers(len(points))]
        near = np.exp(-0.5 * (np.linalg.norm(points - mole, axis=1) / random.uniform(0.0008, 0.0016)) ** 2)
        albedo *= 1 - 0.6 * near[:, None]
    return torch.tensor(np.clip(albedo, 0.02, 1), dtype=torch.float32)


def background(width: int, height: int, random: np.random.Generator) -> NDArray[np.float32]:
    """A table top [H,W,3] in 0..1 with boxes and papers of many colours."""
    small = random.normal(0, 1, (height // 16, width // 16)).astype(np.float32)
    cloud = cv2.resize(small, (width, height), interpolation=cv2.INTER_CUBIC)
    picture = np.array([0.46, 0.50, 0.52], np.float32) + 0.035 * cloud[..., None]
    for _ in range(18):
        center = random.uniform((0, 0), (width, height))
        size = random.uniform(20, 110, 2)
        corners = cv2.boxPoints((tuple(center), tuple(size), float(random.uniform(0, 180))))
        hue = random.integers((60, 30, 60), (150, 150, 230)).astype(np.uint8).reshape(1, 1, 3)
        color = cv2.cvtColor(hue, cv2.COLOR_HSV2RGB)[0, 0].astype(np.float64) / 255
        cv2.fillPoly(picture, [corners.astype(np.int32)], tuple(color))
    return np.asarray(np.clip(picture, 0, 1), np.float32)


def main(argv: Sequence[str] | None = None) -> int:
    """Write the clip to the file named on the command line."""
    parser = argparse.ArgumentParser(prog="python -m mass_engine.evaluation.demo_clip", description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--seconds", type=float, default=ClipOptions.seconds)
    arguments = parser.parse_args(argv)
    options = ClipOptions(seconds=arguments.seconds)
    write_video(arguments.out, demo_frames(options), options.fps)
    return 0


if __name__ == "__main__":
    sys.exit(main())
