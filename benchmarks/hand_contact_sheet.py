"""Contact sheets of the built-in hand, drawn by the rasteriser.

``python benchmarks/hand_contact_sheet.py OUT_DIR`` writes poses.png (every named pose from several sides),
shapes.png (every shape parameter, low and high), joints.png (close-ups of single joints bent by a right
angle or to their limit) and details.png (nails, pads, wrist, webs, the fist from near).
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mass_engine.camera import Camera
from mass_engine.fitting.subject import draw
from mass_engine.hand.anatomy import SHAPE_NAMES
from mass_engine.hand.builtin import joint_frames, load_builtin
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
#: Sees about this many metres.
_WIDE, _NEAR = 0.25, 0.075


@dataclass(frozen=True)
class CloseUp:
    """A look from ``direction`` at one of the 21 points, ``meters`` wide."""

    point: int
    direction: tuple[float, float, float]
    meters: float = _NEAR


#: Joint number, the degrees it flexes by, and what is seen; both sides of the bend.
_BENDS: tuple[tuple[str, int, float], ...] = (
    ("index knuckle", 1, 90), ("middle knuckle", 4, 90), ("ring knuckle", 10, 90), ("little knuckle", 7, 90),
    ("index middle joint", 2, 90), ("index middle joint", 2, 110), ("little middle joint", 8, 90),
    ("index last joint", 3, 80), ("thumb root", 13, 45), ("thumb knuckle", 14, 60),
    ("thumb last joint", 15, 85),
)  # fmt: skip

_DETAILS: tuple[tuple[str, str, CloseUp], ...] = (
    ("nails", "rest", CloseUp(18, (-0.25, 1.0, 0.0), 0.05)),
    ("nail from the side", "rest", CloseUp(17, (0.0, 0.15, 1.0), 0.04)),
    ("finger pad", "rest", CloseUp(18, (-0.2, -1.0, 0.2), 0.05)),
    ("thumb nail", "rest", CloseUp(16, (-0.2, 0.6, 0.8), 0.05)),
    ("thumb pad", "rest", CloseUp(16, (0.0, -0.8, -0.6), 0.05)),
    ("webs", "spread", CloseUp(4, (-0.6, 0.8, 0.0), 0.1)),
    ("webs, palm", "spread", CloseUp(4, (-0.3, -1.0, 0.0), 0.1)),
    ("knuckles", "fist", CloseUp(4, (-0.6, 0.8, 0.3), 0.1)),
    ("palm", "rest", CloseUp(4, (0.0, -1.0, 0.0), 0.13)),
    ("wrist", "rest", CloseUp(0, (0.0, 1.0, 0.0), 0.1)),
    ("wrist from behind", "rest", CloseUp(0, (1.0, 0.4, 0.3), 0.1)),
    ("fist", "fist", CloseUp(2, (-0.3, 0.1, 1.0), 0.12)),
    ("fist, palm", "fist", CloseUp(2, (0.2, -1.0, 0.3), 0.12)),
    ("fist, from below", "fist", CloseUp(5, (-0.5, -1.0, 0.6), 0.12)),
    ("pinch", "pinch", CloseUp(17, (-0.2, 0.1, 1.0), 0.1)),
)


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


def picture(
    model: HandModel, binding: MeshBinding, pose: HandPose, view: str | CloseUp, side: int
) -> Picture:
    """A grey hand lit from the camera's upper left, uint8 [side,side,3]."""
    with torch.no_grad():
        vertices, points = model(pose)
        surfels = binding.surfels(vertices)
        if isinstance(view, CloseUp):
            camera = camera_at(view.direction, points[view.point], side, view.meters)
        else:
            center = (vertices.amax(0) + vertices.amin(0)) / 2
            camera = camera_at(VIEWS[view], center, side, _WIDE)
        light = torch.nn.functional.normalize(torch.tensor([-0.45, -0.55, -0.70]), dim=0)
        facing = surfels.normals @ camera.world_to_camera[:3, :3].T @ light
        tone = 0.28 + 0.62 * facing.clamp_min(0) + 0.10 * facing
        colors = tone.clamp(0, 1).unsqueeze(-1) * torch.tensor([0.95, 0.80, 0.72])
        opacities = torch.full((binding.count,), 0.99)
        out = draw(
            surfels, opacities, colors, camera, RasterOptions(cull_backfaces=True), torch.full((3,), 0.2)
        )
    return np.asarray((out.rgb.clamp(0, 1) * 255).round().to(torch.uint8).numpy())


def label(image: Picture, text: str) -> Picture:
    """``image`` with ``text`` in its corner."""
    return np.asarray(
        cv2.putText(
            image.copy(), text, (6, 16), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (255, 255, 255), 1, cv2.LINE_AA
        ),
        np.uint8,
    )


def bent(model: HandModel, joint: int, degrees: float) -> HandPose:
    """The resting hand with one joint flexed."""
    fingers = torch.zeros(15, 3)
    fingers[joint - 1] = joint_frames(model)[joint - 1, 0] * math.radians(degrees)
    return replace(HandPose.rest(model.side), hand_pose=fingers.flatten())


def joints_sheet(model: HandModel, binding: MeshBinding, side: int) -> Picture:
    """Each bend from both sides, from its back and from its inside."""
    rows = []
    for name, joint, degrees in _BENDS:
        pose, frame = bent(model, joint, degrees), joint_frames(model)[joint - 1]
        looks = {
            "one side": frame[0] + 0.1 * frame[1],
            "other side": -frame[0] + 0.1 * frame[1],
            "back": frame[1] + frame[2],
            "inside": -frame[1] + 0.3 * frame[2] + 0.3 * frame[0],
        }
        cells = []
        for look, direction in looks.items():
            x, y, z = direction.tolist()
            image = picture(model, binding, pose, CloseUp(joint, (x, y, z)), side)
            cells.append(label(image, f"{name} {degrees:.0f}, {look}"))
        rows.append(np.hstack(cells))
    half = (len(rows) + 1) // 2
    rows += [np.zeros_like(rows[0])] * (2 * half - len(rows))
    return np.hstack([np.vstack(rows[:half]), np.vstack(rows[half:])])


def details_sheet(model: HandModel, binding: MeshBinding, side: int) -> Picture:
    """Close-ups of what a person looks at."""
    cells = [
        label(picture(model, binding, named_pose(pose, model.side), view, side), f"{name} ({pose})")
        for name, pose, view in _DETAILS
    ]
    return np.vstack([np.hstack(cells[k : k + 5]) for k in range(0, len(cells), 5)])


def write(path: Path, image: Picture) -> None:
    """As PNG."""
    cv2.imwrite(str(path), cv2.cvtColor(image, cv2.COLOR_RGB2BGR))


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
    write(out / "poses.png", np.vstack(rows))
    rows = []
    for view in (CloseUp(4, VIEWS["back"], 0.33), CloseUp(4, VIEWS["thumb"], 0.33)):
        for amount in (-3.0, 3.0):
            cells = []
            for place, name in enumerate(SHAPE_NAMES):
                betas = torch.zeros(10)
                betas[place] = amount
                pose = replace(HandPose.rest("right"), betas=betas)
                cells.append(label(picture(model, binding, pose, view, side), f"{name} {amount:+.0f}"))
            rows += [np.hstack(cells[:5]), np.hstack(cells[5:])]
    write(out / "shapes.png", np.vstack(rows))
    fine = MeshBinding.build(model, 2, 1)
    write(out / "joints.png", joints_sheet(model, fine, side))
    write(out / "details.png", details_sheet(model, fine, side))
    return 0


if __name__ == "__main__":
    sys.exit(main())
