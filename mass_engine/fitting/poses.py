"""Per-frame poses as rows of a table, each row with its own Adam state.

A step touches a few frames only. Dense Adam would move the others by their stale momentum; here a row
moves only when its frame was seen.
"""

from __future__ import annotations

import torch
from torch import Tensor

from mass_engine.hand.pose import HandPose, Side

#: Learning rates in units of the quantity: radians, radians, metres (relative to the hand's depth).
POSE_RATES: dict[str, float] = {"global_orient": 0.01, "hand_pose": 0.02, "transl": 0.004}


class PoseTable:
    """``global_orient`` [F,3], ``hand_pose`` [F,45], ``transl`` [F,3] of F frames of one hand."""

    def __init__(self, pose: HandPose) -> None:
        self.side: Side = pose.side
        self.values: dict[str, Tensor] = {
            "global_orient": pose.global_orient.detach().clone(),
            "hand_pose": pose.hand_pose.detach().clone(),
            "transl": pose.transl.detach().clone(),
        }
        self._depth = pose.transl[:, 2].detach().abs().clamp_min(0.05)
        self.reset_momentum()

    def to(self, device: torch.device | str) -> PoseTable:
        """A copy of the poses elsewhere, without what is remembered of past steps."""
        betas = self.values["transl"].new_zeros(10)
        return PoseTable(self.pose(betas).to(device))

    def reset_momentum(self) -> None:
        """Forget gradients of the past (a new stage, another resolution)."""
        self._first = {name: torch.zeros_like(value) for name, value in self.values.items()}
        self._second = {name: torch.zeros_like(value) for name, value in self.values.items()}
        self._count = torch.zeros(len(self._depth))

    def leaves(self, rows: Tensor) -> dict[str, Tensor]:
        """Copies of the rows [B] that gradients can be taken of."""
        return {name: value[rows].requires_grad_(True) for name, value in self.values.items()}

    def pose(self, betas: Tensor, leaves: dict[str, Tensor] | None = None) -> HandPose:
        """The batched pose of ``leaves`` (or of the whole table) with one shape ``betas`` [10]."""
        values = self.values if leaves is None else leaves
        count = len(values["transl"])
        return HandPose(
            betas.expand(count, 10),
            values["global_orient"],
            values["hand_pose"],
            values["transl"],
            self.side,
        )

    def step(self, rows: Tensor, leaves: dict[str, Tensor], rate: float) -> None:
        """One Adam step of the rows [B] along their leaves' gradients; ``rate`` scales POSE_RATES."""
        beta1, beta2 = 0.8, 0.95
        self._count[rows] += 1
        count = self._count[rows].unsqueeze(-1)
        for name, leaf in leaves.items():
            if leaf.grad is None:
                continue
            first = self._first[name][rows].lerp(leaf.grad, 1 - beta1)
            second = self._second[name][rows].lerp(leaf.grad.square(), 1 - beta2)
            self._first[name][rows], self._second[name][rows] = first, second
            move = (first / (1 - beta1**count)) / ((second / (1 - beta2**count)).sqrt() + 1e-12)
            scale: Tensor | float = rate * POSE_RATES[name]
            if name == "transl":
                scale = scale * self._depth[rows].unsqueeze(-1)
            self.values[name][rows] = leaf.detach() - scale * move

    def put(self, rows: Tensor, pose: HandPose) -> None:
        """Overwrite the rows [B] by a batched pose."""
        self.values["global_orient"][rows] = pose.global_orient.detach()
        self.values["hand_pose"][rows] = pose.hand_pose.detach()
        self.values["transl"][rows] = pose.transl.detach()
