"""Rendering runs to files: the clip's frames as fitted, or any pose and camera."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from mass_engine.avatar import Avatar
from mass_engine.channels import parse_channel
from mass_engine.device import choose_device
from mass_engine.errors import BadArgumentError
from mass_engine.many_poses import draw_images

#: The suffix of a file of numbers: one NumPy array, for any program that reads arrays.
_NUMBERS = ".npy"


def render_frames(run: Path, frames: str, out: Path, channel: str = "rgb", device: str = "cpu") -> int:
    """Write OUT/%06d.png of ``all``, ``holdout`` or a list of frame indices; returns how many.

    Straight-alpha RGBA at the video's upright size through the fitted camera; each picture's ``channel`` has
    its own scale (see ``mass_engine.channels``).
    """
    wanted = parse_channel(channel)
    if out.suffix == _NUMBERS:
        raise BadArgumentError(
            "render.out", "Frames go into a directory, as pictures.", "Use --pose frame:12 for numbers."
        )
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
    poses = [avatar.frames.pose_of(index) for index in indices]
    images = draw_images(avatar, poses, [avatar.camera] * len(poses), wanted, choose_device(device))
    for index, image in zip(indices, images, strict=True):
        _write(image.picture(), out / f"{index:06d}.png")
    return len(indices)


def render_to_file(
    run: Path, pose: str, camera: str, size: str, out: Path, channel: str = "rgb", device: str = "cpu"
) -> None:
    """Render one pose to an image file (png, jpg, webp), or its channel's numbers to a ``.npy`` file.

    ``camera`` may name a JSON file.
    """
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
    parse_channel(channel)  # a wrong word is told before the avatar is read
    on = choose_device(device)
    avatar = Avatar.load(run)
    if on.type == "cpu":
        image = avatar.view(pose, camera, width, height, channel)
    else:
        posed, seen = avatar.resolve_view(pose, camera, width, height)
        (image,) = draw_images(avatar, [posed], [seen], parse_channel(channel), on)
    if out.suffix == _NUMBERS:
        _write_numbers(image.numbers(), out)
    else:
        _write(image.picture(), out)


def _write_numbers(values: NDArray[np.float32], path: Path) -> None:
    try:
        np.save(path, values)
    except OSError as error:
        raise BadArgumentError(
            "render.out", f"{path} cannot be written.", "Use a path in a directory that exists."
        ) from error


def _write(picture: NDArray[np.uint8], path: Path) -> None:
    bgra = cv2.cvtColor(picture, cv2.COLOR_RGBA2BGRA)
    try:
        written = cv2.imwrite(str(path), bgra)
    except cv2.error:
        written = False
    if not written:
        raise BadArgumentError(
            "render.out", f"{path} cannot be written.", "Use a .png, .webp, .jpg or .npy path."
        )
