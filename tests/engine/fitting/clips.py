"""A made-up clip with known poses: the built-in hand with painted skin, rendered, as views of a fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from mass_engine.camera import Camera
from mass_engine.fitting.kinematics import turned
from mass_engine.fitting.subject import Appearance, Shape, pose_surfels, render_row
from mass_engine.fitting.views import View
from mass_engine.hand.builtin import load_builtin
from mass_engine.hand.model import HandModel
from mass_engine.hand.pose import HandPose
from mass_engine.raster import RasterOptions
from mass_engine.surfel.binding import MeshBinding
from mass_engine.surfel.shading import white_light
from mass_engine.tracking.segmentation import BACKGROUND, HAND

CAMERA = Camera.from_fov(200, 160, 45.0)


def painted(binding: MeshBinding) -> Appearance:
    """Skin with stripes and blotches that a registration can hold on to."""
    places = binding.surfels(load_builtin("right").template).means
    waves = torch.sin(
        places @ torch.tensor([[350.0, 120.0, 40.0], [-60.0, 300.0, 280.0], [90.0, -200.0, 410.0]])
    )
    albedo = torch.tensor([0.7, 0.5, 0.4]) + 0.12 * waves
    return Appearance(
        albedo, torch.full((binding.count,), 3.0), torch.zeros(binding.count, 0, 3), white_light()
    )


def true_poses(count: int) -> HandPose:
    """Fingers up, the back to the camera, slowly turning and closing."""
    orient = torch.tensor([1.2092, 1.2092, 1.2092]).repeat(count, 1)
    pose = HandPose(
        torch.zeros(count, 10),
        orient,
        torch.zeros(count, 45),
        torch.tensor([0.0, 0.0, 0.35]).repeat(count, 1),
    )
    step = torch.zeros(count, 51)
    share = torch.linspace(0, 1, count)
    step[:, 1] = 0.5 * share
    step[:, 5:48:9] = 0.5 * share.unsqueeze(-1)
    moved = turned(pose, step)
    joints = load_builtin("right").joints(moved)
    center = joints.mean(1)
    target = torch.tensor([0.0, 0.0, 0.35])
    return replace(moved, transl=moved.transl + target - center)


def make_views(
    poses: HandPose, heldout: frozenset[int] = frozenset(), model: HandModel | None = None
) -> list[View]:
    """One view a pose, 30 a second, with the joints as landmarks."""
    model = model or load_builtin("right")
    binding = MeshBinding.build(model, 1, 1)
    surfels = pose_surfels(Shape.mean(model, torch.zeros(10)), binding, poses)
    marks = CAMERA.project(surfels.joints)
    views = []
    for row in range(len(poses.transl)):
        with torch.no_grad():
            out = render_row(
                painted(binding), surfels, row, binding.bones, CAMERA, RasterOptions(cull_backfaces=True)
            )
        labels = np.where(out.alpha.numpy() > 0.5, HAND, BACKGROUND).astype(np.uint8)
        rgb = (out.rgb + 0.8 * (1 - out.alpha.unsqueeze(-1))).clamp(0, 1).mul(255).round().byte().numpy()
        views.append(
            View(row, row / 30, row in heldout, rgb, labels, CAMERA, marks[row].numpy(), 1.0, at_joints=True)
        )
    return views


def joint_error(model_poses: HandPose, truth: HandPose) -> Tensor:
    """Mean distance in millimetres of the joints in the picture plane and depth, frame by frame [F]."""
    model = load_builtin("right")
    apart: Tensor = (model.joints(model_poses) - model.joints(truth)).norm(dim=-1).mean(-1)
    return apart * 1000
