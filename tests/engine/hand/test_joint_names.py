"""Joint names of the common rigs."""

from __future__ import annotations

import pytest

from mass_engine.errors import EngineError
from mass_engine.hand.joint_names import REQUIRED, apply_mapping, match_joints
from mass_engine.hand.pose import JOINT_NAMES, Side
from tests.engine.hand.rigs import STYLES, rig_name


@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize("style", STYLES)
def test_every_joint_of_the_common_rigs_is_known(style: str, side: Side) -> None:
    names = [rig_name(style, joint, side) for joint in JOINT_NAMES]
    match = match_joints(names[::-1])
    assert match.missing == []
    assert match.joints == {joint: 20 - row for row, joint in enumerate(JOINT_NAMES)}
    assert match.side == (None if style in ("webxr", "openxr", "plain") else side)


@pytest.mark.parametrize(
    ("name", "joint"),
    [
        ("index-finger-metacarpal", "wrist"),
        ("XR_HAND_JOINT_PALM_EXT", "wrist"),
        ("DEF-palm.02.R", "wrist"),
        ("b_r_pinky0", "wrist"),
        ("ring_metacarpal_r", "wrist"),
    ],
)
def test_the_bones_of_the_palm_go_with_the_wrist(name: str, joint: str) -> None:
    others = [f"pinky{n}" for n in (1, 2, 3)] + ["wrist"]
    match = match_joints([*others, name])
    assert match.folded == {4: joint}
    assert "index1" not in match.joints


def test_counting_from_nought_is_understood_where_it_cannot_be_the_palm() -> None:
    match = match_joints([f"{digit}_{n}" for digit in ("index", "thumb") for n in (0, 1, 2)])
    assert match.joints == {"index1": 0, "index2": 1, "index3": 2, "thumb1": 3, "thumb2": 4, "thumb3": 5}
    match = match_joints([f"b_l_thumb{n}" for n in (0, 1, 2, 3)])
    assert match.joints == {"thumb1": 1, "thumb2": 2, "thumb3": 3}


def test_of_two_hands_one_is_taken_whole() -> None:
    names = [rig_name("mixamo", joint, side) for side in ("left", "right") for joint in JOINT_NAMES]
    assert set(match_joints(names).joints.values()) == set(range(21, 42))
    assert set(match_joints(names, "left").joints.values()) == set(range(21))
    assert match_joints(names[:-4]).side == "left"  # the whole one


@pytest.mark.parametrize(
    "name",
    ["", "Bone.001", "index_ik_target", "IK_index1.R", "shoulder", "mixamorig:Spine2", "RightForeArm",
     "finger", "index", "ringmaster1", "indexmiddlering1", "\x00", "é1", "thumb_pinky1"],
)  # fmt: skip
def test_what_means_nothing_stays_unknown(name: str) -> None:
    assert match_joints([name]).joints == {}
    assert match_joints([name]).missing == list(REQUIRED)


def test_two_joints_of_one_meaning_are_an_error_that_names_both() -> None:
    with pytest.raises(EngineError, match=r"index1\.R.*index_01_r") as caught:
        match_joints(["index1.R", "index_01_r"])
    assert caught.value.code == "template.joints_ambiguous"


def test_a_mapping_goes_over_the_names() -> None:
    names = ["a", "b", "index1"]
    match = apply_mapping(match_joints(names), names, {"wrist": "a", "index1": "b", "side": "left"})
    assert match.joints == {"wrist": 0, "index1": 1}
    assert match.side == "left"


@pytest.mark.parametrize(
    ("mapping", "problem"),
    [
        ({"index4": "a"}, "'index4' is no joint"),
        ({"index1": "zzz"}, "zzz"),
        ({"index1": 3}, "'3'"),
        ({"index1": ["a"]}, "has not"),
        ({"side": "both"}, "'side' is no joint"),
        ({"index1": "a", "index2": "a"}, "used twice"),
        ({"wrist": "ring1"}, "used twice"),
    ],
)
def test_a_mapping_that_does_not_fit_says_why(mapping: dict[str, object], problem: str) -> None:
    names = ["a", "b", "ring1"]
    with pytest.raises(EngineError, match=problem) as caught:
        apply_mapping(match_joints(names), names, mapping)
    assert caught.value.code == "template.joint_map"
