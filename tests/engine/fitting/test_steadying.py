"""Jittering start poses: measured, and steadied without losing the motion."""

from __future__ import annotations

import torch

from mass_engine.fitting.steadying import QUIET, jitter, steadied
from mass_engine.hand.pose import HandPose
from mass_engine.hand.rotation import axis_angle_to_matrix, matrix_to_axis_angle
from tests.engine.fitting.clips import true_poses
from tests.engine.fitting.test_registration import perturbed


def apart(one: HandPose, two: HandPose) -> float:
    """Root of the mean squared angle between the joints' rotations."""
    a, b = (axis_angle_to_matrix(pose.hand_pose.unflatten(1, (15, 3))) for pose in (one, two))
    return float(matrix_to_axis_angle(a @ b.mT).square().sum(-1).mean().sqrt())


def test_jitter_is_what_was_added() -> None:
    quiet, shaken = true_poses(60), perturbed(true_poses(60), 3, 0.2)
    assert float(jitter(quiet).max()) < 0.005
    assert abs(float(jitter(shaken)[1:].mean()) - 0.2) < 0.04


def test_a_quiet_start_is_left_alone() -> None:
    start = true_poses(40)
    assert float(jitter(start).max()) < QUIET
    torch.testing.assert_close(steadied(start).hand_pose, start.hand_pose, atol=1e-5, rtol=0)


def test_steadying_takes_most_of_the_noise_away() -> None:
    truth = true_poses(60)
    shaken = perturbed(truth, 3, 0.2)
    assert apart(steadied(shaken), truth) < 0.4 * apart(shaken, truth)


def test_few_frames_are_left_alone() -> None:
    start = perturbed(true_poses(2), 3, 0.2)
    assert torch.equal(jitter(start), torch.zeros(16))
    torch.testing.assert_close(steadied(start).hand_pose, start.hand_pose, atol=1e-5, rtol=0)
