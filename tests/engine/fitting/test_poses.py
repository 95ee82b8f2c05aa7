"""The pose table: rows move alone, and towards where their gradient says."""

from __future__ import annotations

import torch

from mass_engine.fitting.poses import PoseTable
from mass_engine.hand.pose import HandPose


def table() -> PoseTable:
    pose = HandPose(torch.zeros(5, 10), torch.zeros(5, 3), torch.zeros(5, 45), torch.full((5, 3), 0.5))
    return PoseTable(pose)


def test_a_step_moves_the_rows_it_saw_and_no_other() -> None:
    poses = table()
    rows = torch.tensor([1, 3])
    leaves = poses.leaves(rows)
    (leaves["transl"][0].sum() - leaves["hand_pose"][1, 0]).backward()
    poses.step(rows, leaves, 1.0)
    moved = [bool((poses.values["transl"][row] != 0.5).any()) for row in range(5)]
    assert moved == [False, True, False, False, False]
    assert float(poses.values["hand_pose"][3, 0]) > 0
    assert float(poses.values["hand_pose"].abs().sum()) == float(poses.values["hand_pose"][3, 0])


def test_rows_reach_their_targets_however_rarely_they_are_seen() -> None:
    poses = table()
    target = torch.linspace(-0.3, 0.3, 5).unsqueeze(-1)
    random = torch.Generator().manual_seed(0)
    for _ in range(400):
        rows = torch.randperm(5, generator=random)[:2]
        leaves = poses.leaves(rows)
        (leaves["global_orient"] - target[rows]).square().sum().backward()
        poses.step(rows, leaves, 0.5)
    assert float((poses.values["global_orient"] - target).abs().max()) < 0.03
