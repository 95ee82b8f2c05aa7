"""The display matrix a phone writes instead of turning the pixels."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import cast

import av
import numpy as np
from av.sidedata.sidedata import SideDataContainer
from av.sidedata.sidedata import Type as SideDataType
from numpy.typing import NDArray


@dataclass(frozen=True)
class Orientation:
    """Mirror left-right first (``mirrored``), then turn ``degrees`` clockwise (0, 90, 180 or 270)."""

    degrees: int = 0
    mirrored: bool = False

    @staticmethod
    def of(picture: av.VideoFrame) -> Orientation:
        """The orientation stored with a decoded picture, to the nearest quarter turn."""
        # The stubs know a mapping of named entries only.
        container = cast(SideDataContainer, picture.side_data)
        for position in range(len(container)):
            data = container[position]
            if data.type == SideDataType.DISPLAYMATRIX:
                matrix = np.frombuffer(bytes(data), np.int32)
                return Orientation.from_matrix(matrix) if matrix.size == 9 else Orientation()
        return Orientation()

    @staticmethod
    def from_matrix(matrix: NDArray[np.int32]) -> Orientation:
        """From FFmpeg's 9 fixed-point numbers: (x, y) is shown at (a x + c y, b x + d y), y down."""
        a, b, c, d = (float(matrix[i]) for i in (0, 1, 3, 4))
        if math.hypot(a, b) == 0 or math.hypot(c, d) == 0:
            return Orientation()
        mirrored = a * d - b * c < 0
        if mirrored:
            a, b = -a, -b
        quarter = round(math.degrees(math.atan2(b, a)) / 90) % 4
        return Orientation(quarter * 90, mirrored)

    def size(self, height: int, width: int) -> tuple[int, int]:
        """(height, width) after turning."""
        return (width, height) if self.degrees in (90, 270) else (height, width)

    def apply(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The upright image [H,W,C], contiguous."""
        if self.mirrored:
            image = image[:, ::-1]
        return np.ascontiguousarray(np.rot90(image, -self.degrees // 90))
