"""Decoded pictures of any pixel format to 8-bit RGB; high dynamic range is tone-mapped.

HLG and PQ transfer functions: Recommendation ITU-R BT.2100; primaries: BT.2020 and BT.709.
"""

from __future__ import annotations

from functools import lru_cache

import av
import cv2
import numpy as np
from numpy.typing import NDArray

_PQ, _HLG = 16, 18  # ISO/IEC 23091-2 transfer characteristics
_BT2020 = 9  # colour primaries

#: Linear BT.2020 to linear BT.709.
_TO_BT709 = np.array(
    [[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]], np.float32
)
_KNEE = 0.8


def to_rgb(picture: av.VideoFrame) -> NDArray[np.uint8]:
    """``picture`` as uint8 [H,W,3] RGB in the picture's own (coded) orientation."""
    transfer = int(picture.color_trc or 0)
    if transfer not in (_PQ, _HLG):
        return np.asarray(picture.to_ndarray(format="rgb24"), np.uint8)
    wide = picture.to_ndarray(format="rgb48le")
    linear = _linear_table(transfer)[wide]
    if int(picture.color_primaries or 0) == _BT2020:
        linear = cv2.transform(linear, _TO_BT709)
    # The output curve is tabulated over the square root of light, which is fine enough in the shadows.
    position = np.sqrt(np.clip(linear, 0.0, _TABLE_MAX)) * ((_TABLE_SIZE - 1) / _TABLE_MAX**0.5)
    return np.asarray(_display_table()[position.astype(np.int32)], np.uint8)


_TABLE_SIZE = 8192
_TABLE_MAX = 12.0


@lru_cache(maxsize=2)
def _linear_table(transfer: int) -> NDArray[np.float32]:
    """16-bit signal to scene light, 1 being diffuse white (HLG 75 % signal, PQ 203 cd/m2: BT.2408)."""
    signal = np.linspace(0.0, 1.0, 65536)
    if transfer == _HLG:
        a, b, c = 0.17883277, 0.28466892, 0.55991073
        light = np.where(signal <= 0.5, signal**2 / 3, (np.exp((signal - c) / a) + b) / 12)
        return (light / 0.26496).astype(np.float32)
    m1, m2, c1, c2, c3 = 0.1593017578125, 78.84375, 0.8359375, 18.8515625, 18.6875
    power = signal ** (1 / m2)
    light = (np.maximum(power - c1, 0) / (c2 - c3 * power)) ** (1 / m1) * 10_000
    return (light / 203).astype(np.float32)


@lru_cache(maxsize=1)
def _display_table() -> NDArray[np.uint8]:
    """Light (tabulated by its square root) to an 8-bit sRGB value; highlights roll off above the knee."""
    light = np.linspace(0.0, _TABLE_MAX**0.5, _TABLE_SIZE) ** 2
    soft = _KNEE + (1 - _KNEE) * (1 - np.exp(-(light - _KNEE) / (1 - _KNEE)))
    light = np.where(light > _KNEE, soft, light)
    value = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return np.asarray(np.round(value * 255), np.uint8)
