"""What the joints are called in other people's rigs."""

from __future__ import annotations

STYLES = (
    "plain", "mano", "webxr", "openxr", "godot", "mixamo",
    "three", "rigify", "deform", "blender", "unreal", "vrm",
)  # fmt: skip


def rig_name(style: str, joint: str, side: str) -> str:
    """The name of one of our 21 points in a rig of a style."""
    digit = joint.rstrip("123").removesuffix("_tip")
    step = 4 if joint.endswith("_tip") else int(joint[-1]) if joint[-1].isdigit() else 0
    thumb = digit == "thumb"
    s, side_word = side[0], side.capitalize()
    words = (
        ("metacarpal", "proximal", "distal", "tip")
        if thumb
        else ("proximal", "intermediate", "distal", "tip")
    )
    word = words[step - 1]
    if style == "plain":
        return joint
    if style == "mano":
        return f"{side}_{joint}"
    if style == "webxr":
        if not step:
            return "wrist"
        bone = word if word in ("metacarpal", "tip") else f"phalanx-{word}"
        return f"thumb-{bone}" if thumb else f"{digit}-finger-{bone}"
    if style == "openxr":
        name = "LITTLE" if digit == "pinky" else digit.upper()
        return f"XR_HAND_JOINT_{name}_{word.upper()}_EXT" if step else "XR_HAND_JOINT_WRIST_EXT"
    if style == "godot":
        name = "Little" if digit == "pinky" else digit.capitalize()
        return f"{name}_{word.capitalize()}_{s.upper()}" if step else f"Wrist_{s.upper()}"
    if style in ("mixamo", "three"):
        prefix = "mixamorig:" if style == "mixamo" else "mixamorig1"
        return f"{prefix}{side_word}Hand" + (f"{digit.capitalize()}{step}" if step else "")
    if style in ("rigify", "deform"):
        prefix = "DEF-" if style == "deform" else ""
        if not step:
            return f"{prefix}hand.{s.upper()}"
        name = "thumb" if thumb else f"f_{digit}"
        return f"{prefix}{name}.0{min(step, 3)}.{s.upper()}" + ("_end" if step == 4 else "")
    if style == "blender":
        return f"{digit}.0{step}.{s.upper()}.001" if step else f"hand.{s.upper()}"
    if style == "unreal":
        return f"{digit}_0{step}_{s}" if step else f"hand_{s}"
    if not step:
        return f"{side}Hand"
    name = "Little" if digit == "pinky" else digit.capitalize()
    return f"{side}{name}{word.capitalize()}"
