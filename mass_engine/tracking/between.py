"""Held-out frames that the tracker misread or lost: where the hand should be, from the frames around them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mass_engine.tracking.landmarks import HandLandmarks

_GAP = 30  # frames: a hand seen before and after so short a gap was there in between
_END = 6  # frames: a hand seen on one side only may have left the picture since
_NEAR = 6  # frames: neighbours this near say where the hand is, too, not only its pose
_SCORE = 0.1  # an estimate weighs little against an outline


def between(
    index: int,
    read: HandLandmarks | None,
    seen: Mapping[int, HandLandmarks],
    trusted: Mapping[int, HandLandmarks],
) -> HandLandmarks | None:
    """The hand in frame ``index``: the pose of the nearest ``trusted`` frames, linear in between, where the
    hand is ``read`` or, without a reading, where it was ``seen``. None where it may have been out of sight.

    The score is low; ``reading`` is what the mask goes by.
    """
    pose, place = _nearest(index, trusted), _nearest(index, seen)
    if not pose or not place:
        return None
    spans = [abs(hand.index - index) for hand in place]
    if read is None and min(spans) > _END and (len(place) < 2 or sum(spans) > _GAP):
        return None
    where = _blend(index, place, [hand.as_read for hand in place]) if read is None else read.as_read
    points = _blend(index, pose, [hand.points for hand in pose])
    if len(pose) < 2 or max(abs(hand.index - index) for hand in pose) > _NEAR:
        points = points + (where.max(0) + where.min(0) - points.max(0) - points.min(0)) / 2
    model = min(pose, key=lambda hand: abs(hand.index - index))
    return replace(
        model,
        index=index,
        points=points.astype(np.float32),
        world=_blend(index, pose, [hand.world for hand in pose]).astype(np.float32),
        score=_SCORE,
        trusted=True,
        reading=where.astype(np.float32),
    )


def _nearest(index: int, hands: Mapping[int, HandLandmarks]) -> list[HandLandmarks]:
    """The last of ``hands`` before a frame and the first after it, where there are such."""
    before = max((i for i in hands if i < index), default=None)
    after = min((i for i in hands if i > index), default=None)
    return [hands[i] for i in (before, after) if i is not None]


def _blend(index: int, hands: list[HandLandmarks], values: list[NDArray[np.float32]]) -> NDArray[np.floating]:
    """``values`` of one or two ``hands`` at frame ``index``, linear in time."""
    if len(hands) == 1:
        return values[0]
    first, last = hands[0].index, hands[1].index
    share = (index - first) / (last - first)
    return np.asarray((1 - share) * values[0] + share * values[1])
