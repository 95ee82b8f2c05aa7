"""Which joint of somebody's rig is which joint of the hand, told by its name.

Understood are the names of WebXR (``index-finger-phalanx-proximal``), OpenXR
(``XR_HAND_JOINT_INDEX_PROXIMAL_EXT``, ``Index_Proximal_R``), MANO (``right_index1``), Mixamo
(``mixamorig:RightHandIndex1``), Blender (``f_index.01.R``, ``DEF-thumb.02.L``), and what resembles them
(Unreal, VRM, Unity). A name is cut into words; a word that means nothing here makes the joint unknown
rather than a guess.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from mass_engine.errors import EngineError
from mass_engine.hand.pose import JOINT_NAMES, Side

_DIGITS = {
    "thumb": "thumb", "index": "index", "pointer": "index", "middle": "middle", "mid": "middle",
    "ring": "ring", "pinky": "pinky", "pinkie": "pinky", "little": "pinky",
}  # fmt: skip
_PARTS = {
    "metacarpal": "metacarpal", "meta": "metacarpal", "carpal": "metacarpal", "palm": "metacarpal",
    "proximal": "proximal", "prox": "proximal",
    "intermediate": "intermediate", "intermediary": "intermediate", "medial": "intermediate",
    "distal": "distal", "dist": "distal",
    "tip": "tip", "end": "tip", "nub": "tip",
}  # fmt: skip
_SIDES: dict[str, Side] = {"l": "left", "left": "left", "r": "right", "right": "right"}
_FILLERS = frozenset(
    (
        *(
            "hand",
            "finger",
            "fingers",
            "phalanx",
            "phalange",
            "joint",
            "jnt",
            "bone",
            "bn",
            "xr",
            "ext",
            "def",
        ),
        *("deform", "f", "b", "j", "sk", "bind", "rig", "armature"),
    )
)
#: Joints every rig must have; fingertips are found on the mesh where the rig has none.
REQUIRED: tuple[str, ...] = JOINT_NAMES[:16]
ADVICE = (
    "Rename the joints, or give a mapping file, gltf:FILE,joints=MAP.json, that holds the file's name of "
    'each: {"wrist": "Bone", "index1": "Bone.001", ...}: wrist, then index, middle, ring, pinky and thumb 1 '
    "to 3 from the knuckle outwards, and index_tip and so on where there are any."
)


@dataclass(frozen=True)
class JointMatch:
    """``joints``: row of the rig by name in :data:`JOINT_NAMES`. ``folded``: rows that are no joint of ours
    but belong to one by their name (metacarpals and palms to the wrist)."""

    side: Side | None
    joints: dict[str, int]
    folded: dict[int, str]

    @property
    def missing(self) -> list[str]:
        """Required joints without a match."""
        return [name for name in REQUIRED if name not in self.joints]


@dataclass(frozen=True)
class _Word:
    """A name taken apart: ``digit`` None is the wrist or the palm; ``part`` a word or a number."""

    side: Side | None
    digit: str | None
    part: str


def match_joints(names: Sequence[str], side: Side | None = None) -> JointMatch:
    """Match the joints of a rig, of the hand of ``side`` (None: of the one with more matches).

    Raises EngineError ``template.joints_ambiguous`` when two joints have the same meaning.
    """
    words = [_understand(name) for name in names]
    sides: tuple[Side, ...] = (side,) if side is not None else ("right", "left")
    found = [_match(names, words, choice) for choice in sides]
    best = max(found, key=lambda match: len(match.joints))
    named = any(word is not None and word.side == best.side for word in words)
    return best if named else JointMatch(None, best.joints, best.folded)


def _understand(name: str) -> _Word | None:
    text = re.split(r"[:|]", name)[-1]
    text = re.sub(r"^mixamorig\d*", "", text)
    text = re.sub(
        r"(?<=[a-z])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])|(?<=[A-Za-z])(?=\d)|(?<=\d)(?=[A-Za-z])", " ", text
    )
    side: Side | None = None
    digits, parts, numbers, rest = [], [], [], []
    for word in re.findall(r"[A-Za-z]+|\d+", text):
        key = word.lower()
        if key in _DIGITS:
            digits.append(_DIGITS[key])
        elif key in _PARTS:
            parts.append(_PARTS[key])
        elif key in _SIDES:
            side = side or _SIDES[key]
        elif key.isdigit():
            numbers.append(key)
        elif key in _FILLERS:
            rest.append(key)
        elif key == "wrist":
            rest.append("wrist")
        else:
            return None
    if len(digits) == 2 and "middle" in digits:  # the middle joint of another finger
        digits.remove("middle")
        parts.append("intermediate")
    if len(digits) > 1:
        return None
    if not digits:
        if "metacarpal" in parts:
            return _Word(side, None, "palm")
        if parts or not ({"wrist", "hand"} & set(rest)):
            return None
        return _Word(side, None, "wrist" if "wrist" in rest else "hand")
    if parts:
        return _Word(side, digits[0], "tip" if "tip" in parts else parts[0])
    return _Word(side, digits[0], str(int(numbers[0]))) if numbers else None


def _match(names: Sequence[str], words: Sequence[_Word | None], side: Side) -> JointMatch:
    usable = [(row, word) for row, word in enumerate(words) if word is not None and word.side in (None, side)]
    joints: dict[str, int] = {}
    folded: dict[int, str] = {}
    roots = {word.part: row for row, word in reversed(usable) if word.digit is None}
    if "wrist" in roots or "hand" in roots:
        joints["wrist"] = roots.get("wrist", roots.get("hand", 0))
    folded.update({row: "wrist" for row, word in usable if word.digit is None and row != joints.get("wrist")})
    for digit in ("index", "middle", "pinky", "ring", "thumb"):
        own = [(row, word.part) for row, word in usable if word.digit == digit]
        steps = _steps(digit, {part for _, part in own})
        for row, part in own:
            step = steps.get(part)
            if step == "palm":
                folded[row] = "wrist"
            elif step is not None:
                key = f"{digit}_tip" if step == "tip" else f"{digit}{step}"
                if key in joints:
                    raise EngineError(
                        "template.joints_ambiguous",
                        f"Both {names[joints[key]][:60]!r} and {names[row][:60]!r} could be {key}.",
                        ADVICE,
                    )
                joints[key] = row
    return JointMatch(side, joints, folded)


def _steps(digit: str, parts: set[str]) -> dict[str, str]:
    """What each part of a digit's names means: 1, 2, 3, tip, or palm (belongs to the wrist)."""
    if digit == "thumb" and "metacarpal" in parts:
        words = {"metacarpal": "1", "proximal": "2", "intermediate": "2", "distal": "3"}
    elif digit == "thumb":
        words = {"proximal": "1", "intermediate": "2", "distal": "3"}
    else:
        words = {"metacarpal": "palm", "proximal": "1", "intermediate": "2", "distal": "3"}
    if "0" in parts and "3" not in parts:
        numbers = {"0": "1", "1": "2", "2": "3"}
    else:
        numbers = {"0": "palm", "1": "1", "2": "2", "3": "3", "4": "tip"}
    if "tip" in parts:
        numbers.pop("4", None)
    return {**words, **numbers, "tip": "tip"}


