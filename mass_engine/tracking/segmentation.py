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
_ROUNDS = 3
_COLOR_LIMIT = 4.0  # largest log ratio a colour may give
_UNSEEN = 3e-6  # density floor: a colour never seen says nothing
_BARE_ARM = 0.5  # forearm colours this much like the hand's are skin, not a sleeve
_CUFF = -50.0  # how far (mm, measured from the wrist) a sleeve may reach over the hand


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
    """A hand cut out of its frame at working size: ``rgb`` uint8 [h,w,3], its colour ``bins`` [h,w], the
    rough ``hand``; ``box`` is where it came from, in full-image pixels."""

    box: tuple[int, int, int, int]
    rgb: NDArray[np.uint8]
    bins: NDArray[np.int32]
    hand: capsules.CapsuleHand


# Lab bins: lightness coarse, the two colour axes fine.
_SHIFTS = (3, 2, 2)
_BINS = (32, 64, 64)


def _bins(rgb: NDArray[np.uint8]) -> NDArray[np.int32]:
    lab = cv2.cvtColor(rgb, cv2.COLOR_RGB2Lab).astype(np.int32)
    light, red, yellow = (lab[..., i] >> _SHIFTS[i] for i in range(3))
    return np.asarray((light * _BINS[1] + red) * _BINS[2] + yellow, np.int32)


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


@dataclass(frozen=True)
class ColorModel:
    """Log-likelihood ratios per colour bin: hand over background, and sleeve over hand."""

    hand: NDArray[np.float32]
    sleeve: NDArray[np.float32]


class HandSegmenter:
    """Labels the pixels around one hand. Made by :meth:`train` from frames of the same clip."""

    def __init__(self, colors: ColorModel) -> None:
        self._colors = colors

    @staticmethod
    def train(samples: Sequence[tuple[NDArray[np.uint8], HandLandmarks]]) -> HandSegmenter:
        """Learn hand, sleeve and background colours from (upright frame, landmarks) pairs.

        10 to 30 pairs, spread over the clip, are enough. Colours under the rough hand come first, then
        colours weighted by the previous model's belief.
        """
        if not samples:
            raise ValueError("a colour model needs at least one frame with landmarks")
        windows = [_window(rgb, landmarks) for rgb, landmarks in samples]
        colors: ColorModel | None = None
        for _ in range(_ROUNDS):
            hand, other, sleeve = (np.zeros(int(np.prod(_BINS)), np.float64) for _ in range(3))
            for window in windows:
                rough, bins = window.hand, window.bins
                arm = (
                    (rough.along > 12.0)
                    & (rough.along < 70.0)
                    & (rough.across < 22.0)
                    & (rough.distance > 2.0)
                )
                sleeve += np.bincount(bins[arm], minlength=sleeve.size)
                if colors is None:
                    belief = np.where(rough.distance < -2.0, 1.0, 0.0)
                    use = (belief > 0) & (rough.along < _CUFF) | (rough.distance > 8.0) & ~rough.forearm
                else:
                    belief = 1 / (1 + np.exp(-(colors.hand[bins] + _prior(rough.distance))))
                    use = ~rough.forearm & ~_sleeved(colors, window)
                hand += np.bincount(bins[use], belief[use], hand.size)
                other += np.bincount(bins[use], 1 - belief[use], hand.size)
            colors = ColorModel(_log_ratio(hand, other), _sleeve_ratio(sleeve, hand))
        assert colors is not None
        return HandSegmenter(colors)

    def __call__(self, rgb: NDArray[np.uint8], landmarks: HandLandmarks) -> HandMask:
        """Label the window around ``landmarks`` in the upright frame ``rgb`` uint8 [H,W,3]."""
        window = _window(rgb, landmarks)
        belief = _smooth(self._colors.hand[window.bins] + _prior(window.hand.distance))
        sleeve = _sleeved(self._colors, window)
        ignore = window.hand.forearm | sleeve | _bare_arm(self._colors, window)
        mask = _connected(_cut(window, belief, ignore) & ~sleeve, window.hand)
        _, _, w, h = window.box
        soft = cv2.resize(mask.astype(np.float32), (w, h), interpolation=cv2.INTER_LINEAR)
        arm = cv2.resize(ignore.astype(np.uint8), (w, h), interpolation=cv2.INTER_NEAREST)
        labels = np.where(soft > 0.5, HAND, BACKGROUND).astype(np.uint8)
        labels[(arm > 0) & (soft <= 0.5)] = IGNORE
        return HandMask(window.box, labels)


