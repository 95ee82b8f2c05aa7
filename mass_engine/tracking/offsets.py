"""Where the tracker puts its points on a hand, against the joints of the hand model.

The network was taught by people who clicked on photographs: its fingertips lie in the pads, short of the
tips, and its thumb root nearer the palm's edge than the bone's end. Measured on renders of the built-in hand,
where both are known (``benchmarks/tracker_offsets.py``).
"""

from __future__ import annotations

import torch
from torch import Tensor

from mass_engine.hand.pose import TIP_PARENTS, Side

#: The bone that carries each of the 21 points.
BONE_OF_POINT: tuple[int, ...] = (*range(16), *TIP_PARENTS)

#: Millimetres from the joint to the tracked point, right hand, in the bone's axes (the model's at rest).
_OFFSETS: tuple[tuple[float, float, float], ...] = (
    (-1.0, -1.6, -3.9),  # wrist
    (-1.3, -0.8, 0.4),  # index1
    (1.1, -0.9, -0.1),  # index2
    (0.8, -1.5, 0.3),  # index3
    (0.4, -3.5, 0.0),  # middle1
    (3.0, -1.1, -0.9),  # middle2
    (2.7, -2.2, -0.4),  # middle3
    (-3.3, 0.1, -1.5),  # pinky1
    (-1.3, -0.2, -1.3),  # pinky2
    (-1.5, -0.2, -0.2),  # pinky3
    (-1.5, -2.6, -0.4),  # ring1
    (0.2, -1.3, -1.0),  # ring2
    (1.2, -2.4, 0.3),  # ring3
    (-5.2, -7.6, 10.1),  # thumb1
    (0.5, -0.3, -0.6),  # thumb2
    (3.4, -0.9, -2.6),  # thumb3
    (6.2, 2.1, -2.6),  # thumb_tip
    (4.4, -0.1, 0.0),  # index_tip
    (7.0, -0.6, 0.6),  # middle_tip
    (6.5, -1.3, 1.7),  # ring_tip
    (4.4, -0.4, 2.0),  # pinky_tip
)


def tracked_points(joints: Tensor, bone_rotations: Tensor, side: Side, at_joints: Tensor) -> Tensor:
    """Where landmarks lie for joints [F,21,3] (metres) of hands with ``bone_rotations`` [F,16,3,3].

    ``at_joints`` [F] bool: the frames whose landmarks are the joints themselves.
    """
    mirror = -1.0 if side == "left" else 1.0
    offsets = torch.tensor(_OFFSETS).to(joints) * torch.tensor([mirror, 1.0, 1.0]).to(joints) * 1e-3
    turns = bone_rotations[..., list(BONE_OF_POINT), :, :]
    moved = (turns @ offsets.unsqueeze(-1)).squeeze(-1)
    return joints + torch.where(at_joints[:, None, None], torch.zeros_like(moved), moved)
