"""Alignment on landmarks made from known hands."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from mass_engine.camera import Camera
from mass_engine.hand.builtin import load_builtin
from mass_engine.hand.pose import HandPose, Side
from mass_engine.tracking.alignment import align_landmarks, interpolate_pose
from mass_engine.tracking.landmarks import HandLandmarks
from mass_engine.tracking.offsets import tracked_points

CAMERA = Camera.from_fov(640, 480, 60.0)


def moving_hand(side: Side, count: int) -> HandPose:
    """A hand that turns and bends over ``count`` frames, half a metre away."""
    phase = torch.linspace(0, 1, count).unsqueeze(-1)
    turn = torch.tensor([[1.5, 0.4, 0.3]]) + phase * torch.tensor([[0.5, 0.4, -0.3]])
    fingers = torch.zeros(count, 15, 3)
    bend = 0.2 + 0.7 * phase
    fingers[:, :12, 2] = bend if side == "right" else -bend
    betas = torch.tensor([0.5, -0.4, 0.3, 0.4, 0, 0, 0, 0, 0.2, 0]).expand(count, 10)
    transl = torch.tensor([0.03, 0.02, 0.5]) + phase * torch.tensor([0.05, -0.03, 0.06])
    return HandPose(betas, turn, fingers.flatten(1), transl, side)


def observed(
    truth: HandPose, noise: float, at_joints: bool = False
) -> tuple[list[HandLandmarks], torch.Tensor]:
    joints, turns = load_builtin(truth.side).skeleton(truth)
    points = tracked_points(joints, turns, truth.side, torch.full((len(joints),), at_joints))
    random = np.random.default_rng(0)
    pixels = CAMERA.project(points).numpy()
    world = (points - points.mean(1, keepdim=True)).numpy()
    size = np.ptp(pixels, axis=1).max()
    marks = []
    for row in range(len(joints)):
        seen = (pixels[row] + random.normal(0, noise * size, (21, 2))).astype(np.float32)
        cue = (world[row] * random.uniform(0.9, 1.1) + random.normal(0, 0.003, (21, 3))).astype(np.float32)
        right = 1.0 if truth.side == "right" else 0.0
        marks.append(HandLandmarks(row, truth.side, seen, cue, 1.0, right, at_joints=at_joints))
    return marks, joints


def similarity_error(found: torch.Tensor, truth: torch.Tensor) -> float:
    """Mean joint distance in metres after the best similarity transform of every frame."""
    a, b = found - found.mean(1, keepdim=True), truth - truth.mean(1, keepdim=True)
    u, s, vt = torch.linalg.svd(a.transpose(1, 2) @ b)
    sign = torch.det(u @ vt)
    fix = torch.diag_embed(torch.stack([torch.ones_like(sign), torch.ones_like(sign), sign], -1))
    rotation = u @ fix @ vt
    scale = (s * torch.diagonal(fix, dim1=1, dim2=2)).sum(1) / a.square().sum((1, 2))
    return float((scale[:, None, None] * a @ rotation - b).norm(dim=-1).mean())


@pytest.mark.parametrize("at_joints", [False, True])
@pytest.mark.parametrize("side", ["right", "left"])
def test_a_known_hand_is_recovered_from_noisy_points(side: Side, at_joints: bool) -> None:
    truth = moving_hand(side, 24)
    marks, joints = observed(truth, 0.01, at_joints)
    found = align_landmarks(load_builtin(side), marks, [i / 30 for i in range(24)], CAMERA)
    assert found.pose.side == side
    assert float(found.error.mean()) < 0.02
    assert similarity_error(load_builtin(side).joints(found.pose), joints) < 0.006
    # Metric depth comes from the mean hand's size: within a tenth.
    ratio = found.pose.transl[:, 2] / truth.transl[:, 2]
    assert 0.85 < float(ratio.mean()) < 1.15


def test_one_shape_serves_the_clip_and_a_given_shape_is_kept() -> None:
    truth = moving_hand("right", 8)
    marks, _ = observed(truth, 0.0)
    times = [i / 30 for i in range(8)]
    free = align_landmarks(load_builtin("right"), marks, times, CAMERA, iterations=60)
    assert torch.equal(free.pose.betas, free.pose.betas[:1].expand(8, 10))
    given = torch.full((10,), 0.3)
    kept = align_landmarks(load_builtin("right"), marks, times, CAMERA, betas=given, iterations=20)
    assert torch.equal(kept.pose.betas[3], given)


def test_interpolation_meets_its_ends_and_takes_the_short_way() -> None:
    truth = moving_hand("right", 3)
    between = interpolate_pose(truth, [0.0, 0.1, 0.2], [0.1, 0.15, 9.0])
    model = load_builtin("right")
    want = model.joints(truth)
    got = model.joints(between)
    torch.testing.assert_close(got[0], want[1], atol=1e-4, rtol=0)
    torch.testing.assert_close(got[2], want[2], atol=1e-4, rtol=0)
    assert float((got[1] - (want[1] + want[2]) / 2).norm(dim=-1).max()) < 0.005


def test_points_lie_off_the_joints_the_same_way_on_either_hand() -> None:
    flip = torch.tensor([-1.0, 1.0, 1.0])
    apart = []
    for side in ("right", "left"):
        rest = HandPose.rest(side)
        joints, turns = load_builtin(side).skeleton(rest)
        seen = tracked_points(joints[None], turns[None], side, torch.tensor([False]))
        apart.append(seen[0] - joints)
        assert torch.equal(
            tracked_points(joints[None], turns[None], side, torch.tensor([True]))[0],
            joints,
        )
    torch.testing.assert_close(apart[0] * flip, apart[1])
    assert 1e-3 < float(apart[0].norm(dim=-1).mean()) < 1e-2
