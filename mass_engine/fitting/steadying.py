"""Start poses that jitter from frame to frame are steadied before anything is fitted to them."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from mass_engine.hand.pose import HandPose
from mass_engine.hand.rotation import axis_angle_to_matrix, matrix_to_axis_angle

#: Jitter (standard deviation, radians) that a tracker may leave: under it nothing is changed.
QUIET = 0.06
#: Frames that the steadying reaches (standard deviation of its window), for each QUIET of jitter.
FRAMES_PER_QUIET = 1.2
#: Widest window, frames: a hand moves, too.
MOST_FRAMES = 4.0


def jitter(pose: HandPose) -> Tensor:
    """Standard deviation [16] in radians of each joint's frame-to-frame noise (the wrist first).

    From the second differences of neighbouring frames, in which steady motion cancels; their median, so that
    a few real jerks do not count. ``pose`` is batched [F] in time order.
    """
    turns = _rotations(pose)
    if len(turns) < 3:
        return torch.zeros(16)
    forward = matrix_to_axis_angle(turns[2:] @ turns[1:-1].mT)
    backward = matrix_to_axis_angle(turns[:-2] @ turns[1:-1].mT)
    second = (forward + backward).abs().flatten(2).permute(1, 0, 2).flatten(1)
    return 1.4826 * second.median(1).values / 6**0.5  # noise adds up as 1 + 4 + 1


def steadied(pose: HandPose) -> HandPose:
    """``pose`` [F] with every joint that jitters replaced by a local line through its neighbours in time."""
    noise = jitter(pose)
    turns = _rotations(pose)
    out = turns.clone()
    places = torch.arange(len(turns), dtype=torch.float32)
    for joint in (noise > QUIET).nonzero()[:, 0].tolist():
        width = min(MOST_FRAMES, FRAMES_PER_QUIET * float(noise[joint]) / QUIET)
        for frame in range(len(turns)):
            away = places - places[frame]
            window = away.abs() <= 3 * width
            steps = matrix_to_axis_angle(turns[window, joint] @ turns[frame, joint].T)
            move = _at_zero(away[window], steps, torch.exp(-0.5 * (away[window] / width).square()))
            out[frame, joint] = axis_angle_to_matrix(move) @ turns[frame, joint]
    angles = matrix_to_axis_angle(out)
    return replace(pose, global_orient=angles[:, 0], hand_pose=angles[:, 1:].flatten(1))


def _rotations(pose: HandPose) -> Tensor:
    every = torch.cat([pose.global_orient.unsqueeze(1), pose.hand_pose.unflatten(1, (15, 3))], 1)
    return axis_angle_to_matrix(every)


def _at_zero(away: Tensor, steps: Tensor, weight: Tensor) -> Tensor:
    """Value [3] at 0 of the weighted line through ``steps`` [S,3] at ``away`` [S]; outliers count less."""
    value = torch.zeros(3)
    for _ in range(3):
        design = torch.stack([torch.ones_like(away), away], 1)
        weighted = design * weight.unsqueeze(1)
        line = torch.linalg.solve(weighted.T @ design + 1e-6 * torch.eye(2), weighted.T @ steps)
        value = line[0]
        error = (steps - design @ line).norm(dim=1)
        weight = weight / (1 + (error / error.median().clamp_min(1e-6) / 2).square())
    return value
