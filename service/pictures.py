"""What picture is asked for, in one canonical form, and the pictures made lately.

The engine checks poses and cameras too; here only forms that cannot name a file get through (the engine's own
command line takes cameras in other forms), and two spellings of the same request become one.
"""

from __future__ import annotations

import functools
import hashlib
import math
import re
import threading
from collections import OrderedDict
from dataclasses import dataclass
from importlib.metadata import version
from typing import Literal

from service.problems import Kind, ProblemError

PictureFormat = Literal["png", "jpeg", "webp"]
#: What of the hand is shown; the engine's names (mass_engine/channels.py says how each looks).
Channel = Literal["rgb", "alpha", "depth", "normal", "distortion", "surfels"]

POSE_VALUES = 48
MAX_SIDE = 4096
MIN_SIDE = 16
#: Camera distance in metres, and the largest component of an axis-angle vector in radians.
MIN_DISTANCE, MAX_DISTANCE = 0.02, 10.0
MAX_ANGLE = 2 * math.pi
_NAME = re.compile(r"[a-z][a-z_]{0,31}")
_FRAME = re.compile(r"frame:([0-9]{1,7})")


@dataclass(frozen=True)
class View:
    """One picture of one hand: canonical pose and camera, size in pixels, encoding, what is shown."""

    pose: str
    camera: str
    width: int
    height: int
    format: PictureFormat
    channel: Channel = "rgb"
    #: The folder of the hand in a result for both hands, else empty.
    hand: str = ""

    @property
    def media_type(self) -> str:
        """The media type of the encoded picture."""
        return f"image/{self.format}"

    def etag(self, job_id: str, artifact: str) -> str:
        """A weak tag: it names the request and the code that answers it, not the bytes."""
        text = "|".join((job_id, artifact, _version(), *map(str, vars(self).values())))
        return f'W/"{hashlib.sha256(text.encode()).hexdigest()[:32]}"'


def canonical_view(
    pose: str,
    camera: str,
    width: int,
    height: int,
    picture: PictureFormat,
    max_pixels: int,
    channel: Channel = "rgb",
) -> View:
    """The one spelling of this request. Raises ProblemError (422) for what can never be a picture."""
    if width * height > max_pixels:
        raise ProblemError(Kind.RENDER_TOO_LARGE, f"{width} x {height} is more than {max_pixels} pixels.")
    return View(_pose(pose.strip().lower()), _camera(camera.strip().lower()), width, height, picture, channel)


@functools.cache
def _version() -> str:
    return version("mass-hand")  # reads a file


def _pose(text: str) -> str:
    if frame := _FRAME.fullmatch(text):
        return f"frame:{int(frame[1])}"
    if _NAME.fullmatch(text):
        return text
    values = _numbers(text)
    if values is None or len(values) != POSE_VALUES:
        raise ProblemError(Kind.POSE_INVALID, f"A pose is a name, frame:N, or {POSE_VALUES} finite numbers.")
    if max(map(abs, values)) > MAX_ANGLE:
        raise ProblemError(Kind.POSE_INVALID, "An angle is larger than a full turn.")
    return ",".join(map(_spelled, values))


def _camera(text: str) -> str:
    if text == "source":
        return text
    values = _numbers(text.removeprefix("orbit:")) if text.startswith("orbit:") else None
    if values is None or len(values) not in (2, 3):
        raise ProblemError(Kind.CAMERA_INVALID, "A camera is source or orbit:YAW,PITCH[,DISTANCE].")
    yaw, pitch, *distance = values
    if abs(pitch) > 90:
        raise ProblemError(Kind.CAMERA_INVALID, "The pitch must lie between -90 and 90 degrees.")
    if distance and not MIN_DISTANCE <= distance[0] <= MAX_DISTANCE:
        detail = f"The distance must be {MIN_DISTANCE:g} to {MAX_DISTANCE:g} metres."
        raise ProblemError(Kind.CAMERA_INVALID, detail)
    turned = (yaw + 180.0) % 360.0 - 180.0
    return "orbit:" + ",".join(map(_spelled, (turned, pitch, *distance)))


def _numbers(text: str) -> list[float] | None:
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        return None
    return values if all(map(math.isfinite, values)) else None


def _spelled(value: float) -> str:
    return f"{round(value, 6) + 0.0:.9g}"


class PictureCache:
    """Encoded pictures, the least recently used dropped first. Thread-safe."""

    def __init__(self, max_bytes: int) -> None:
        self._max = max_bytes
        self._bytes = 0
        self._pictures: OrderedDict[tuple[str, str, View], bytes] = OrderedDict()
        self._lock = threading.Lock()

    def get(self, job_id: str, artifact: str, view: View) -> bytes | None:
        """The picture, if it is still here."""
        key = (job_id, artifact, view)
        with self._lock:
            if key in self._pictures:
                self._pictures.move_to_end(key)
            return self._pictures.get(key)

    def put(self, job_id: str, artifact: str, view: View, picture: bytes) -> None:
        """Keep the picture if there is room for it at all."""
        key = (job_id, artifact, view)
        with self._lock:
            self._bytes -= len(self._pictures.pop(key, b""))
            self._pictures[key] = picture
            self._bytes += len(picture)
            while self._bytes > self._max:
                self._bytes -= len(self._pictures.popitem(last=False)[1])

    def drop(self, job_id: str) -> None:
        """Forget every picture of a job."""
        with self._lock:
            for key in [key for key in self._pictures if key[0] == job_id]:
                self._bytes -= len(self._pictures.pop(key))