def _bare_arm(colors: ColorModel, window: _Window) -> NDArray[np.bool_]:
    """Skin beyond the wrist that a bent wrist puts outside the forearm's corridor."""
    rough = window.hand
    score = _smooth(colors.hand[window.bins])
    return np.asarray((rough.along > 5.0) & (rough.distance > 12.0) & (score > 1.0))


def _sleeved(colors: ColorModel, window: _Window) -> NDArray[np.bool_]:
    """Pixels of a sleeve that reaches over the wrist: its colour, near the wrist, joined to the forearm."""
    rough = window.hand
    corridor = (rough.along > _CUFF) & (rough.across < 45.0 + 0.35 * np.maximum(rough.along, 0))
    near = corridor | (rough.distance < 10.0)
    score = _smooth(colors.sleeve[window.bins])
    square = np.ones((3, 3), np.uint8)
    alike = cv2.morphologyEx((near & (score > 0.5)).astype(np.uint8), cv2.MORPH_OPEN, square)
    count, pieces = cv2.connectedComponents(alike, connectivity=4)
    reaches = np.bincount(pieces[rough.along > 0], minlength=count) > 0
    reaches[0] = False
    return np.asarray(reaches[pieces])


def _smooth(values: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.asarray(cv2.GaussianBlur(values, (0, 0), 1.0), np.float32)


def _prior(distance: NDArray[np.float32]) -> NDArray[np.float32]:
    """Log-odds of being hand at ``distance`` mm from the rough outline."""
    return np.asarray(np.clip(-0.35 * (distance - 1.0), -6.0, 3.5), np.float32)


def _sleeve_ratio(sleeve: NDArray[np.float64], hand: NDArray[np.float64]) -> NDArray[np.float32]:
    """As :func:`_log_ratio`, sleeve over hand; never in favour of a sleeve where the forearm is bare."""
    alike = float(np.sqrt(_density(sleeve) * _density(hand)).sum())  # Bhattacharyya coefficient
    ratio = _log_ratio(sleeve, hand)
    return ratio if alike < _BARE_ARM else np.full_like(ratio, -_COLOR_LIMIT)


def _log_ratio(one: NDArray[np.float64], other: NDArray[np.float64]) -> NDArray[np.float32]:
    """Smoothed log-likelihood ratio per colour bin, limited so that no colour alone decides."""
    ratio = np.log((_density(one) + _UNSEEN) / (_density(other) + _UNSEEN))
    return np.asarray(np.clip(ratio, -_COLOR_LIMIT, _COLOR_LIMIT), np.float32)


def _density(counts: NDArray[np.float64]) -> NDArray[np.float64]:
    cube = counts.reshape(_BINS)
    for axis in range(3):
        cube = _blur_axis(cube, axis)
    return cube.ravel() / max(float(cube.sum()), 1e-9)


def _blur_axis(cube: NDArray[np.float64], axis: int) -> NDArray[np.float64]:
    moved = np.moveaxis(cube, axis, 0)
    flat = np.ascontiguousarray(moved.reshape(moved.shape[0], -1))
    blurred = cv2.GaussianBlur(flat, (1, 5), sigmaX=1e-3, sigmaY=1.0, borderType=cv2.BORDER_REPLICATE)
    return np.moveaxis(np.asarray(blurred, np.float64).reshape(moved.shape), 0, axis)


def _cut(window: _Window, belief: NDArray[np.float32], ignore: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """One GrabCut pass from ``belief`` (log-odds); the belief itself where a cut is not possible."""
    distance = window.hand.distance
    mask = np.where(belief > 0, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    mask[(distance < -3.0) & (belief > 1.0)] = cv2.GC_FGD
    mask[(distance > 18.0) | (belief < -7.0)] = cv2.GC_BGD
    mask[ignore] = cv2.GC_BGD
    hand = int(np.count_nonzero((mask == cv2.GC_FGD) | (mask == cv2.GC_PR_FGD)))
    if min(hand, mask.size - hand) < 50:
        return np.asarray(belief > 0)
    none: NDArray[np.float64] = np.zeros((1, 65))
    cv2.setRNGSeed(0)
    whole = (0, 0, mask.shape[1], mask.shape[0])  # not used with a mask
    cv2.grabCut(window.rgb, mask, whole, none, none.copy(), 1, cv2.GC_INIT_WITH_MASK)
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
