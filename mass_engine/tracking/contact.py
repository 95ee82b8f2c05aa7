"""Two hands beside or over each other: which pixels say nothing certain about one of them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from mass_engine.tracking import capsules
from mass_engine.tracking.landmarks import HandLandmarks
from mass_engine.tracking.segmentation import BACKGROUND, IGNORE, hand_box

_MARGIN = 6.0  # mm around the other hand's rough outline that are still its own
_SHADOW = 14.0  # mm around it in which background is not sure either: the rough hand is only that
_LOST = 60  # frames: a hand not seen for longer is elsewhere


def is_apart(mark: HandLandmarks, other: HandLandmarks | None) -> bool:
    """Whether nothing of ``other`` reaches into the window around ``mark``."""
    if other is None:
        return True
    x, y, w, h = hand_box(mark.points, 1 << 20, 1 << 20)
    reach = capsules.pixels_per_mm(other.points) * 25.0
    low, high = other.points.min(0) - reach, other.points.max(0) + reach
    return bool(high[0] < x or high[1] < y or low[0] > x + w or low[1] > y + h)


def hide_other(
    labels: NDArray[np.uint8], mark: HandLandmarks, other: HandLandmarks | None, corner: tuple[int, int]
) -> NDArray[np.uint8]:
    """``labels`` uint8 [h,w] of the window at ``corner`` (x, y) around ``mark``, with IGNORE where the
    ``other`` hand may be.

    Nothing says which hand is in front: where both are, both are ignored. A label of hand nearer to the other
    hand is its own; its forearm is ignored like one's own.
    """
    if other is None or is_apart(mark, other):
        return labels
    height, width = labels.shape
    shift = np.array(corner, np.float32)
    mine, theirs = (
        capsules.draw(hand.as_read - shift, capsules.pixels_per_mm(hand.as_read), height, width)
        for hand in (mark, other)
    )
    hidden = theirs.distance < _MARGIN
    hidden |= (labels != BACKGROUND) & (theirs.distance < mine.distance)
    hidden |= (labels == BACKGROUND) & ((theirs.distance < _SHADOW) | theirs.forearm)
    return np.where(hidden, np.uint8(IGNORE), labels)


def mixed_frames(hands: Mapping[int, HandLandmarks], others: Mapping[int, HandLandmarks]) -> set[int]:
    """Frames in which the other hand is not followed, yet may be behind or before this one: it was lost, or
    will be found, where this hand now is. Nothing says which pixels are whose."""
    seen = np.array(sorted(others), np.int64)
    mixed: set[int] = set()
    for index, hand in hands.items():
        if index in others or len(seen) == 0:
            continue
        place = int(np.searchsorted(seen, index))
        around = [int(seen[k]) for k in (place - 1, place) if 0 <= k < len(seen)]
        near = [i for i in around if abs(i - index) <= _LOST]
        if any(not is_apart(hand, others[i]) for i in near):
            mixed.add(index)
    return mixed
