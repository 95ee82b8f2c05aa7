"""Hand pose: what the tracker and the alignment produce and every hand model consumes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

Side = Literal["left", "right"]

#: MANO's joint order, then the five fingertips.
JOINT_NAMES: tuple[str, ...] = (
    "wrist",
    "index1", "index2", "index3",
    "middle1", "middle2", "middle3",
    "pinky1", "pinky2", "pinky3",
    "ring1", "ring2", "ring3",
    "thumb1", "thumb2", "thumb3",
    "thumb_tip", "index_tip", "middle_tip", "ring_tip", "pinky_tip",
)  # fmt: skip

#: Parent of each of the 16 joints; the wrist has none (-1).
JOINT_PARENTS: tuple[int, ...] = (-1, 0, 1, 2, 0, 4, 5, 0, 7, 8, 0, 10, 11, 0, 13, 14)

#: The joint each fingertip (rows 16..20 of the 21 points) hangs from.
TIP_PARENTS: tuple[int, ...] = (15, 3, 6, 12, 9)


@dataclass(frozen=True)
class HandPose:
    """Shape and pose of one hand or of a batch of hands (any leading dimensions ``...``).

    ``betas`` [...,10]; ``global_orient`` [...,3] and ``hand_pose`` [...,45] axis-angle in radians
    (absolute: zero is the flat rest hand); ``transl`` [...,3] in metres. A left hand is described in
    the left model's own frame: the right hand mirrored in x (as in MANO), so y and z of every axis-angle
    change sign.
    """

    betas: Tensor
    global_orient: Tensor
    hand_pose: Tensor
    transl: Tensor
    side: Side = "right"

    def to(self, device: torch.device | str) -> HandPose:
        """The same pose elsewhere."""
        return HandPose(
            self.betas.to(device),
            self.global_orient.to(device),
            self.hand_pose.to(device),
            self.transl.to(device),
            self.side,
        )

    @staticmethod
    def rest(side: Side = "right") -> HandPose:
        """The flat hand at the origin with the mean shape."""
        return HandPose(torch.zeros(10), torch.zeros(3), torch.zeros(45), torch.zeros(3), side)

    def rows(self, index: Tensor) -> HandPose:
        """Some rows (``index`` [B]) of a batch of hands."""
        return HandPose(
            self.betas[index], self.global_orient[index], self.hand_pose[index], self.transl[index], self.side
        )
