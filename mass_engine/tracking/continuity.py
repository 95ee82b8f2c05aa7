"""Landmarks that jump although the picture does not.

Seen along its fingers, a hand can be read in two ways, and the landmark network changes its mind from one
frame to the next with full confidence. Optical flow says how far the skin moved; where landmarks move
otherwise there is a break. A short run between breaks is bridged: its landmarks are carried by the flow from
the long runs on both sides, if both ends then meet. A hand that did change its pose fast moves with the flow
and has no breaks.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from mass_engine.tracking.landmarks import HandLandmarks

_WINDOW = 1.6  # side of the window flow is computed in, in sides of the landmarks' box
_FLOW_SIDE = 192  # its pixels
_GRID = 48  # flow vectors kept per side
_STEP = 3  # frames apart at most: held-out frames are stepped over
#: Mean distance of the third of the points that disagree most, in sides of the landmarks' box. On clips that
#: are tracked well it stays under 0.06, at changes of mind it is 0.1 to 0.7.
_BREAK = 0.09
_ANCHOR = 12  # frames: runs as long as this are believed
_LONGEST_BRIDGE = 30  # frames: beyond, flow has drifted too far
#: Both ends of a bridge meet when they end this near, in sides of the box.
_MEET = 0.25
_BRIDGED_SCORE = 0.3


@dataclass(frozen=True)
class FlowGrid:
    """Motion in a square window with corner (``x``, ``y``) and ``side`` pixels: ``field`` [G,G,2] pixels."""

    x: float
    y: float
    side: float
    field: NDArray[np.float16]

    def carry(self, points: NDArray[np.float32]) -> NDArray[np.float32]:
        """Points [N,2] where they are in the other frame."""
        place = ((points - (self.x, self.y)) / self.side * _GRID - 0.5).clip(0, _GRID - 1).astype(np.float32)
        moved = cv2.remap(
            self.field.astype(np.float32),
            place[:, :1],
            place[:, 1:],
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
        return np.asarray(points + moved[:, 0], np.float32)


class FlowRecorder:
    """Flow around every hand between consecutive frames, both ways; holds one picture at a time.

    ``ahead[i][track]`` leads from frame i to the next one given, ``back[i][track]`` to the one before.
    """

    def __init__(self) -> None:
        self.ahead: dict[int, dict[int, tuple[int, FlowGrid]]] = {}
        self.back: dict[int, dict[int, tuple[int, FlowGrid]]] = {}
        self._flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)
        self._last: tuple[int, NDArray[np.uint8], list[HandLandmarks]] | None = None

    def add(self, rgb: NDArray[np.uint8], index: int, hands: list[HandLandmarks]) -> None:
        """The next frame uint8 [H,W,3] and the hands in it."""
        grey = np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), np.uint8)
        if self._last is not None and index - self._last[0] <= _STEP:
            before, old, others = self._last
            for hand in others:
                self.ahead.setdefault(before, {})[hand.track] = (index, self._between(old, grey, hand))
            for hand in hands:
                self.back.setdefault(index, {})[hand.track] = (before, self._between(grey, old, hand))
        self._last = index, grey, hands

    def _between(self, one: NDArray[np.uint8], two: NDArray[np.uint8], hand: HandLandmarks) -> FlowGrid:
        low, high = hand.points.min(0), hand.points.max(0)
        side = max(16.0, _WINDOW * float((high - low).max()))
        x, y = (float(v) for v in (low + high) / 2 - side / 2)
        to_image = np.array([[side / _FLOW_SIDE, 0, x], [0, side / _FLOW_SIDE, y]])
        flags = (
            cv2.INTER_AREA | cv2.WARP_INVERSE_MAP
            if side <= _FLOW_SIDE
            else cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        )
        a, b = (
            cv2.warpAffine(
                i, to_image, (_FLOW_SIDE, _FLOW_SIDE), flags=flags, borderMode=cv2.BORDER_REPLICATE
            )
            for i in (one, two)
        )
        flow = self._flow.calc(a, b, None)  # type: ignore[call-overload]
        small = cv2.resize(flow, (_GRID, _GRID), interpolation=cv2.INTER_AREA)
        return FlowGrid(x, y, side, np.asarray(small * (side / _FLOW_SIDE), np.float16))


def bridge(hands: Mapping[int, HandLandmarks], flow: FlowRecorder) -> dict[int, HandLandmarks]:
    """``hands`` by frame, in order, with short runs between breaks carried over from their neighbours."""
    order = sorted(hands)
    runs = _runs(hands, order, flow)
    result = dict(hands)
    place = 0
    while place < len(runs):
        if len(runs[place]) >= _ANCHOR or place == 0:
            place += 1
            continue
        first = place
        while place < len(runs) and len(runs[place]) < _ANCHOR:
            place += 1
        between = [index for run in runs[first:place] for index in run]
        anchored = len(runs[first - 1]) >= _ANCHOR and place < len(runs)
        if anchored and len(between) <= _LONGEST_BRIDGE:
            result |= _bridged(hands, [runs[first - 1][-1], *between, runs[place][0]], flow)
    return result


def _size(hand: HandLandmarks) -> float:
    return max(1.0, float(np.ptp(hand.points, axis=0).max()))


def _runs(hands: Mapping[int, HandLandmarks], order: list[int], flow: FlowRecorder) -> list[list[int]]:
    runs: list[list[int]] = []
    for before, index in zip([None, *order[:-1]], order, strict=True):
        if before is None or _is_break(hands[before], hands[index], flow):
            runs.append([])
        runs[-1].append(index)
    return runs


def _is_break(one: HandLandmarks, two: HandLandmarks, flow: FlowRecorder) -> bool:
    step = flow.ahead.get(one.index, {}).get(one.track)
    if step is None or step[0] != two.index:
        return True
    apart = np.sort(np.linalg.norm(two.points - step[1].carry(one.points), axis=1))
    return bool(apart[-7:].mean() > _BREAK * _size(one))


def _bridged(
    hands: Mapping[int, HandLandmarks], indices: list[int], flow: FlowRecorder
) -> dict[int, HandLandmarks]:
    """New landmarks of all but the first and last of ``indices``; none where the two ends do not meet."""
    forth = _carried(hands, indices, flow.ahead)
    back = _carried(hands, indices[::-1], flow.back)
    if forth is None or back is None:
        return {}
    back = back[::-1]
    first, last = hands[indices[0]], hands[indices[-1]]
    gaps = (
        float(np.linalg.norm(forth[-1] - last.points, axis=1).mean()) / _size(last),
        float(np.linalg.norm(back[0] - first.points, axis=1).mean()) / _size(first),
    )
    if max(gaps) > _MEET:
        return {}
    made = {}
    for step, index in enumerate(indices[1:-1], 1):
        t = step / (len(indices) - 1)
        made[index] = replace(
            hands[index],
            points=np.asarray((1 - t) * forth[step] + t * back[step], np.float32),
            world=np.asarray((1 - t) * first.world + t * last.world, np.float32),
            score=min(_BRIDGED_SCORE, hands[index].score),
            reading=hands[index].points,
        )
    return made


def _carried(
    hands: Mapping[int, HandLandmarks],
    indices: list[int],
    flow: Mapping[int, Mapping[int, tuple[int, FlowGrid]]],
) -> list[NDArray[np.float32]] | None:
    """The first hand's points in every frame of ``indices``; None where no flow connects two of them."""
    points = [hands[indices[0]].points]
    for here, there in pairwise(indices):
        step = flow.get(here, {}).get(hands[here].track)
        if step is None or step[0] != there:
            return None
        points.append(step[1].carry(points[-1]))
    return points
