"""Colours of one clip: how much each speaks for the hand, for a sleeve, or for something worn or held."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

# Lab bins: lightness coarse, the two colour axes fine.
_SHIFTS = (3, 2, 2)
_BINS = (32, 64, 64)
#: Number of colour bins.
BIN_COUNT = _BINS[0] * _BINS[1] * _BINS[2]

_COLOR_LIMIT = 4.0  # largest log ratio a colour may give
_UNSEEN = 3e-6  # density floor: a colour never seen says nothing
_BARE_ARM = 0.5  # forearm colours this much like the hand's are skin, not a sleeve

_FITS = 12  # rounds of the fit of skin's line
_SPREAD = 1.8  # least standard deviation of skin's colour axes, Lab units,
_VIVID = 0.13  # and as a share of how far skin is from grey: blood and shading scale with it
_GREY = 128.0


@dataclass(frozen=True)
class ColorModel:
    """Log-likelihood ratios per colour bin, float32 [BIN_COUNT]: hand over background, sleeve over
    hand, and ``over``: lying over the hand against lying beside it. ``strange``: standard deviations from
    this hand's skin of that lightness."""

    hand: NDArray[np.float32]
    sleeve: NDArray[np.float32]
    strange: NDArray[np.float32]
    over: NDArray[np.float32]


def color_bins(rgb: NDArray[np.uint8]) -> NDArray[np.int32]:
    """The colour bin of every pixel of ``rgb`` uint8 [h,w,3]."""
    lab = cv2.cvtColor(rgb, cv2.COLOR_RGB2Lab)
    light, red, yellow = (lab[..., i].astype(np.int32) >> _SHIFTS[i] for i in range(3))
    return np.asarray((light * _BINS[1] + red) * _BINS[2] + yellow, np.int32)


def strange_colors(skin: NDArray[np.float64]) -> NDArray[np.float32]:
    """How many standard deviations each bin is off the skin counted in ``skin`` [BIN_COUNT].

    Skin lies along a line in colour space: its two colour axes change with lightness. The line is fitted so
    that a ring, a watch or a held thing among the counts does not matter while most of them are skin (Cauchy
    weights from the medians on).
    """
    used = np.flatnonzero(skin)
    if not len(used):
        return np.zeros(BIN_COUNT, np.float32)
    counts = skin[used]
    light, *axes = (np.asarray(v, np.float64) for v in np.unravel_index(used, _BINS))
    colors = np.stack(axes, 1) * [float(1 << shift) for shift in _SHIFTS[1:]]
    line = np.array([[_quartiles(column, counts)[1] for column in colors.T], [0.0, 0.0]])
    spread = np.full(2, 2.0 * _SPREAD)
    ones = np.ones_like(light)
    low, high = float(light.min()), float(light.max())
    for _ in range(_FITS):
        off = ((colors - np.stack([ones, light], 1) @ line) / spread) ** 2
        weight = counts / (1 + off.sum(1))
        low, _, high = _quartiles(light, weight, 0.02)
        centre = float((light * weight).sum() / weight.sum())
        design = np.stack([ones, light - centre], 1)
        steady = np.diag([0.0, 0.01 * weight.sum()])  # few lightnesses give no slope
        a, b = np.linalg.solve(
            design.T @ (design * weight[:, None]) + steady, design.T @ (colors * weight[:, None])
        )
        line = np.stack([a - centre * b, b])
        rest = np.abs(colors - np.stack([ones, light], 1) @ line)
        least = max(_SPREAD, _VIVID * float(np.hypot(*(a - _GREY))))
        spread = np.array([max(1.48 * _quartiles(column, weight)[1], least) for column in rest.T])
    level = np.clip(np.arange(_BINS[0]), low, high)
    middle = np.stack([np.ones_like(level), level], 1) @ line
    red, yellow = (np.arange(_BINS[k]) * float(1 << _SHIFTS[k]) for k in (1, 2))
    off_red = (red[None, :, None] - middle[:, 0, None, None]) / spread[0]
    off_yellow = (yellow[None, None, :] - middle[:, 1, None, None]) / spread[1]
    return np.asarray(np.sqrt(off_red**2 + off_yellow**2), np.float32).ravel()


def _quartiles(
    values: NDArray[np.float64], weight: NDArray[np.float64], tail: float = 0.25
) -> tuple[float, float, float]:
    """The weighted quantiles ``tail``, a half and 1 - ``tail``."""
    order = np.argsort(values)
    heap = np.cumsum(weight[order])
    at = np.searchsorted(heap, np.array([tail, 0.5, 1 - tail]) * heap[-1])
    low, middle, high = values[order][np.minimum(at, len(values) - 1)]
    return float(low), float(middle), float(high)


def sleeve_ratio(sleeve: NDArray[np.float64], hand: NDArray[np.float64]) -> NDArray[np.float32]:
    """As :func:`log_ratio`, sleeve over hand; never in favour of a sleeve where the forearm is bare."""
    alike = float(np.sqrt(_density(sleeve) * _density(hand)).sum())  # Bhattacharyya coefficient
    ratio = log_ratio(sleeve, hand)
    return ratio if alike < _BARE_ARM else np.full_like(ratio, -_COLOR_LIMIT)


def log_ratio(one: NDArray[np.float64], other: NDArray[np.float64]) -> NDArray[np.float32]:
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
