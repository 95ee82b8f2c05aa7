"""Views: what the fit sees of each frame, as crops around the hand in a small pyramid."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mass_engine.camera import Camera
from mass_engine.tracking.segmentation import BACKGROUND, HAND, IGNORE

#: Width in pixels of the seam along ignored regions in which colours are not trusted.
SEAM = 7
#: Most points an outline is described by.
OUTLINE_POINTS = 192


@dataclass(frozen=True)
class Level:
    """One resolution of a view: ``rgb`` [h,w,3] in 0..1, ``hand`` [h,w] coverage in 0..1.

    ``valid`` [h,w] is 0 where the mask ignores, ``colored`` [h,w] also where colours may be mixed with it.
    """

    rgb: Tensor
    hand: Tensor
    valid: Tensor
    colored: Tensor
    camera: Camera

    def to(self, device: torch.device | str) -> Level:
        """The same elsewhere."""
        return Level(
            self.rgb.to(device),
            self.hand.to(device),
            self.valid.to(device),
            self.colored.to(device),
            self.camera.to(device),
        )

    def hand_window(self) -> tuple[slice, slice]:
        """Rows and columns of the hand's bounding box, a few pixels wider."""
        rows, columns = self.hand.amax(1).nonzero(), self.hand.amax(0).nonzero()
        if len(rows) == 0:
            return slice(0, 1), slice(0, 1)
        return (
            slice(max(0, int(rows[0]) - 4), int(rows[-1]) + 5),
            slice(max(0, int(columns[0]) - 4), int(columns[-1]) + 5),
        )


@dataclass(frozen=True)
class _Packed:
    """A level in bytes, as it is kept: hundreds of frames in floats would fill the memory."""

    rgb: NDArray[np.uint8]
    hand: NDArray[np.uint8]
    valid: NDArray[np.bool_]
    colored: NDArray[np.bool_]
    camera: Camera

    def level(self) -> Level:
        """Unpacked."""
        return Level(
            torch.from_numpy(self.rgb).float().div_(255),
            torch.from_numpy(self.hand).float().div_(255),
            torch.from_numpy(self.valid).float(),
            torch.from_numpy(self.colored).float(),
            self.camera,
        )


@dataclass(frozen=True)
class Outline:
    """``points`` [C,2]: where hand meets background, in pixels of the crop. ``outside`` [1,1,h,w]: distance
    in pixels from each pixel to the nearest one that is hand or ignored."""

    points: Tensor
    outside: Tensor


@dataclass
class View:
    """The crop of one frame. ``labels`` holds HandMask codes; ``coverage`` [h,w] the hand's share of each
    pixel in 0..1 (None: as the labels say); ``camera`` is the crop's own."""

    index: int
    time: float
    heldout: bool
    rgb: NDArray[np.uint8]
    labels: NDArray[np.uint8]
    camera: Camera
    points: NDArray[np.float32]  # [21,2] pixels of the whole picture
    score: float
    at_joints: bool = False  # the points are a model's joints, not the tracker's
    coverage: NDArray[np.float32] | None = None
    _levels: dict[int, _Packed] = field(default_factory=dict, repr=False)
    _outline: Outline | None = field(default=None, repr=False)

    def level(self, side: int) -> Level:
        """The view with its longer side reduced to at most ``side`` pixels (kept for the next call)."""
        side = min(side, max(self.labels.shape))  # nothing is enlarged: all larger sides are one level
        if side not in self._levels:
            self._levels[side] = self._reduce(side)
        return self._levels[side].level()

    def outline(self) -> Outline:
        """The hand's outline and the distances outside it (kept for the next call)."""
        if self._outline is None:
            self._outline = _trace(self.labels)
        return self._outline

    def _reduce(self, side: int) -> _Packed:
        height, width = self.labels.shape
        scale = min(1.0, side / max(height, width))
        w, h = max(1, round(width * scale)), max(1, round(height * scale))
        hand = (self.labels == HAND).astype(np.float32) if self.coverage is None else self.coverage
        ignore = (self.labels == IGNORE).astype(np.float32)
        # Colours next to a sleeve are mixed with it.
        near = cv2.dilate(ignore, np.ones((SEAM, SEAM), np.uint8))
        rgb = self.rgb
        if scale < 1:
            rgb = np.asarray(cv2.resize(rgb, (w, h), interpolation=cv2.INTER_AREA), np.uint8)
            hand, ignore, near = (
                cv2.resize(m, (w, h), interpolation=cv2.INTER_AREA) for m in (hand, ignore, near)
            )
        return _Packed(
            rgb,
            np.rint(hand * 255).astype(np.uint8),
            ignore < 0.5,
            near < 0.1,
            self.camera.resized(w, h),
        )


def _trace(labels: NDArray[np.uint8]) -> Outline:
    """The outline of the hand label, without what borders on ignored pixels or on the crop's edge."""
    height, width = labels.shape
    hand = (labels == HAND).astype(np.uint8)
    free = np.zeros((height, width), bool)
    free[2:-2, 2:-2] = True
    free &= cv2.dilate((labels == IGNORE).astype(np.uint8), np.ones((SEAM, SEAM), np.uint8)) == 0
    contours, _ = cv2.findContours(hand, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    pixels = np.concatenate(
        [c.reshape(-1, 2) for c in contours if len(c) >= 12] or [np.zeros((0, 2), np.int32)]
    )
    pixels = pixels[free[pixels[:, 1], pixels[:, 0]]] if len(pixels) else pixels
    if len(pixels) > OUTLINE_POINTS:
        pixels = pixels[np.linspace(0, len(pixels) - 1, OUTLINE_POINTS).round().astype(int)]
    outside = cv2.distanceTransform((labels == BACKGROUND).astype(np.uint8), cv2.DIST_L2, 3)
    return Outline(
        torch.from_numpy(pixels.astype(np.float32) + 0.5),
        torch.from_numpy(outside.astype(np.float32))[None, None],
    )
