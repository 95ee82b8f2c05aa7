"""What ``--template`` may say: builtin, mano:FILE[,tips=manopth], gltf:FILE[,joints=MAP.json][,side=left]."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, cast

from mass_engine.errors import BadArgumentError

_ADVICE = "Use builtin, mano:FILE[,tips=smplx|manopth] or gltf:FILE[,joints=MAP.json][,side=left|right]."
_KEYS = {"mano": ("tips",), "gltf": ("joints", "side")}


@dataclass(frozen=True)
class TemplateSpec:
    """``path`` None: built in. ``tips``: whose fingertip vertices of MANO. ``joints``: a file that maps the
    rig's joints. ``side``: of the hand in a glTF file where that does not say."""

    kind: Literal["builtin", "mano", "gltf"]
    path: Path | None = None
    tips: str = "smplx"
    joints: Path | None = None
    side: Literal["left", "right"] | None = None


def parse_template(text: str) -> TemplateSpec:
    """Parse the option and see that its files are there.

    Raises BadArgumentError ``template.invalid`` or ``template.not_found``.
    """
    if text == "builtin":
        return TemplateSpec("builtin")
    kind, _, rest = text.partition(":")
    if kind not in _KEYS or not rest:
        raise BadArgumentError("template.invalid", f"The template {text[:80]!r} is not understood.", _ADVICE)
    values: dict[str, str] = {}
    # File names may hold commas and equals signs: only known keys at the end are taken off.
    while match := re.fullmatch(rf"(.+),({'|'.join(_KEYS[kind])})=([^,]+)", rest):
        rest, key, value = match[1], match[2], match[3]
        if key in values:
            raise BadArgumentError("template.invalid", f"{key} is given twice.", _ADVICE)
        values[key] = value
    if values.get("tips", "smplx") not in ("smplx", "manopth") or values.get("side", "left") not in (
        "left",
        "right",
    ):
        raise BadArgumentError("template.invalid", f"The template {text[:80]!r} is not understood.", _ADVICE)
    joints = Path(values["joints"]) if "joints" in values else None
    for path in (Path(rest), joints):
        if path is not None and not path.is_file():
            raise BadArgumentError("template.not_found", f"There is no file {path}.", "Check the path.")
    return TemplateSpec(
        cast('Literal["mano", "gltf"]', kind),
        Path(rest),
        values.get("tips", "smplx"),
        joints,
        cast('Literal["left", "right"] | None', values.get("side")),
    )
