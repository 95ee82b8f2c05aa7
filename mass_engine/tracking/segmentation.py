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
from mass_engine.tracking.hand_colors import (
    BIN_COUNT,
    ColorModel,
    color_bins,
    log_ratio,
    sleeve_ratio,
    strange_colors,
)
from mass_engine.tracking.landmarks import HandLandmarks
from mass_engine.tracking.matting import refine_edge, refine_seam

BACKGROUND, IGNORE, HAND = 0, 128, 255

_WORK = 200  # longest side of the window in which masks are computed, pixels
_EXPAND = 1.5  # window over the landmarks' bounding box
_ROUNDS = 3
_TIPS = slice(16, 21)  # the landmarks at the fingers' ends
_CUFF = -50.0  # how far (mm, measured from the wrist) a sleeve may reach over the hand
_WRIST, _TO_KNUCKLES = 68.0, -60.0  # mm from the forearm's axis and along it in which a wrist's edges lie
_MIXTURE_PIXELS = 20_000  # pixels of each side that the mixtures are made from
_FEW = 50  # fewer pixels make no mixture

# Worn and held things, in mm and in standard deviations from skin.
_STRANGE, _ODD = 5.0, 3.0  # no skin; beside such a place also this is none
_DEEP = 4.0  # inside the rough hand, a thing hides the hand
_OVER = -1.9  # least log ratio of lying over against beside the hand
_RIM, _RIM_PIXELS = 1.2, 3.0  # of the hand's edge, mixed with what is behind it: mm, and at least pixels
_GROWTH = 2.5  # from what is surely a thing to its edge
_LEAST = 8.0  # area, mm²
_NAIL = 12.0  # nails are no skin, but hand


