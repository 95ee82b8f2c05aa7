"""A square, rotated region of an image: what the landmark network looks at."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray


def wrap_angle(angle: float) -> float:
    """``angle`` in radians brought into [-pi, pi)."""
    return (angle + math.pi) % (2 * math.pi) - math.pi


def upward_angle(origin: NDArray[np.floating], target: NDArray[np.floating]) -> float:
    """Radians clockwise from straight up to the direction ``origin`` -> ``target`` (pixels, y down)."""
    dx, dy = (float(v) for v in target - origin)
    return wrap_angle(math.atan2(dx, -dy))


@dataclass(frozen=True)
class Region:
    """Centre (``x``, ``y``) and side ``size`` in pixels; ``angle`` in radians clockwise, 0 = fingers up."""

    x: float
    y: float
    size: float
    angle: float

    def to_image(self, side: int) -> NDArray[np.float64]:
        """The affine map [2,3] from crop coordinates (``side`` x ``side``) to image coordinates."""
        k = self.size / side
        cos, sin = math.cos(self.angle) * k, math.sin(self.angle) * k
        half = side / 2
        return np.array(
            [[cos, -sin, self.x - half * (cos - sin)], [sin, cos, self.y - half * (sin + cos)]], np.float64
        )

    def crop(self, image: NDArray[np.uint8], side: int) -> NDArray[np.uint8]:
        """The region resampled to [side,side,3]; what lies outside the image repeats its border.

        The networks were trained on crops without a half-pixel shift, so none is applied here.
        """
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        crop = cv2.warpAffine(
            image, self.to_image(side), (side, side), flags=flags, borderMode=cv2.BORDER_REPLICATE
        )
        return np.asarray(crop, np.uint8)

    def shifted(self, along_x: float, along_y: float, scale: float) -> Region:
        """Moved by fractions of its size in its own axes, then scaled about its new centre."""
        cos, sin = math.cos(self.angle), math.sin(self.angle)
        dx, dy = along_x * self.size, along_y * self.size
        return Region(
            self.x + cos * dx - sin * dy, self.y + sin * dx + cos * dy, self.size * scale, self.angle
        )

    def difference(self, other: Region) -> float:
        """How far apart two regions are: centre distance and size change in units of size, plus the turn."""
        apart = math.hypot(self.x - other.x, self.y - other.y) / self.size
        return apart + abs(math.log(other.size / self.size)) + abs(wrap_angle(other.angle - self.angle))
