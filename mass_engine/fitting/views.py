"""Views: what the fit sees of each frame, as crops around the hand in a small pyramid."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mass_engine.camera import Camera
from mass_engine.tracking.segmentation import HAND, IGNORE


@dataclass(frozen=True)
class Level:
    """One resolution of a view: ``rgb`` [h,w,3] in 0..1, ``hand`` [h,w] coverage in 0..1, ``valid`` [h,w]."""

    rgb: Tensor
    hand: Tensor
    valid: Tensor
    camera: Camera


@dataclass
class View:
    """The crop of one frame. ``labels`` holds HandMask codes; ``camera`` is the crop's own."""

    index: int
    time: float
    heldout: bool
    rgb: NDArray[np.uint8]
    labels: NDArray[np.uint8]
    camera: Camera
    points: NDArray[np.float32]  # [21,2] pixels of the crop
    score: float
    _levels: dict[int, Level] = field(default_factory=dict, repr=False)

    def level(self, side: int) -> Level:
        """The view with its longer side reduced to at most ``side`` pixels (kept for the next call)."""
        if side not in self._levels:
            self._levels[side] = self._reduce(side)
        return self._levels[side]

    def forget_levels(self) -> None:
        """Drop the kept reductions (they are a few times the crop's own memory)."""
        self._levels.clear()

    def _reduce(self, side: int) -> Level:
        height, width = self.labels.shape
        scale = min(1.0, side / max(height, width))
        w, h = max(1, round(width * scale)), max(1, round(height * scale))
        hand = (self.labels == HAND).astype(np.float32)
        ignore = (self.labels == IGNORE).astype(np.float32)
        rgb = self.rgb
        if scale < 1:
            rgb = cv2.resize(rgb, (w, h), interpolation=cv2.INTER_AREA)
            hand, ignore = (cv2.resize(m, (w, h), interpolation=cv2.INTER_AREA) for m in (hand, ignore))
        return Level(
            torch.from_numpy(rgb.astype(np.float32) / 255),
            torch.from_numpy(hand),
            torch.from_numpy((ignore < 0.5).astype(np.float32)),
            self.camera.resized(w, h),
        )


def crop_box(points: NDArray[np.float32], width: int, height: int, margin: float) -> tuple[int, int, int, int]:
    """The box (x, y, w, h) around ``points`` [21,2], ``margin`` hand sizes wider on each side, in the image."""
    low, high = points.min(0), points.max(0)
    reach = margin * float((high - low).max())
    x0, y0 = (int(max(0, np.floor(v - reach))) for v in low)
    x1 = int(min(width, np.ceil(high[0] + reach)))
    y1 = int(min(height, np.ceil(high[1] + reach)))
    return x0, y0, max(1, x1 - x0), max(1, y1 - y0)
