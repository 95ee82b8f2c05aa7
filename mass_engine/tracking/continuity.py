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
_QUIET = 0.04  # the same distance below which landmarks are believed without asking the picture
#: A break this large is a change of mind; a smaller one may be fast motion that flow does not follow.
_MISREAD = 0.14
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


#: One step of a hand: the frame it leads to, and the flow where the picture had to be asked.
Step = tuple[int, FlowGrid | None]


class FlowRecorder:
    """Steps of every hand from frame to frame, both ways; holds one picture at a time.

    ``ahead[i][track]`` leads from frame i to the next one given, ``back[i][track]`` to the one before. Flow
    is computed where landmarks do not move as before, which is what a break looks like, and for as long
    after a break as a bridge may be.
    """

    def __init__(self) -> None:
        self.ahead: dict[int, dict[int, Step]] = {}
        self.back: dict[int, dict[int, Step]] = {}
        self._flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)
        self._last: tuple[int, NDArray[np.uint8], list[HandLandmarks]] | None = None
        self._motion: dict[int, NDArray[np.float32]] = {}
        self._bridging = 0
        self._unbroken: list[int] = []  # frames since the last break that steps lead to

    def add(self, rgb: NDArray[np.uint8], index: int, hands: list[HandLandmarks]) -> None:
        """The next frame uint8 [H,W,3] and the hands in it."""
        grey = np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), np.uint8)
        now = {hand.track: hand for hand in hands}
        motion: dict[int, NDArray[np.float32]] = {}
        if self._last is not None and index - self._last[0] <= _STEP:
            before, old, others = self._last
            steps = self.ahead.setdefault(before, {})
            self._bridging = max(0, self._bridging - 1)
            for hand in others:
                two = now.get(hand.track)
                if two is not None:
                    motion[hand.track] = two.points - hand.points
                if two is not None and not self._bridging and self._moves_on(hand, two):
                    steps[hand.track] = index, None
                    continue
                steps[hand.track] = index, self._between(old, grey, hand)
                if two is None:
                    continue
                if _is_break(hand, two, self):
                    self._bridging = _LONGEST_BRIDGE + 1
                    self._unbroken = []
                elif not self._bridging:
                    steps[hand.track] = index, None
            self.back[index] = {
                hand.track: (before, self._between(grey, old, hand) if self._bridging else None)
                for hand in hands
            }
            if self._bridging:
                self._unbroken.append(index)
            else:
                self._forget()
        else:
            # Where a hand comes into view it may be misread, too.
            self._bridging = _LONGEST_BRIDGE + 1
            self._unbroken = []
        self._last = index, grey, hands
        self._motion = motion

    def _forget(self) -> None:
        """Drop the flow of a long run without a break: no bridge will lead over it."""
        for index in self._unbroken[1:]:
            steps = self.back[index]
            self.back[index] = {track: (before, None) for track, (before, _) in steps.items()}
            for before in {before for before, _ in steps.values()}:
                self.ahead[before] = {track: (to, None) for track, (to, _) in self.ahead[before].items()}
        self._unbroken = []

    def _moves_on(self, one: HandLandmarks, two: HandLandmarks) -> bool:
        """Whether a hand stays, or goes on as it went before: then there is no break."""
        moved = two.points - one.points
        steady = self._motion.get(one.track, np.zeros_like(moved))
        off = min(_worst(moved), _worst(moved - steady))
        return off < _QUIET * _size(one)

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


def bridge(
    hands: Mapping[int, HandLandmarks], flow: FlowRecorder
) -> tuple[dict[int, HandLandmarks], set[int]]:
    """``hands`` by frame, in order, with short runs between breaks carried over from their neighbours; and
    the frames of short runs that a clear break parts from the rest at one end, while at the other there is
    nothing to meet: where the hand comes or goes. Those are not to be trusted."""
    result = dict(hands)
    loose: set[int] = set()
    for runs in _stretches(hands, flow):
        anchors = [place for place, run in enumerate(runs) if len(run) >= _ANCHOR]
        parting = _parting(hands, runs, flow)
        if not anchors:
            frames = {index for run in runs for index in run}
            if len(frames) < _ANCHOR and max(parting, default=0.0) > _MISREAD:
                loose |= frames
            continue
        for one, two in pairwise(anchors):
            between = [index for run in runs[one + 1 : two] for index in run]
            if between and len(between) <= _LONGEST_BRIDGE:
                result |= _bridged(hands, [runs[one][-1], *between, runs[two][0]], flow)
        early = [place for place in range(anchors[0]) if parting[place] > _MISREAD]
        late = [place for place in range(anchors[-1], len(parting)) if parting[place] > _MISREAD]
        for ends in (runs[: early[-1] + 1] if early else [], runs[late[0] + 1 :] if late else []):
            frames = {index for run in ends for index in run}
            loose |= frames if len(frames) <= _LONGEST_BRIDGE else set()
    return result, loose


def _parting(hands: Mapping[int, HandLandmarks], runs: list[list[int]], flow: FlowRecorder) -> list[float]:
    """How far each run begins from where the picture carries the end of the one before."""
    return [_off(hands[one[-1]], hands[two[0]], flow) for one, two in pairwise(runs)]


def _size(hand: HandLandmarks) -> float:
    return max(1.0, float(np.ptp(hand.points, axis=0).max()))


def _worst(apart: NDArray[np.float32]) -> float:
    """Mean length of the longest third of the vectors [21,2]."""
    return float(np.sort(np.linalg.norm(apart, axis=1))[-7:].mean())


def _stretches(hands: Mapping[int, HandLandmarks], flow: FlowRecorder) -> list[list[list[int]]]:
    """Frames that follow each other, cut into runs at breaks."""
    stretches: list[list[list[int]]] = []
    order = sorted(hands)
    for before, index in zip([None, *order[:-1]], order, strict=True):
        if before is None or _step(hands[before], hands[index], flow) is None:
            stretches.append([[]])
        elif _is_break(hands[before], hands[index], flow):
            stretches[-1].append([])
        stretches[-1][-1].append(index)
    return stretches


def _step(one: HandLandmarks, two: HandLandmarks, flow: FlowRecorder) -> Step | None:
    """The recorded step from ``one`` to ``two``, None where frames are missing between them."""
    step = flow.ahead.get(one.index, {}).get(one.track)
    return step if step is not None and step[0] == two.index else None


def _is_break(one: HandLandmarks, two: HandLandmarks, flow: FlowRecorder) -> bool:
    """Whether ``two`` is not where the picture carries ``one``."""
    return _off(one, two, flow) > _BREAK


def _off(one: HandLandmarks, two: HandLandmarks, flow: FlowRecorder) -> float:
    """How far ``two`` is from where the picture carries ``one``, in sides of the box; 0 without flow."""
    step = _step(one, two, flow)
    if step is None or (step[1] is None and one.track == two.track):
        return 0.0
    expected = one.points if step[1] is None else step[1].carry(one.points)
    return _worst(two.points - expected) / _size(one)


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
    flow: Mapping[int, Mapping[int, Step]],
) -> list[NDArray[np.float32]] | None:
    """The first hand's points in every frame of ``indices``; None where no flow connects two of them."""
    points = [hands[indices[0]].points]
    for here, there in pairwise(indices):
        step = flow.get(here, {}).get(hands[here].track)
        if step is None or step[0] != there or step[1] is None:
            return None
        points.append(step[1].carry(points[-1]))
    return points
