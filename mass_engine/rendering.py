"""Rendering runs to files: the clip's frames as fitted, or any pose and camera."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from mass_engine.avatar import Avatar, straight_rgba
from mass_engine.errors import BadArgumentError


def render_frames(run: Path, frames: str, out: Path) -> int:
    """Write OUT/%06d.png of ``all``, ``holdout`` or a list of frame indices; returns how many.

    Straight-alpha RGBA at the video's upright size through the fitted camera.
    """
    avatar = Avatar.load(run)
    indices = avatar.frames.indices.tolist()
    if frames == "holdout":
        indices = avatar.frames.indices[avatar.frames.heldout].tolist()
        if not indices:
            raise BadArgumentError(
                "render.no_holdout", "No frame was held out.", "Fit with --holdout 8, say."
            )
    elif frames != "all":
        if re.fullmatch(r"\d{1,9}(,\d{1,9})*", frames) is None:
            raise BadArgumentError(
                "render.frames", f"{frames!r} names no frames.", "Use all, holdout or 12,40."
            )
        indices = [int(number) for number in frames.split(",")]
    out.mkdir(parents=True, exist_ok=True)
    for index in indices:
        picture = straight_rgba(avatar.render_pose(avatar.frames.pose_of(index), avatar.camera))
        _write(picture, out / f"{index:06d}.png")
    return len(indices)


def render_to_file(run: Path, pose: str, camera: str, size: str, out: Path) -> None:
    """Render one pose to an image file (png, jpg, webp). ``camera`` may name a JSON file."""
    match = re.fullmatch(r"(\d{1,5})x(\d{1,5})", size)
    if match is None:
        raise BadArgumentError("size.invalid", f"{size!r} is not a size.", "Use 512x512, say.")
    width, height = int(match[1]), int(match[2])
    if camera != "source" and not camera.startswith(("orbit:", "{")):
        try:
            camera = Path(camera).read_text()
        except (OSError, UnicodeDecodeError) as error:
            raise BadArgumentError(
                "camera.invalid",
                f"There is no camera file {camera!r}.",
                "Use source, orbit:YAW,PITCH or a JSON file.",
            ) from error
    _write(Avatar.load(run).render(pose, camera, width, height), out)


def _write(picture: NDArray[np.uint8], path: Path) -> None:
    bgra = cv2.cvtColor(picture, cv2.COLOR_RGBA2BGRA)
    try:
        written = cv2.imwrite(str(path), bgra)
    except cv2.error:
        written = False
    if not written:
        raise BadArgumentError("render.out", f"{path} cannot be written.", "Use a .png, .webp or .jpg path.")
