"""Alignment: from 21 image points a frame to one hand shape and one metric pose per frame.

All frames are solved together by Adam on the joints alone (no vertices are posed), which takes a few
seconds for hundreds of frames. The network's world landmarks are not metric and enter only as bone
directions, a weak depth cue.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp
from torch import Tensor

from mass_engine.camera import Camera
from mass_engine.hand.builtin import joint_frames, joint_limits
from mass_engine.hand.model import HandModel
from mass_engine.hand.pose import JOINT_PARENTS, TIP_PARENTS, HandPose
from mass_engine.threads import one_thread
from mass_engine.tracking.landmarks import HandLandmarks
from mass_engine.tracking.offsets import tracked_points

#: Bones as (parent point, child point) over the 21 points.
BONES: tuple[tuple[int, int], ...] = tuple(
    (parent, child) for child, parent in enumerate(JOINT_PARENTS) if parent >= 0
) + tuple((parent, 16 + tip) for tip, parent in enumerate(TIP_PARENTS))

#: Points that move as one body, whatever the fingers do: wrist and the four finger knuckles.
PALM_POINTS: tuple[int, ...] = (0, 1, 4, 7, 10)


@dataclass(frozen=True)
class AlignmentWeights:
    """What each term weighs. Distances are in units of the hand's size in the image or in metres."""

    reprojection: float = 1.0
    direction: float = 0.02  # world landmarks: bone directions
    direction_lead: float = 0.5  # more of it at the start, gone by half time
    limits: float = 1.0
    rest: float = 2e-4  # pull of every finger angle towards the flat hand, or to the given start
    shape: float = 2e-4  # pull of every shape parameter towards the mean hand
    smooth: float = 0.3  # acceleration of the joints, hand sizes per (1/30 s)^2
    robust_scale: float = 0.03  # Charbonnier scale, in hand sizes


@dataclass(frozen=True)
class Alignment:
    """``pose`` is batched over frames [F]; ``error`` [F] is the mean reprojection error in hand sizes."""

    pose: HandPose
    error: NDArray[np.float32]


def hand_size_pixels(points: Tensor) -> Tensor:
    """Size of the hand in the image: the larger side of the box of its points [F,21,2] -> [F]."""
    return (points.amax(-2) - points.amin(-2)).amax(-1).clamp_min(1.0)


def limit_excess(hand_pose: Tensor, limits: Tensor, frames: Tensor) -> Tensor:
    """How far finger angles leave their limits, in radians; ``hand_pose`` [...,45] -> [...,15,3]."""
    angles = torch.einsum("jab,...jb->...ja", frames, hand_pose.unflatten(-1, (15, 3)))
    return (limits[..., 0] - angles).clamp_min(0) + (angles - limits[..., 1]).clamp_min(0)


def initial_pose(model: HandModel, landmarks: Sequence[HandLandmarks], camera: Camera) -> HandPose:
    """A flat hand turned as the palm's world landmarks are and placed as large as it looks."""
    rest_joints = model.joints(HandPose.rest(model.side)).numpy()
    palm = rest_joints[list(PALM_POINTS)]
    orient, transl = [], []
    focal = float(camera.K[0, 0])
    center = camera.K[:2, 2].numpy()
    for mark in landmarks:
        seen = mark.world[list(PALM_POINTS)]
        rotation, _ = Rotation.align_vectors(seen - seen.mean(0), palm - palm.mean(0))
        turned = rotation.apply(rest_joints)
        # Depth from the spread of the palm in the image against the spread of the turned model.
        pixels = mark.points[list(PALM_POINTS)]
        shown = turned[list(PALM_POINTS), :2]
        spread = np.linalg.norm(shown - shown.mean(0)) + 1e-6
        depth = focal * float(spread) / (float(np.linalg.norm(pixels - pixels.mean(0))) + 1e-6)
        depth = min(max(depth, 0.1), 5.0)
        xy = (pixels.mean(0) - center) / focal * depth
        anchor = turned[list(PALM_POINTS)].mean(0)
        orient.append(rotation.as_rotvec())
        # global_orient turns the hand about its wrist joint, so the wrist stays where the rest pose has it.
        wrist = rest_joints[0]
        transl.append(np.array([*xy, depth]) - anchor + rotation.apply(wrist) - wrist)
    count = len(landmarks)
    return HandPose(
        torch.zeros(count, 10),
        torch.tensor(np.array(orient), dtype=torch.float32),
        torch.zeros(count, 45),
        torch.tensor(np.array(transl), dtype=torch.float32),
        model.side,
    )


