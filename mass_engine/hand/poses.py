"""Named poses, and poses written as numbers."""

from __future__ import annotations

import math

import torch

from mass_engine.errors import BadArgumentError
from mass_engine.hand.builtin import joint_frames, load_builtin
from mass_engine.hand.model import HandModel
from mass_engine.hand.pose import HandPose, Side

#: Degrees of (flexion, abduction, twist) by joint, numbered 1 to 15 in MANO's order; what is not named is 0.
_Angles = dict[int, tuple[float, float, float]]

_CURLED: _Angles = {
    4: (87, 0, 0), 5: (101, 0, 0), 6: (73, 0, 0),
    7: (71, 8, 0), 8: (100, 0, 0), 9: (62, 0, 0),
    10: (78, 4, 0), 11: (104, 0, 0), 12: (77, 0, 0),
}  # fmt: skip
_THUMB_OVER: _Angles = {13: (28, 17, -30), 14: (27, -6, 0), 15: (58, 0, 0)}
_POSES: dict[str, _Angles] = {
    "rest": {},
    "fist": {1: (85, -2, 0), 2: (95, 0, 0), 3: (82, 0, 0), **_CURLED, **_THUMB_OVER},
    "point": {1: (4, 0, 0), 2: (4, 0, 0), **_CURLED, **_THUMB_OVER},
    "pinch": {
        1: (28, -6, 0), 2: (57, 0, 0), 3: (46, 0, 0),
        4: (22, 0, 0), 5: (26, 0, 0), 6: (12, 0, 0),
        7: (8, -4, 0), 8: (16, 0, 0), 9: (8, 0, 0),
        10: (14, 0, 0), 11: (20, 0, 0), 12: (10, 0, 0),
        13: (17, -14, 1), 14: (6, -6, 0), 15: (12, 0, 0),
    },
    "oppose": {
        1: (18, 0, 0), 2: (22, 0, 0), 3: (10, 0, 0),
        4: (26, 0, 0), 5: (28, 0, 0), 6: (14, 0, 0),
        7: (60, 6, 0), 8: (54, 0, 0), 9: (26, 0, 0),
        10: (38, 2, 0), 11: (38, 0, 0), 12: (20, 0, 0),
        13: (48, -5, -7), 14: (33, 0, 0), 15: (29, 0, 0),
    },
    "spread": {
        1: (-4, 14, 0), 4: (-2, 2, 0), 7: (-4, -16, 0), 10: (-3, -7, 0), 13: (-16, 14, 0), 15: (-8, 0, 0),
    },
}  # fmt: skip
POSE_NAMES: tuple[str, ...] = tuple(_POSES)

_ADVICE = f"Use one of {', '.join(POSE_NAMES)}, frame:N, or 48 comma-separated angles in radians."


def named_pose(name: str, side: Side, model: HandModel | None = None) -> HandPose:
    """A named pose of the mean hand at the origin, of the built-in hand or of ``model`` (of that side).

    Raises BadArgumentError ``pose.invalid``.
    """
    if name not in _POSES:
        raise BadArgumentError("pose.invalid", f"There is no pose {name[:40]!r}.", _ADVICE)
    frames = joint_frames(model or load_builtin(side))
    fingers = torch.zeros(15, 3)
    for joint, degrees in _POSES[name].items():
        # Angles about the frame's axes add up as one rotation vector.
        fingers[joint - 1] = torch.tensor(degrees) * (math.pi / 180) @ frames[joint - 1]
    rest = HandPose.rest(side)
    return HandPose(rest.betas, rest.global_orient, fingers.flatten(), rest.transl, side)


def parse_pose(spec: str, side: Side, model: HandModel | None = None) -> HandPose:
    """A pose from its name (see :func:`named_pose`) or from 48 numbers (global_orient, hand_pose; radians).

    Raises BadArgumentError ``pose.invalid``.
    """
    text = spec.strip()
    if text in _POSES:
        return named_pose(text, side, model)
    try:
        numbers = [float(part) for part in text.split(",")] if "," in text else []
    except ValueError:
        numbers = []
    if len(numbers) != 48:
        raise BadArgumentError("pose.invalid", f"The pose {text[:40]!r} is not understood.", _ADVICE)
    if not all(math.isfinite(number) and abs(number) <= 2 * math.pi for number in numbers):
        raise BadArgumentError("pose.invalid", "A pose angle is not within one turn.", _ADVICE)
    values = torch.tensor(numbers, dtype=torch.float32)
    rest = HandPose.rest(side)
    return HandPose(rest.betas, values[:3], values[3:], rest.transl, side)
