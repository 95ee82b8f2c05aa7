"""A moving hand: a list of poses, or a turn around one, as a video or an animated picture."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from mass_engine.avatar import Avatar, row_pose
from mass_engine.device import choose_device
from mass_engine.errors import BadArgumentError, EngineError
from mass_engine.hand.pose import HandPose
from mass_engine.many_poses import draw_images
from mass_engine.tracking.alignment import interpolate_pose
from mass_engine.video.writer import write_video
from mass_engine.viewpoint import parse_camera

MAX_FRAMES = 3000
_ADVICE = "See `mass-engine animate --help` for what a motion file holds."


@dataclass(frozen=True)
class Motion:
    """What to show. ``kind``: ``poses`` or ``turntable`` (of the first pose).

    ``between``: pictures put between two poses (rotations by slerp); ``loop``: back to the first pose.
    A turntable lasts ``seconds``. ``format``: ``mp4`` (on white) or ``webp`` (with alpha).
    """

    kind: str = "turntable"
    poses: tuple[str, ...] = ("rest",)
    between: int = 11
    loop: bool = True
    seconds: float = 4.0
    camera: str = "orbit:0,0"
    width: int = 512
    height: int = 512
    fps: float = 30.0
    format: str = "mp4"


def read_motion(path: Path) -> Motion:
    """A motion from a JSON file with the fields of :class:`Motion`. Raises BadArgumentError."""
    try:
        values = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise BadArgumentError("motion.invalid", f"{path.name} is not a readable motion.", _ADVICE) from error
    if not isinstance(values, dict):
        raise BadArgumentError("motion.invalid", "A motion is a JSON object.", _ADVICE)
    return parse_motion(values)


def parse_motion(values: Mapping[str, Any]) -> Motion:
    """Check and complete. Raises BadArgumentError ``motion.invalid``."""
    known = Motion.__dataclass_fields__
    if unknown := sorted(set(values) - set(known)):
        raise BadArgumentError("motion.invalid", f"A motion has no {unknown[0]!r}.", _ADVICE)
    poses = values.get("poses", Motion.poses)
    if not isinstance(poses, list | tuple) or not poses or not all(isinstance(pose, str) for pose in poses):
        raise BadArgumentError("motion.invalid", "The poses are a list of texts.", _ADVICE)
    motion = Motion(**{**values, "poses": tuple(poses)})
    whole = (motion.between, motion.width, motion.height)
    real = (motion.seconds, motion.fps)
    if (
        motion.kind not in ("poses", "turntable")
        or motion.format not in ("mp4", "webp")
        or not isinstance(motion.loop, bool)
        or not isinstance(motion.camera, str)
        or not all(isinstance(value, int) and not isinstance(value, bool) for value in whole)
        or not all(isinstance(value, int | float) and math.isfinite(value) for value in real)
        or not (0 <= motion.between <= 1000 and 1 <= motion.width <= 4096 and 1 <= motion.height <= 4096)
        or not (0 < motion.seconds <= 600 and 1 <= motion.fps <= 120)
    ):
        raise BadArgumentError("motion.invalid", "A value of the motion is out of range.", _ADVICE)
    if frame_count(motion) > MAX_FRAMES:
        raise BadArgumentError(
            "motion.too_long", f"That makes {frame_count(motion)} pictures.", f"Stay below {MAX_FRAMES}."
        )
    return motion


def frame_count(motion: Motion) -> int:
    """How many pictures the motion has."""
    if motion.kind == "turntable":
        return max(round(motion.seconds * motion.fps), 1)
    gaps = len(motion.poses) if motion.loop else len(motion.poses) - 1
    if len(motion.poses) == 1:
        gaps = 0
    return gaps * (motion.between + 1) + (0 if motion.loop and gaps else 1)


def pictures(
    avatar: Avatar, motion: Motion, device: torch.device | None = None
) -> Iterator[NDArray[np.uint8]]:
    """Straight-alpha RGBA uint8 [H,W,4], one a frame. One camera distance holds for all of them.

    ``device``: where they are rendered (None: the CPU).
    """
    poses = [avatar.resolve_pose(spec) for spec in motion.poses]
    count = frame_count(motion)
    rows = poses[0] if motion.kind == "turntable" else _between(poses, motion, count)
    center, radius = _bounds(avatar, poses)
    turning = motion.kind == "turntable"
    cameras = [
        parse_camera(
            _turned(motion.camera, 360.0 * number / count if turning else 0.0),
            avatar.camera,
            motion.width,
            motion.height,
            center,
            radius,
        )
        for number in range(count)
    ]
    each = [rows if turning else row_pose(rows, number) for number in range(count)]
    for image in draw_images(avatar, each, cameras, "rgb", device or torch.device("cpu")):
        yield image.picture()


def animate(
    source: Path,
    motion: Motion,
    out: Path,
    report: Callable[[float], None] | None = None,
    device: str = "cpu",
) -> Path:
    """Write ``out/motion.mp4`` or ``out/motion.webp`` of the avatar at ``source``; returns the file.

    ``report`` gets the fraction done. Raises EngineError and BadArgumentError.
    """
    on = choose_device(device)
    avatar = Avatar.load(source)
    target = out / f"motion.{motion.format}"
    out.mkdir(parents=True, exist_ok=True)
    total = frame_count(motion)

    def counted() -> Iterator[NDArray[np.uint8]]:
        for number, picture in enumerate(pictures(avatar, motion, on)):
            yield picture
            if report is not None:
                report((number + 1) / total)

    if motion.format == "mp4":
        write_video(target, map(_on_white, counted()), motion.fps)
    else:
        _write_webp(target, list(counted()), motion.fps)
    return target


def _between(poses: list[HandPose], motion: Motion, count: int) -> HandPose:
    """All poses of the motion [count], interpolated."""
    keys = [*poses, poses[0]] if motion.loop and len(poses) > 1 else poses
    stacked = HandPose(
        torch.cat([pose.betas for pose in keys]),
        torch.cat([pose.global_orient for pose in keys]),
        torch.cat([pose.hand_pose for pose in keys]),
        torch.cat([pose.transl for pose in keys]),
        keys[0].side,
    )
    step = 1.0 / (motion.between + 1)
    return interpolate_pose(stacked, [float(n) for n in range(len(keys))], [n * step for n in range(count)])


def _bounds(avatar: Avatar, poses: list[HandPose]) -> tuple[torch.Tensor, float]:
    """Centre [3] and radius of a sphere around the hand in all of these poses."""
    with torch.no_grad():
        model, displacement = avatar.shape.model, avatar.shape.displacement
        vertices = torch.cat([model.posed(pose, displacement).vertices[0] for pose in poses])
    center = (vertices.amax(0) + vertices.amin(0)) / 2
    return center, float((vertices - center).norm(dim=-1).max())


def _turned(camera: str, degrees: float) -> str:
    if degrees == 0.0:
        return camera
    if not camera.startswith("orbit:"):
        raise BadArgumentError("camera.invalid", "A turntable needs an orbit.", "Use orbit:YAW,PITCH.")
    yaw, _, rest = camera.removeprefix("orbit:").partition(",")
    try:
        return f"orbit:{float(yaw) + degrees},{rest}"
    except ValueError:
        raise BadArgumentError(
            "camera.invalid", f"{camera[:80]!r} is no orbit.", "Use orbit:YAW,PITCH."
        ) from None


def _on_white(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    alpha = picture[..., 3:].astype(np.float32) / 255.0
    flat = picture[..., :3] * alpha + 255.0 * (1.0 - alpha)
    rounded: NDArray[np.uint8] = np.rint(flat).astype(np.uint8)
    return rounded


def _write_webp(target: Path, frames: list[NDArray[np.uint8]], fps: float) -> None:
    animation = cv2.Animation()
    animation.frames = [cv2.cvtColor(frame, cv2.COLOR_RGBA2BGRA) for frame in frames]
    # Whole milliseconds, rounded so that they add up.
    ends = [round(1000 * (number + 1) / fps) for number in range(len(frames))]
    animation.durations = [end - start for start, end in pairwise([0, *ends])]
    part = target.with_name(f".{target.name}.part.webp")
    if not cv2.imwriteanimation(str(part), animation, [cv2.IMWRITE_WEBP_QUALITY, 85]):
        raise EngineError("motion.write", "The animation could not be written.", "Try the format mp4.")
    part.replace(target)
