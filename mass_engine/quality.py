"""How good a clip is for a fit: measures of each frame, and the gate every clip passes before any fitting.

Thresholds lie between what was measured on good clips (real phone videos and rendered ones) and on copies
of them that were blurred, darkened or shrunk; the comments give both.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from mass_engine.errors import EngineError
from mass_engine.tracking.landmarks import (
    INDEX_1,
    MIDDLE_1,
    PINKY_1,
    RING_1,
    THUMB_1,
    WRIST,
    HandLandmarks,
)
from mass_engine.video.reader import Frame

#: The longer side of a hand's box when its sharpness is measured, pixels: hands of any size compare.
SCALE = 128
_PALM = (WRIST, THUMB_1, INDEX_1, MIDDLE_1, RING_1, PINKY_1)
_BLACK, _WHITE = 6, 250

_SHARP = 0.018  # of the sharpest quarter: good clips 0.07 to 0.3, blurred by 1 % of the hand's size 0.01
_DIM, _DARK = 40.0, 14.0  # grey value of the palm: good clips 90 to 190, dark skin included
_NIGHT = 40.0  # grey value that 90 % of a whole picture stays below when no hand is found in it
_SMALL = 100.0  # pixels, diagonal of the landmarks' box; below 40 the tracker refuses
_WHOLE_SHARE, _INSIDE = 0.25, 0.7  # good clips 0.97 and 1; half a picture wide enough for the hand 0.15
_VARIETY = 0.12  # good clips 0.4 to 0.7; a hand that is held still 0.03
_OTHER_FRAMES, _OTHER_SHARE = 10, 0.05


@dataclass(frozen=True)
class FrameQuality:
    """One hand in one frame.

    ``sharpness`` is the variance of the Laplacian over the variance of the grey values inside the hand's
    box, scaled to :data:`SCALE` pixels (Pech-Pacheco et al. 2000, made independent of contrast);
    ``light`` the palm's median grey value, 0 to 255; ``clipped`` the share of the box that is black or
    burnt out; ``inside`` the share of the landmarks that lie in the picture.
    """

    sharpness: float
    light: float
    clipped: float
    inside: float


@dataclass(frozen=True)
class Finding:
    """One thing the gate found: a stable code, what is wrong, what to do. ``fatal`` ends the job."""

    code: str
    message: str
    advice: str
    fatal: bool = False


def measure(rgb: NDArray[np.uint8], points: NDArray[np.floating]) -> FrameQuality:
    """Measure the hand with landmarks ``points`` [21,2] in pixels of the frame ``rgb`` uint8 [H,W,3]."""
    height, width = rgb.shape[:2]
    low = np.clip(np.floor(points.min(0)), 0, (width - 1, height - 1)).astype(int)
    high = np.clip(np.ceil(points.max(0)), low + 1, (width, height)).astype(int)
    crop = np.ascontiguousarray(rgb[low[1] : high[1], low[0] : high[0]])
    grey = np.asarray(cv2.cvtColor(crop, cv2.COLOR_RGB2GRAY), np.uint8)
    k = SCALE / max(grey.shape)
    size = max(2, round(grey.shape[1] * k)), max(2, round(grey.shape[0] * k))
    flags = cv2.INTER_AREA if k < 1 else cv2.INTER_LINEAR
    small = cv2.resize(grey, size, interpolation=flags).astype(np.float32)
    edges = cv2.Laplacian(small, cv2.CV_32F, ksize=1)
    palm = np.zeros(grey.shape, np.uint8)
    outline = np.round(points[list(_PALM)] - low).astype(np.int32)
    cv2.fillConvexPoly(palm, cv2.convexHull(outline), 1)
    inside = ((points >= 0) & (points < (width, height))).all(1).mean()
    return FrameQuality(
        float(edges.var()) / max(float(small.var()), 1.0),
        float(np.median(grey[palm > 0])) if palm.any() else float(np.median(grey)),
        float(((grey <= _BLACK) | (grey >= _WHITE)).mean()),
        float(inside),
    )


@dataclass
class QualityMeter:
    """Collects the quality of every hand seen, frame by frame, in the pass that tracks them."""

    _hands: dict[tuple[int, int], FrameQuality] = field(default_factory=dict)
    _light: list[float] = field(default_factory=list)

    def add(self, frame: Frame, hands: Sequence[HandLandmarks]) -> None:
        """Measure ``hands`` in ``frame``."""
        self._light.append(float(np.percentile(frame.rgb[::8, ::8], 90)))
        for hand in hands:
            self._hands[frame.index, hand.track] = measure(frame.rgb, hand.points)

    def of(self, hands: Sequence[HandLandmarks]) -> dict[int, FrameQuality]:
        """The quality of ``hands`` by frame index."""
        return {hand.index: self._hands[hand.index, hand.track] for hand in hands}

    def explain(self, error: EngineError) -> EngineError:
        """``error`` of the tracker, or the reason behind it: in the dark no hand can be found."""
        if error.code == "video.no_hand" and self._light and float(np.median(self._light)) < _NIGHT:
            return EngineError("video.too_dark", "The video is too dark to find a hand in it.", _LIGHT)
        return error


_LIGHT = "Film by daylight or a bright lamp in front of the hand."


def check_clip(
    hands: Sequence[HandLandmarks], quality: Mapping[int, FrameQuality], other_hands: int = 0
) -> list[Finding]:
    """What is wrong with a clip whose main hand is ``hands`` (frames to fit only, in order).

    ``other_hands`` counts the frames in which another hand of the same side is seen beside it. No hand at
    all, or one below 40 pixels, is the tracker's to refuse.
    """
    measures = [quality[hand.index] for hand in hands]
    found = [
        _size(hands),
        _light(measures),
        _sharpness(measures),
        _crop(measures),
        _motion(hands),
        _people(len(hands), other_hands),
    ]
    return [finding for finding in found if finding is not None]


def _size(hands: Sequence[HandLandmarks]) -> Finding | None:
    scale = float(np.median([hand.scale for hand in hands]))
    if scale >= _SMALL:
        return None
    return Finding(
        "video.hand_too_small",
        f"The hand is only {scale:.0f} pixels across, so its surface will be coarse.",
        "Move the camera closer until the hand fills at least a quarter of the picture.",
    )


def _light(measures: Sequence[FrameQuality]) -> Finding | None:
    light = float(np.median([m.light for m in measures]))
    if light >= _DIM:
        return None
    message = f"The hand is dark: grey value {light:.0f} of 255."
    return Finding("video.too_dark", message, _LIGHT, fatal=light < _DARK)


def _sharpness(measures: Sequence[FrameQuality]) -> Finding | None:
    sharpness = float(np.percentile([m.sharpness for m in measures], 75))
    if sharpness >= _SHARP:
        return None
    return Finding(
        "video.too_blurred",
        "Even the sharpest frames show the hand blurred, so its surface will be smooth.",
        "Wipe the lens, let the camera focus on the hand, and move more slowly in brighter light.",
    )


def _crop(measures: Sequence[FrameQuality]) -> Finding | None:
    inside = np.array([m.inside for m in measures])
    if float((inside == 1).mean()) >= _WHOLE_SHARE:
        return None
    return Finding(
        "video.hand_cropped",
        f"The picture's edge cuts the hand in {int((inside < 1).sum())} of {len(inside)} frames.",
        "Keep the whole hand with its wrist inside the picture.",
        fatal=float(inside.max()) < _INSIDE,
    )


def _motion(hands: Sequence[HandLandmarks]) -> Finding | None:
    shapes = pose_shapes(hands)
    turned = shapes * _phase(shapes @ shapes[len(shapes) // 2].conj())[:, None].conj()
    mean = turned.mean(0) / max(float(np.linalg.norm(turned.mean(0))), 1e-9)
    if float(np.percentile(pose_distances(shapes, mean), 90)) >= _VARIETY:
        return None
    return Finding(
        "video.too_little_motion",
        "The hand hardly moves, so only one side of it is seen.",
        "Turn the hand slowly and open and close the fingers while filming.",
    )


def _people(frames: int, others: int) -> Finding | None:
    if others < max(_OTHER_FRAMES, _OTHER_SHARE * frames):
        return None
    return Finding(
        "video.several_people",
        f"Another hand of the same side is in {others} frames; the most prominent one is taken.",
        "Film the hand of one person alone.",
    )


def pose_shapes(hands: Sequence[HandLandmarks]) -> NDArray[np.complex128]:
    """Landmarks as shapes [F,21]: complex numbers, centred, of unit norm; place and size are taken out."""
    points = np.stack([hand.points for hand in hands]).astype(np.float64)
    shapes = points[..., 0] + 1j * points[..., 1]
    shapes -= shapes.mean(1, keepdims=True)
    return np.asarray(shapes / np.maximum(np.linalg.norm(shapes, axis=1, keepdims=True), 1e-9))


def pose_distances(shapes: NDArray[np.complex128], other: NDArray[np.complex128]) -> NDArray[np.float64]:
    """Distances [F] of ``shapes`` from the shape ``other`` [21], whatever their turn in the picture.

    The full Procrustes distance of planar shapes (Kendall 1984): 0 for equal ones, sqrt(2) at most.
    """
    return np.asarray(np.sqrt(np.maximum(2 - 2 * np.abs(shapes @ other.conj()), 0.0)), np.float64)


def _phase(numbers: NDArray[np.complex128]) -> NDArray[np.complex128]:
    return np.asarray(numbers / np.maximum(np.abs(numbers), 1e-9))
