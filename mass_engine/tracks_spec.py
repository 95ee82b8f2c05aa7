"""What ``--tracks`` may say: [KIND:]PATH[,mano=FILE][,offset=N][,undistorted=yes]."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, cast

from mass_engine.errors import BadArgumentError

Kind = Literal["auto", "tracks", "wilor", "hamer", "arctic", "harp"]

_ADVICE = "Use [tracks:|wilor:|hamer:|arctic:|harp:]PATH[,mano=FILE][,offset=N][,undistorted=yes]."
_KEYS = ("mano", "offset", "undistorted")


@dataclass(frozen=True)
class TracksSpec:
    """``kind`` auto: told by the content. ``mano``: a MANO file for the kinematics of the program the poses
    are from (without it the template's own, if that is MANO). ``offset``: which row or number of the file is
    the video's first frame. ``undistorted``: the lens distortion was taken out of the video."""

    kind: Kind
    path: Path
    mano: Path | None = None
    offset: int | None = None
    undistorted: bool = False


def parse_tracks(text: str) -> TracksSpec:
    """Parse the option and see that its files are there.

    Raises BadArgumentError ``tracks.option`` or ``tracks.not_found``.
    """
    found = re.fullmatch(r"(tracks|wilor|hamer|arctic|harp):(.+)", text)
    kind, rest = (found[1], found[2]) if found else ("auto", text)
    values: dict[str, str] = {}
    # File names may hold commas and equals signs: only known keys at the end are taken off.
    while match := re.fullmatch(rf"(.+),({'|'.join(_KEYS)})=([^,]+)", rest):
        rest, key, value = match[1], match[2], match[3]
        if key in values:
            raise BadArgumentError("tracks.option", f"{key} is given twice.", _ADVICE)
        values[key] = value
    offset = values.get("offset")
    if offset is not None and not re.fullmatch(r"-?\d{1,9}", offset):
        raise BadArgumentError("tracks.option", f"The offset {offset[:40]!r} is no whole number.", _ADVICE)
    if values.get("undistorted", "yes") not in ("yes", "no"):
        raise BadArgumentError("tracks.option", "undistorted must be yes or no.", _ADVICE)
    mano = Path(values["mano"]) if "mano" in values else None
    if not Path(rest).exists():
        raise BadArgumentError("tracks.not_found", f"There is no file {rest}.", "Check the path.")
    if mano is not None and not mano.is_file():
        raise BadArgumentError("tracks.not_found", f"There is no MANO file {mano}.", "Check the path.")
    return TracksSpec(
        cast("Kind", kind),
        Path(rest),
        mano,
        None if offset is None else int(offset),
        values.get("undistorted") == "yes",
    )
