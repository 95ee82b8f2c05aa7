"""Camera specifications: ``source``, ``orbit:YAW,PITCH[,METRES]`` or a JSON object."""

from __future__ import annotations

import json
import math

import torch
from torch import Tensor

from mass_engine.camera import Camera
from mass_engine.errors import BadArgumentError

_ADVICE = (
    "Use source, orbit:YAW,PITCH or orbit:YAW,PITCH,METRES (degrees), "
    "or a JSON object with K, world_to_camera, width and height."
)
_MOST_PIXELS = 64_000_000
#: How much of the shorter image side the hand's bounding sphere fills when no distance is given.
_FILL = 0.95


def parse_camera(spec: str, source: Camera, width: int, height: int, center: Tensor, radius: float) -> Camera:
    """The camera that ``spec`` describes for a picture of ``width`` x ``height`` pixels.

    ``source`` is the fitted camera; an orbit looks at ``center`` [3] (world metres), where the hand fits
    into a sphere of ``radius`` metres. Yaw moves the camera to the right, pitch up.

    Raises BadArgumentError ``camera.invalid``.
    """
    text = spec.strip()
    if text == "source":
        return fit_source(source, width, height)
    if text.startswith("orbit:"):
        return _orbit(text.removeprefix("orbit:"), source, width, height, center, radius)
    if text.startswith("{"):
        return _from_json(text).resized(width, height)
    raise BadArgumentError("camera.invalid", f"The camera {spec[:80]!r} is not understood.", _ADVICE)


def fit_source(source: Camera, width: int, height: int) -> Camera:
    """The fitted camera for another picture size: scaled evenly, so that the whole view stays in it."""
    scale = min(width / source.width, height / source.height)
    K = source.K.clone()
    K[:2, :2] *= scale
    K[0, 2] = (source.K[0, 2] - source.width / 2) * scale + width / 2
    K[1, 2] = (source.K[1, 2] - source.height / 2) * scale + height / 2
    return Camera(K, source.world_to_camera, width, height)


def _orbit(text: str, source: Camera, width: int, height: int, center: Tensor, radius: float) -> Camera:
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in (2, 3) or not all(math.isfinite(number) for number in numbers):
        raise BadArgumentError(
            "camera.invalid", f"The orbit {text[:80]!r} is not two or three numbers.", _ADVICE
        )
    yaw, pitch = (math.radians(number % 360) for number in numbers[:2])
    focal = float(source.K[0, 0]) / max(source.width, source.height) * min(width, height)
    half_angle = math.atan(0.5 * min(width, height) * _FILL / focal)
    distance = numbers[2] if len(numbers) == 3 else radius / math.sin(half_angle)
    if not 0.02 <= distance <= 100:
        raise BadArgumentError(
            "camera.invalid", f"The distance {distance} m is out of range.", "Use 0.02 to 100 m."
        )
    K = torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
    # From the source camera's axes: turn by yaw about its vertical, then by pitch about its horizontal.
    cy, sy, cp, sp = math.cos(yaw), math.sin(yaw), math.cos(pitch), math.sin(pitch)
    turn_yaw = torch.tensor([[cy, 0.0, sy], [0.0, 1.0, 0.0], [-sy, 0.0, cy]])
    turn_pitch = torch.tensor([[1.0, 0.0, 0.0], [0.0, cp, -sp], [0.0, sp, cp]])
    rotation = turn_pitch @ turn_yaw @ source.world_to_camera[:3, :3]
    world_to_camera = torch.eye(4)
    world_to_camera[:3, :3] = rotation
    world_to_camera[:3, 3] = torch.tensor([0.0, 0.0, distance]) - rotation @ center
    return Camera(K, world_to_camera, width, height)


def _from_json(text: str) -> Camera:
    try:
        data = json.loads(text)
        K = torch.tensor(data["K"], dtype=torch.float32).reshape(3, 3)
        world_to_camera = torch.tensor(data["world_to_camera"], dtype=torch.float32).reshape(4, 4)
        width, height = int(data["width"]), int(data["height"])
    except (ValueError, KeyError, TypeError, RuntimeError, OverflowError, RecursionError) as error:
        raise BadArgumentError("camera.invalid", "The camera's JSON is not complete.", _ADVICE) from error
    finite = bool(torch.isfinite(K).all()) and bool(torch.isfinite(world_to_camera).all())
    rotation = world_to_camera[:3, :3]
    rigid = finite and torch.allclose(rotation @ rotation.T, torch.eye(3), atol=1e-3)
    sized = 0 < width <= 1 << 16 and 0 < height <= 1 << 16 and width * height <= _MOST_PIXELS
    if not (rigid and sized and float(K[0, 0]) > 0 and float(K[1, 1]) > 0):
        raise BadArgumentError("camera.invalid", "The camera's numbers do not make a camera.", _ADVICE)
    return Camera(K, world_to_camera, width, height)
