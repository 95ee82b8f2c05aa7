"""Hand masks without learned weights: a colour model of this clip, a rough hand as prior, one graph cut.

Graph cut: GrabCut (Rother, Kolmogorov, Blake 2004), started from the colour model instead of a box.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from mass_engine.tracking import capsules
from mass_engine.tracking.landmarks import HandLandmarks

BACKGROUND, IGNORE, HAND = 0, 128, 255

_WORK = 256  # longest side of the window in which masks are computed, pixels
_EXPAND = 1.5  # window over the landmarks' bounding box


@dataclass(frozen=True)
class HandMask:
    """Labels of an image window: ``box`` (x, y, width, height) in full-image pixels, ``labels`` uint8 [h,w]
    of ``BACKGROUND``, ``HAND`` and ``IGNORE`` (forearm: neither). Outside the box all is background."""

    box: tuple[int, int, int, int]
    labels: NDArray[np.uint8]

    def full(self, height: int, width: int) -> NDArray[np.uint8]:
        """The labels over a whole image, uint8 [height,width]."""
        x, y, w, h = self.box
        image = np.full((height, width), BACKGROUND, np.uint8)
        image[y : y + h, x : x + w] = self.labels
        return image


def hand_box(
    points: NDArray[np.floating], height: int, width: int, expand: float = _EXPAND
) -> tuple[int, int, int, int]:
    """The window (x, y, width, height) around landmarks [21,2], grown by ``expand``, inside the image."""
    low, high = points.min(0), points.max(0)
    half = np.maximum((high - low) / 2, 0.35 * float((high - low).max())) * expand
    centre = (low + high) / 2
    x0, y0 = (int(v) for v in np.clip(np.floor(centre - half), 0, (width - 2, height - 2)))
    x1, y1 = (int(v) for v in np.clip(np.ceil(centre + half), (x0 + 2, y0 + 2), (width, height)))
    return x0, y0, x1 - x0, y1 - y0


@dataclass(frozen=True)
class _Window:
    """A hand cut out of its frame at working size: ``lab`` uint8 [h,w,3], ``rgb``, and its rough hand."""

    box: tuple[int, int, int, int]
    rgb: NDArray[np.uint8]
    bins: NDArray[np.int32]
    hand: capsules.CapsuleHand


# Lab bins: lightness coarse, the two colour axes fine.
_SHIFTS = (3, 2, 2)
_BINS = (32, 64, 64)


def _bins(rgb: NDArray[np.uint8]) -> NDArray[np.int32]:
    lab = cv2.cvtColor(rgb, cv2.COLOR_RGB2Lab).astype(np.int32)
    l, a, b = (lab[..., i] >> _SHIFTS[i] for i in range(3))
    return np.asarray((l * _BINS[1] + a) * _BINS[2] + b, np.int32)


def _window(rgb: NDArray[np.uint8], landmarks: HandLandmarks) -> _Window:
    box = hand_box(landmarks.points, *rgb.shape[:2])
    x, y, w, h = box
    k = min(1.0, _WORK / max(w, h))
    size = max(2, round(w * k)), max(2, round(h * k))
    crop = rgb[y : y + h, x : x + w]
    small = cv2.resize(crop, size, interpolation=cv2.INTER_AREA) if k < 1 else np.ascontiguousarray(crop)
    stretch = np.array([size[0] / w, size[1] / h])
    points = (landmarks.points - (x, y)) * stretch
    scale = capsules.pixels_per_mm(landmarks.points) * float(stretch.mean())
    small = np.asarray(small, np.uint8)
    return _Window(box, small, _bins(small), capsules.draw(points, scale, size[1], size[0]))


class HandSegmenter:
    """Labels the pixels around one hand. Made by :meth:`train` from frames of the same clip."""

    def __init__(self, log_ratio: NDArray[np.float32]) -> None:
        self._log_ratio = log_ratio

    @staticmethod
    def train(samples: Sequence[tuple[NDArray[np.uint8], HandLandmarks]]) -> HandSegmenter:
        """Learn hand and background colours from (upright frame, landmarks) pairs; 10 to 30 spread ones do.

        Two rounds: colours under the rough hand first, then colours weighted by the first model's belief.
        """
        windows = [_window(rgb, landmarks) for rgb, landmarks in samples]
        ratio = np.zeros(int(np.prod(_BINS)), np.float32)
        for round_ in range(3):
            hand, other = (np.zeros(ratio.size, np.float64) for _ in range(2))
            for window in windows:
                free = ~window.hand.forearm
                d, bins = window.hand.distance[free], window.bins[free]
                if round_ == 0:
                    belief = np.where(d < -2.0, 1.0, 0.0)
                    known = (d < -2.0) | (d > 8.0)
                    belief, bins = belief[known], bins[known]
                else:
                    belief = 1 / (1 + np.exp(-(ratio[bins] + _prior(d))))
                hand += np.bincount(bins, belief, ratio.size)
                other += np.bincount(bins, 1 - belief, ratio.size)
            ratio = _log_ratio(hand, other)
        return HandSegmenter(ratio)

    def __call__(self, rgb: NDArray[np.uint8], landmarks: HandLandmarks) -> HandMask:
        """Label the window around ``landmarks`` in the upright frame ``rgb`` uint8 [H,W,3]."""
        window = _window(rgb, landmarks)
        belief = self._log_ratio[window.bins] + _prior(window.hand.distance)
        belief = cv2.GaussianBlur(belief, (0, 0), 1.0)
        mask = _connected(_cut(window, belief), window.hand)
        _, _, w, h = window.box
        soft = cv2.resize(mask.astype(np.float32), (w, h), interpolation=cv2.INTER_LINEAR)
        arm = cv2.resize(window.hand.forearm.astype(np.uint8), (w, h), interpolation=cv2.INTER_NEAREST)
        labels = np.where(soft > 0.5, HAND, BACKGROUND).astype(np.uint8)
        labels[arm > 0] = IGNORE
        return HandMask(window.box, labels)


def _prior(distance: NDArray[np.float32]) -> NDArray[np.float32]:
    """Log-odds of being hand at ``distance`` mm from the rough outline."""
    return np.asarray(np.clip(-0.35 * (distance - 1.0), -6.0, 3.5), np.float32)


def _log_ratio(hand: NDArray[np.float64], other: NDArray[np.float64]) -> NDArray[np.float32]:
    """Smoothed log-likelihood ratio per colour bin, limited so that no colour alone decides."""
    densities = []
    for counts in (hand, other):
        cube = counts.reshape(_BINS)
        for axis in range(3):
            cube = _blur_axis(cube, axis)
        densities.append(cube.ravel() / max(float(cube.sum()), 1e-9))
    floor = 3e-6  # a colour never seen says nothing
    ratio = np.log((densities[0] + floor) / (densities[1] + floor))
    return np.asarray(np.clip(ratio, -4.0, 4.0), np.float32)


def _blur_axis(cube: NDArray[np.float64], axis: int) -> NDArray[np.float64]:
    moved = np.moveaxis(cube, axis, 0)
    flat = np.ascontiguousarray(moved.reshape(moved.shape[0], -1))
    blurred = cv2.GaussianBlur(flat, (1, 5), sigmaX=1e-3, sigmaY=1.0, borderType=cv2.BORDER_REPLICATE)
    return np.moveaxis(blurred.reshape(moved.shape), 0, axis)


def _cut(window: _Window, belief: NDArray[np.float32]) -> NDArray[np.bool_]:
    """One GrabCut pass from ``belief`` (log-odds); the belief itself where a cut is not possible."""
    distance = window.hand.distance
    mask = np.where(belief > 0, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    mask[(distance < -3.0) & (belief > 1.0)] = cv2.GC_FGD
    mask[(distance > 18.0) | (belief < -7.0)] = cv2.GC_BGD
    mask[window.hand.forearm] = cv2.GC_BGD
    hand = int(np.count_nonzero((mask == cv2.GC_FGD) | (mask == cv2.GC_PR_FGD)))
    if min(hand, mask.size - hand) < 50:
        return np.asarray(belief > 0)
    none: NDArray[np.float64] = np.zeros((1, 65))
    cv2.setRNGSeed(0)
    cv2.grabCut(window.rgb, mask, None, none, none.copy(), 1, cv2.GC_INIT_WITH_MASK)
    return np.asarray((mask == cv2.GC_FGD) | (mask == cv2.GC_PR_FGD))


def _connected(mask: NDArray[np.bool_], hand: capsules.CapsuleHand) -> NDArray[np.bool_]:
    """The pieces that hold part of the rough hand's core, with small holes closed."""
    count, pieces = cv2.connectedComponents(mask.astype(np.uint8), connectivity=4)
    core = np.bincount(pieces[(hand.distance < -1.0) & mask], minlength=count)
    keep = core >= max(4.0, 0.05 * float(core.max(initial=0)))
    keep[0] = False
    kept = keep[pieces]
    largest_hole = (6.0 * hand.scale) ** 2
    count, holes, stats, _ = cv2.connectedComponentsWithStats((~kept).astype(np.uint8), connectivity=4)
    small = stats[:, cv2.CC_STAT_AREA] < largest_hole
    small[0] = False
    return np.asarray(kept | small[holes])
