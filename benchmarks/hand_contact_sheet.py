"""Contact sheets of the built-in hand: every named pose and every shape parameter, from several sides.

``python benchmarks/hand_contact_sheet.py OUT_DIR`` writes poses.png and shapes.png, drawn by the rasteriser.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mass_engine.camera import Camera
from mass_engine.fitting.subject import draw
from mass_engine.hand.anatomy import SHAPE_NAMES
from mass_engine.hand.builtin import load_builtin
from mass_engine.hand.model import HandModel
from mass_engine.hand.pose import HandPose
from mass_engine.hand.poses import POSE_NAMES, named_pose
from mass_engine.raster import RasterOptions
from mass_engine.surfel.binding import MeshBinding

Picture = NDArray[np.uint8]

#: Where each view looks from (right hand: +y back of the hand, -y palm, +z thumb, -x fingertips).
VIEWS: dict[str, tuple[float, float, float]] = {
    "back": (0.0, 1.0, 0.0),
    "palm": (0.0, -1.0, 0.0),
    "thumb": (-0.2, 0.25, 1.0),
    "little": (-0.2, 0.25, -1.0),
    "tips": (-1.0, 0.25, 0.35),
}


def camera_at(direction: tuple[float, float, float], center: Tensor, side: int, meters: float) -> Camera:
    """A square camera ``side`` pixels wide that looks at ``center`` and sees about ``meters``."""
    back = torch.nn.functional.normalize(torch.tensor(direction), dim=0)
    forward = -back
    # Fingertips point up in the picture, or the back of the hand where the fingers point at the camera.
    up = torch.tensor([-1.0, 0.0, 0.0]) if abs(float(back[0])) < 0.8 else torch.tensor([0.0, 1.0, 0.0])
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, up), dim=0)
    down = torch.linalg.cross(forward, right)
    rotation = torch.stack([right, down, forward])
    distance = 0.8
    world_to_camera = torch.eye(4)
    world_to_camera[:3, :3] = rotation
    world_to_camera[:3, 3] = torch.tensor([0.0, 0.0, distance]) - rotation @ center
    focal = side * distance / meters
    K = torch.tensor([[focal, 0.0, side / 2], [0.0, focal, side / 2], [0.0, 0.0, 1.0]])
    return Camera(K, world_to_camera, side, side)


def picture(model: HandModel, binding: MeshBinding, pose: HandPose, view: str, side: int) -> Picture:
    """A grey hand lit from the camera's upper left, uint8 [side,side,3]."""
    with torch.no_grad():
        vertices, _ = model(pose)
        surfels = binding.surfels(vertices)
        center = (vertices.amax(0) + vertices.amin(0)) / 2
        camera = camera_at(VIEWS[view], center, side, 0.25)
        light = torch.nn.functional.normalize(torch.tensor([-0.45, -0.55, -0.70]), dim=0)
        facing = surfels.normals @ camera.world_to_camera[:3, :3].T @ light
        tone = 0.28 + 0.62 * facing.clamp_min(0) + 0.10 * facing
        colors = tone.clamp(0, 1).unsqueeze(-1) * torch.tensor([0.95, 0.80, 0.72])
        opacities = torch.full((binding.count,), 0.99)
        out = draw(surfels, opacities, colors, camera, RasterOptions(), torch.full((3,), 0.2))
    return np.asarray((out.rgb.clamp(0, 1) * 255).round().to(torch.uint8).numpy())


def label(image: Picture, text: str) -> Picture:
    """``image`` with ``text`` in its corner."""
    return np.asarray(
        cv2.putText(
            image.copy(), text, (6, 16), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (255, 255, 255), 1, cv2.LINE_AA
        ),
        np.uint8,
    )


def main(argv: Sequence[str] | None = None) -> int:
    """Write the sheets."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--size", type=int, default=300, help="pixels of one picture")
    arguments = parser.parse_args(argv)
    out: Path = arguments.out
    out.mkdir(parents=True, exist_ok=True)
    side = int(arguments.size)
    model = load_builtin("right")
    binding = MeshBinding.build(model, 2, 0)
    rows = [
        np.hstack(
            [
                label(picture(model, binding, named_pose(name, "right"), view, side), f"{name}, {view}")
                for view in VIEWS
            ]
        )
        for name in POSE_NAMES
    ]
    cv2.imwrite(str(out / "poses.png"), cv2.cvtColor(np.vstack(rows), cv2.COLOR_RGB2BGR))
    rows = []
    for view in ("back", "thumb"):
        for amount in (-3.0, 3.0):
            cells = []
            for place, name in enumerate(SHAPE_NAMES):
                betas = torch.zeros(10)
                betas[place] = amount
                pose = replace(HandPose.rest("right"), betas=betas)
                cells.append(label(picture(model, binding, pose, view, side), f"{name} {amount:+.0f}"))
            rows += [np.hstack(cells[:5]), np.hstack(cells[5:])]
    cv2.imwrite(str(out / "shapes.png"), cv2.cvtColor(np.vstack(rows), cv2.COLOR_RGB2BGR))
    return 0


if __name__ == "__main__":
    sys.exit(main())
