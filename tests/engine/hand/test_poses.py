"""Named poses and poses written as numbers."""

from __future__ import annotations

import math

import pytest
import torch

from mass_engine.errors import BadArgumentError
from mass_engine.hand.builtin import joint_frames, joint_limits, load_builtin
from mass_engine.hand.pose import HandPose, Side
from mass_engine.hand.poses import POSE_NAMES, named_pose, parse_pose
from mass_engine.tracking.alignment import limit_excess

SIDES: tuple[Side, ...] = ("right", "left")


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("name", POSE_NAMES)
def test_named_poses_stay_within_the_joint_limits(name: str, side: Side) -> None:
    pose = named_pose(name, side)
    excess = limit_excess(pose.hand_pose, joint_limits(), joint_frames(load_builtin(side)))
    assert float(excess.max()) < math.radians(2)


def joints(name: str, side: Side = "right") -> torch.Tensor:
    return load_builtin(side).joints(named_pose(name, side))


@pytest.mark.parametrize("side", SIDES)
def test_named_poses_look_like_their_names(side: Side) -> None:
    rest, fist, point, pinch, spread = (
        joints(name, side) for name in ("rest", "fist", "point", "pinch", "spread")
    )
    tips, knuckles = [17, 18, 19, 20], [1, 4, 10, 7]
    # Fist: every fingertip comes back to the palm; the thumb lies in front of the fingers.
    assert ((fist[tips] - fist[knuckles]).norm(dim=1) < 0.062).all()
    assert (fist[tips, 1] < -0.01).all()
    assert fist[16, 1] < fist[17, 1]
    # Point: the index is straight, the others as in the fist.
    assert (point[17] - point[1]).norm() > 0.95 * (rest[17] - rest[1]).norm()
    assert torch.allclose(point[[18, 19, 20]], fist[[18, 19, 20]], atol=1e-6)
    # Pinch: the pads of thumb and index meet (tips at most a pad apart).
    assert (pinch[16] - pinch[17]).norm() < 0.022
    assert (pinch[18] - pinch[16]).norm() > 0.03
    # Spread: every gap between neighbouring tips grows.
    order = [16, 17, 18, 19, 20]
    gaps = [(points[order[1:]] - points[order[:-1]]).norm(dim=1) for points in (rest, spread)]
    assert (gaps[1] > gaps[0] + 0.005).all()


@pytest.mark.parametrize(
    ("name", "tip", "reach"),
    [("fist", 17, 0.006), ("fist", 18, 0.006), ("fist", 19, 0.006), ("fist", 20, 0.006)],
)
def test_the_fist_is_closed(name: str, tip: int, reach: float) -> None:
    """Each fingertip touches the palm, and no bone of it lies under the palm's skin."""
    model = load_builtin("right")
    vertices, points = model(named_pose(name, "right"))
    bone = model.weights.argmax(1)
    palm = vertices[(bone == 0) | (bone == 13)]
    last = {17: 3, 18: 6, 19: 12, 20: 9}[tip]
    assert float(torch.cdist(vertices[bone == last], palm).min()) < reach
    assert float((palm - points[last]).norm(dim=1).min()) > 0.004


@pytest.mark.parametrize("side", SIDES)
def test_the_thumb_reaches_the_little_finger(side: Side) -> None:
    model = load_builtin(side)
    vertices, points = model(named_pose("oppose", side))
    bone = model.weights.argmax(1)
    assert float(torch.cdist(vertices[bone == 15], vertices[bone == 9]).min()) < 0.004
    # The pads meet, not the nails: the thumb's tip lies on the palm's side of the little finger's last joint.
    assert points[16, 1] < points[9, 1] + 0.005


def test_left_poses_mirror_right_ones() -> None:
    flip = torch.tensor([-1.0, 1.0, 1.0])
    for name in POSE_NAMES:
        assert torch.allclose(joints(name, "left"), joints(name, "right") * flip, atol=1e-6)


def test_numbers_are_orientation_then_joints() -> None:
    values = [round(0.01 * k - 0.2, 2) for k in range(48)]
    pose = parse_pose(" " + ", ".join(map(str, values)) + " ", "left")
    assert pose.side == "left"
    assert torch.allclose(torch.cat([pose.global_orient, pose.hand_pose]), torch.tensor(values))
    assert torch.equal(pose.transl, torch.zeros(3))


def test_names_parse_as_themselves() -> None:
    for name in POSE_NAMES:
        assert torch.equal(parse_pose(name, "right").hand_pose, named_pose(name, "right").hand_pose)
    assert isinstance(parse_pose("rest", "left"), HandPose)


JUNK = [
    "", "FIST", "fist,", "nonsense", "1,2,3", "\x00",
    ",".join(["0"] * 47), ",".join(["0"] * 49), ",".join(["x"] * 48),
    ",".join(["nan"] + ["0"] * 47), ",".join(["inf"] + ["0"] * 47), ",".join(["-inf"] + ["0"] * 47),
    ",".join(["6.2832"] + ["0"] * 47), ",".join(["-7"] + ["0"] * 47), ",".join(["1e400"] + ["0"] * 47),
"," * 47, "0;" * 48,
]  # fmt: skip


@pytest.mark.parametrize("text", JUNK)
def test_junk_is_refused_with_a_stable_code(text: str) -> None:
    with pytest.raises(BadArgumentError) as caught:
        parse_pose(text, "right")
    assert caught.value.code == "pose.invalid"
    assert "rest" in caught.value.advice


def test_one_full_turn_is_still_an_angle() -> None:
    parse_pose(",".join([str(2 * math.pi)] + ["0"] * 47), "right")