@dataclass(frozen=True)
class HandMask:
    """Labels of an image window: ``box`` (x, y, width, height) in full-image pixels, ``labels`` uint8 [h,w]
    of ``BACKGROUND``, ``HAND`` and ``IGNORE`` (forearm, worn and held things: neither). ``coverage``
    float32 [h,w] in 0..1: the hand's share of each pixel; above a half where the label is ``HAND``, 0 where
    it is ``IGNORE``. Outside the box all is background."""

    box: tuple[int, int, int, int]
    labels: NDArray[np.uint8]
    coverage: NDArray[np.float32]

    def full(self, height: int, width: int) -> NDArray[np.uint8]:
        """The labels over a whole image, uint8 [height,width]."""
        x, y, w, h = self.box
        image = np.full((height, width), BACKGROUND, np.uint8)
        image[y : y + h, x : x + w] = self.labels
        return image

    def full_coverage(self, height: int, width: int) -> NDArray[np.float32]:
        """The coverage over a whole image, float32 [height,width]."""
        x, y, w, h = self.box
        image = np.zeros((height, width), np.float32)
        image[y : y + h, x : x + w] = self.coverage
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
    rough ``hand``, the distance ``to_tip`` of the nearest finger in mm; ``box`` is where it came from, in
    full-image pixels."""

    box: tuple[int, int, int, int]
    rgb: NDArray[np.uint8]
    bins: NDArray[np.int32]
    hand: capsules.CapsuleHand
    to_tip: NDArray[np.float32]


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
    away = np.ones((size[1], size[0]), np.uint8)
    tips = np.round(points[_TIPS] - 0.5).astype(int)
    tips = tips[((tips >= 0) & (tips < size)).all(1)]
    away[tips[:, 1], tips[:, 0]] = 0
    to_tip = np.asarray(cv2.distanceTransform(away, cv2.DIST_L2, 3), np.float32) / scale
    return _Window(box, small, color_bins(small), capsules.draw(points, scale, size[1], size[0]), to_tip)


class HandSegmenter:
    """Labels the pixels around one hand. Made by :meth:`train` from frames of the same clip."""

    def __init__(self, colors: ColorModel, mixtures: _Mixtures | None) -> None:
        self._colors = colors
        self._mixtures = mixtures

    @staticmethod
    def train(samples: Sequence[tuple[NDArray[np.uint8], HandLandmarks]]) -> HandSegmenter:
        """Learn hand, sleeve and background colours from (upright frame, landmarks) pairs.

        10 to 30 pairs, spread over the clip, are enough. Colours under the rough hand come first, then
        colours weighted by the previous model's belief.
        """
        if not samples:
            raise ValueError("a colour model needs at least one frame with landmarks")
        windows = [_window(rgb, landmarks) for rgb, landmarks in samples]
        skin, deep, beside = (np.zeros(BIN_COUNT, np.float64) for _ in range(3))
        for window in windows:
            rough = window.hand
            outside = (rough.distance > 8.0) & ~rough.forearm
            deep += np.bincount(window.bins[rough.distance < -_DEEP], minlength=deep.size)
            beside += np.bincount(window.bins[outside], minlength=beside.size)
            core = (rough.distance < -3.0) & (rough.along < _CUFF)
            skin += np.bincount(window.bins[core], minlength=skin.size)
        strange, over = strange_colors(skin), log_ratio(deep, beside)
        colors: ColorModel | None = None
        for _ in range(_ROUNDS):
            hand, other, sleeve = (np.zeros(BIN_COUNT, np.float64) for _ in range(3))
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
                    belief = 1 / (1 + np.exp(-(colors.hand[bins] + _prior(rough))))
                    use = ~rough.forearm & ~_sleeved(colors, window)
                use = use & ~((strange[bins] > _STRANGE) & (rough.distance < 8.0))
                hand += np.bincount(bins[use], belief[use], hand.size)
                other += np.bincount(bins[use], 1 - belief[use], hand.size)
            colors = ColorModel(log_ratio(hand, other), sleeve_ratio(sleeve, hand), strange, over)
        assert colors is not None
        return HandSegmenter(colors, _Mixtures.train(colors, windows))

    def __call__(self, rgb: NDArray[np.uint8], landmarks: HandLandmarks) -> HandMask:
        """Label the window around ``landmarks`` in the upright frame ``rgb`` uint8 [H,W,3]."""
        window = _window(rgb, landmarks)
        colors = self._colors
        belief = _smooth(colors.hand[window.bins] + _prior(window.hand))
        sleeve = _sleeved(colors, window)
        ignore = window.hand.forearm | sleeve | _bare_arm(colors, window)
        cut = (belief > 0) & ~ignore if self._mixtures is None else self._mixtures.cut(window, belief, ignore)
        worn = _worn(colors, window, cut, ignore)
        mask = _connected(cut & ~sleeve & ~worn, window.hand)
        rough, skin = window.hand, _smooth(colors.hand[window.bins]) > 0.0
        # Skin between hand and forearm that the cut gave to neither.
        ignore |= worn | _at_wrist(rough, _WRIST) & (rough.along > -15.0) & skin
        x, y, w, h = window.box
        soft = np.asarray(cv2.resize(mask.astype(np.float32), (w, h)), np.float32)
        arm = cv2.resize(ignore.astype(np.float32), (w, h), interpolation=cv2.INTER_LINEAR) > 0.5
        coverage = refine_edge(rgb[y : y + h, x : x + w], soft, arm, w / mask.shape[1])
        labels = np.where(coverage > 0.5, HAND, BACKGROUND).astype(np.uint8)
        labels[arm & (soft <= 0.5)] = IGNORE
        seam = refine_seam(rgb[y : y + h, x : x + w], labels == HAND, labels == IGNORE, w / mask.shape[1])
        labels[seam] = IGNORE
        coverage[labels == IGNORE] = 0.0
        return HandMask(window.box, labels, coverage)


@dataclass(frozen=True)
class _Mixtures:
    """Gaussian mixtures of hand and background colours, as GrabCut keeps them: float64 [1,65] each."""

    background: NDArray[np.float64]
    hand: NDArray[np.float64]

    @staticmethod
    def train(colors: ColorModel, windows: Sequence[_Window]) -> _Mixtures | None:
        """From all windows at once, each pixel on the side the colour model puts it; None where one side
        has too few."""
        hands, others = [], []
        for window in windows:
            rough = window.hand
            belief = _smooth(colors.hand[window.bins] + _prior(rough))
            use = ~rough.forearm & ~_sleeved(colors, window) & (rough.distance < 18.0)
            hands.append(window.rgb[(belief > 0) & use & (colors.strange[window.bins] < _STRANGE)])
            others.append(window.rgb[(belief <= 0) & use])
        hand, other = (_thinned(np.concatenate(side)) for side in (hands, others))
        if min(len(hand), len(other)) < _FEW:
            return None
        picture = np.concatenate([hand, other])[None]
        mask = np.full((1, len(hand) + len(other)), cv2.GC_BGD, np.uint8)
        mask[0, : len(hand)] = cv2.GC_FGD
        cv2.setRNGSeed(0)
        whole = (0, 0, mask.shape[1], 1)  # not used with a mask
        models: tuple[NDArray[np.float64], NDArray[np.float64]] = np.zeros((1, 65)), np.zeros((1, 65))
        cv2.grabCut(picture, mask, whole, *models, 0, cv2.GC_INIT_WITH_MASK)  # no cut: only the mixtures
        return _Mixtures(*models)

    def cut(
        self, window: _Window, belief: NDArray[np.float32], ignore: NDArray[np.bool_]
    ) -> NDArray[np.bool_]:
        """One GrabCut pass from ``belief`` (log-odds); the belief itself where a cut is not possible."""
        distance = window.hand.distance
        mask = np.where(belief > 0, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
        mask[(distance < -3.0) & (belief > 1.0)] = cv2.GC_FGD
        mask[(distance > 18.0) & ~_at_wrist(window.hand, _WRIST) | (belief < -7.0)] = cv2.GC_BGD
        mask[ignore] = cv2.GC_BGD
        hand = int(np.count_nonzero((mask == cv2.GC_FGD) | (mask == cv2.GC_PR_FGD)))
        if min(hand, mask.size - hand) < _FEW:
            return np.asarray(belief > 0)
        cv2.setRNGSeed(0)
        near = np.isin(mask, (cv2.GC_PR_FGD, cv2.GC_PR_BGD, cv2.GC_FGD))
        rows, columns = np.flatnonzero(near.any(1)), np.flatnonzero(near.any(0))
        part = slice(max(0, rows[0] - 2), rows[-1] + 3), slice(max(0, columns[0] - 2), columns[-1] + 3)
        small = np.ascontiguousarray(mask[part])
        whole = (0, 0, small.shape[1], small.shape[0])  # not used with a mask
        models = self.background.copy(), self.hand.copy()
        cv2.grabCut(np.ascontiguousarray(window.rgb[part]), small, whole, *models, 1, cv2.GC_EVAL)
        mask[part] = small
        return np.asarray((mask == cv2.GC_FGD) | (mask == cv2.GC_PR_FGD))


def _thinned(pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return pixels[:: max(1, len(pixels) // _MIXTURE_PIXELS)]


def _worn(
    colors: ColorModel, window: _Window, hand: NDArray[np.bool_], ignore: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Rings, watches and held things over the hand: colours that are no skin, in pieces of some size.

    ``hand`` is what the cut gave. Outside it only what lies deep in the rough hand is taken: the rest is
    a gap between fingers. Nails are no skin either, but lie at the tips; a rim is mixed with what
    is behind it.
    """
    rough, scale = window.hand, window.hand.scale
    strange = _smooth(np.minimum(colors.strange[window.bins], 2 * _STRANGE))
    depth = np.where(_at_wrist(rough, _WRIST - 12.0), -_DEEP - 1.0, rough.distance)
    hidden = (depth < -_DEEP) & (_smooth(colors.over[window.bins]) > _OVER)
    open_to = (hand | hidden) & ~ignore & (window.to_tip > _NAIL)
    body = hand | ignore | (hidden & (strange > _STRANGE))
    rim = cv2.distanceTransform(body.astype(np.uint8), cv2.DIST_L2, 3) < max(_RIM * scale, _RIM_PIXELS)
    square = np.ones((2, 2), np.uint8)
    seeds = cv2.morphologyEx(((strange > _STRANGE) & open_to & ~rim).astype(np.uint8), cv2.MORPH_OPEN, square)
    _, pieces, stats, _ = cv2.connectedComponentsWithStats(seeds, connectivity=8)
    keep = stats[:, cv2.CC_STAT_AREA] >= _LEAST * scale**2
    keep[0] = False
    reach = 2 * max(1, round(_GROWTH * scale)) + 1
    ball = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (reach, reach))
    kept = cv2.dilate(keep[pieces].astype(np.uint8), ball) & (open_to & (strange > _ODD)).astype(np.uint8)
    return np.asarray(cv2.morphologyEx(kept, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8)) > 0)


def _at_wrist(rough: capsules.CapsuleHand, half: float) -> NDArray[np.bool_]:
    """The neighbourhood of the wrist, of which the landmarks say no width."""
    return np.asarray((rough.along > _TO_KNUCKLES) & (rough.along < 8.0) & (rough.across < half))


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


def _prior(rough: capsules.CapsuleHand) -> NDArray[np.float32]:
    """Log-odds of being hand by the distance from the rough outline; beside the wrist, of which the landmarks
    say no width, colour decides."""
    odds = np.clip(-0.35 * (rough.distance - 1.0), -6.0, 3.5)
    wrist = _at_wrist(rough, _WRIST)
    return np.asarray(np.where(wrist, np.maximum(odds, -0.5), odds), np.float32)


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