def apply_mapping(match: JointMatch, names: Sequence[str], mapping: dict[str, object]) -> JointMatch:
    """``match`` with what the user's mapping says put over it.

    ``mapping`` holds the rig's name of joints in :data:`JOINT_NAMES`, and may hold ``side``.

    Raises EngineError ``template.joint_map``.
    """
    side, joints = match.side, dict(match.joints)
    for key, value in mapping.items():
        if key == "side" and value in ("left", "right"):
            side = value
            continue
        if key not in JOINT_NAMES:
            problem = f"{key[:40]!r} is no joint; joints are {', '.join(JOINT_NAMES)}"
        elif not isinstance(value, str) or value not in names:
            problem = f"{key} is said to be {str(value)[:60]!r}, which the file has not"
        else:
            joints[key] = names.index(value)
            continue
        raise EngineError(
            "template.joint_map",
            f"The mapping file does not fit: {problem}.",
            f"The file's joints are {', '.join(name[:40] for name in names[:60])}.",
        )
    used = set(joints.values())
    if len(used) < len(joints):
        rows = list(joints.values())
        twice = next(name for name, row in joints.items() if rows.count(row) > 1)
        raise EngineError(
            "template.joint_map",
            f"The joint {names[joints[twice]][:60]!r} is used twice, also for {twice}.",
            "Name a joint of its own for each, also for those the mapping file leaves to their names.",
        )
    return JointMatch(side, joints, {row: name for row, name in match.folded.items() if row not in used})