@one_thread()  # tensors of a few thousand numbers
def align_landmarks(
    model: HandModel,
    landmarks: Sequence[HandLandmarks],
    times: Sequence[float],
    camera: Camera,
    *,
    betas: Tensor | None = None,
    start: HandPose | None = None,
    iterations: int = 200,
    weights: AlignmentWeights | None = None,
    progress: Callable[[float], None] | None = None,
) -> Alignment:
    """Fit one shape and all poses to the landmarks of F frames.

    ``betas`` [10] given: the shape is kept (frames that must not influence it). ``start`` [F]: where to
    begin instead of :func:`initial_pose`. ``times`` in seconds, increasing.
    """
    w = weights or AlignmentWeights()
    points = torch.tensor(np.stack([mark.points for mark in landmarks]), dtype=torch.float32)
    world = torch.tensor(np.stack([mark.world for mark in landmarks]), dtype=torch.float32)
    trust = torch.tensor([mark.score for mark in landmarks], dtype=torch.float32)
    at_joints = torch.tensor([mark.at_joints for mark in landmarks])
    size = hand_size_pixels(points)
    begin = start if start is not None else initial_pose(model, landmarks, camera)
    parents, children = (torch.tensor(column) for column in zip(*BONES, strict=True))
    seen_direction = torch.nn.functional.normalize(world[:, children] - world[:, parents], dim=-1)
    limits, frames = joint_limits(), joint_frames(model)
    smooth_weight = _acceleration_weights(times)

    free_betas = torch.zeros(10) if betas is None else betas.clone()
    orient, fingers = begin.global_orient.clone(), begin.hand_pose.clone()
    usual = begin.hand_pose  # flat, or as given
    depth0 = begin.transl[:, 2:].clamp_min(0.05)
    shift = torch.zeros_like(begin.transl)
    groups = [
        {"params": [orient], "lr": 0.09},
        {"params": [fingers], "lr": 0.09},
        {"params": [shift], "lr": 0.03},
    ]
    if betas is None:
        groups.append({"params": [free_betas], "lr": 0.09})
    for group in groups:
        for parameter in group["params"]:  # type: ignore[attr-defined]
            parameter.requires_grad_(True)
    # A short memory of gradients: rates this high would not settle with the usual one.
    optimizer = torch.optim.Adam(groups, betas=(0.9, 0.95))
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, iterations, eta_min=1e-3)
    error = torch.zeros(len(landmarks))

    def pose() -> HandPose:
        return HandPose(
            free_betas.expand(len(landmarks), 10), orient, fingers, begin.transl + shift * depth0, model.side
        )

    for iteration in range(iterations):
        optimizer.zero_grad(set_to_none=True)
        # Fingers bend only once the palm is in place: else they explain the palm's error. A given start has
        # them bent.
        ramp = min(1.0, max(0.0, (iteration / iterations - 0.15) / 0.1))
        finger_share = 1.0 if start is not None else ramp
        current = pose()
        if finger_share < 1.0:
            current = replace(current, hand_pose=fingers * finger_share)
        joints, turns = model.skeleton(current)
        marks = tracked_points(joints, turns, model.side, at_joints)
        pixel_error = (camera.project(marks) - points).norm(dim=-1) / size[:, None]
        robust = w.robust_scale * ((1 + (pixel_error / w.robust_scale) ** 2).sqrt() - 1)
        direction = torch.nn.functional.normalize(marks[:, children] - marks[:, parents], dim=-1)
        cue = 1 - (direction * seen_direction).sum(-1)
        # The image alone cannot tell a finger bent forward from one bent back: the cue decides that first.
        lead = max(0.0, 1 - 2 * iteration / iterations)
        loss = w.reprojection * (robust.mean(-1) * trust).mean()
        loss = loss + (w.direction + w.direction_lead * lead) * (cue.mean(-1) * trust).mean()
        loss = loss + w.limits * limit_excess(fingers, limits, frames).square().sum((-1, -2)).mean()
        loss = loss + w.rest * (fingers - usual).square().sum(-1).mean() + w.shape * free_betas.square().sum()
        behind = (0.05 - joints[..., 2]).clamp_min(0)
        loss = loss + 100 * behind.square().sum(-1).mean()
        if len(landmarks) > 2 and w.smooth > 0:
            bend = (joints[2:] - 2 * joints[1:-1] + joints[:-2]) / 0.18
            loss = loss + w.smooth * (smooth_weight * bend.square().sum(-1).mean(-1)).mean()
        loss.backward()
        optimizer.step()
        schedule.step()
        error = pixel_error.detach().mean(-1)
        if progress is not None:
            progress((iteration + 1) / iterations)
    final = pose()
    return Alignment(
        HandPose(
            final.betas.detach().clone(),
            final.global_orient.detach(),
            final.hand_pose.detach(),
            final.transl.detach(),
            model.side,
        ),
        error.numpy(),
    )


def _acceleration_weights(times: Sequence[float]) -> Tensor:
    """One weight per inner frame: 1 at 30 frames a second, less across a gap, none across a long one."""
    t = torch.tensor(list(times), dtype=torch.float64)
    if len(t) < 3:
        return torch.zeros(0)
    span = torch.maximum(t[2:] - t[1:-1], t[1:-1] - t[:-2]).clamp_min(1e-3) * 30
    return torch.where(span > 10, torch.zeros_like(span), span.clamp_min(1.0) ** -2).float()


def interpolate_pose(pose: HandPose, times: Sequence[float], at: Sequence[float]) -> HandPose:
    """The poses of other instants: rotations by slerp, translations linearly; held beyond the ends."""
    t = np.asarray(times, dtype=np.float64)
    wanted = np.clip(np.asarray(at, dtype=np.float64), t[0], t[-1])
    if len(t) == 1:
        return pose.rows(torch.zeros(len(wanted), dtype=torch.long))
    vectors = torch.cat([pose.global_orient, pose.hand_pose], -1).detach().numpy().reshape(len(t), 16, 3)
    turned = np.stack(
        [Slerp(t, Rotation.from_rotvec(vectors[:, joint]))(wanted).as_rotvec() for joint in range(16)], 1
    )
    transl = np.stack([np.interp(wanted, t, pose.transl[:, axis].detach().numpy()) for axis in range(3)], -1)
    return HandPose(
        pose.betas[:1].expand(len(wanted), 10).detach(),
        torch.tensor(turned[:, 0], dtype=torch.float32),
        torch.tensor(turned[:, 1:].reshape(len(wanted), 45), dtype=torch.float32),
        torch.tensor(transl, dtype=torch.float32),
        pose.side,
    )
