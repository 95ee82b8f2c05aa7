"""Which frames to fit: sharp, well lit, surely tracked ones that differ from one another.

Farthest-point sampling (Gonzalez 1985) over pose, place and time: each step takes the frame with the largest
product of its worth and its squared distance from those taken, so that fast, blurred poses are not lost.
Held-out frames have no say, and equal clips give equal choices.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mass_engine.quality import FrameQuality, pose_distances, pose_shapes
from mass_engine.tracking.landmarks import HandLandmarks

_FAST = 4.0  # hand sizes a second at which motion blur halves a frame's worth
_BLURRED = 0.15  # of the clip's sharp frames (its 75th percentile)
_CROPPED = 0.6  # share of landmarks in the picture
_BURNT = 0.5  # share of the hand's box that is black or burnt out, above the clip's median
_ALIKE, _STILL = 0.015, 0.02  # within the tracker's noise: shape, and place in hand sizes
_SOON = 0.1  # seconds: two frames alike and so close in time are one
_FEW = 8  # bad frames are left out only while this many stay


@dataclass(frozen=True)
class FrameChoice:
    """``frames`` to fit, in order, with the ``reason`` for each (``best``: the first one taken; ``pose``,
    ``place``, ``time``: what it adds most of), its ``quality`` 0..1 and ``sharpness``; ``left_out`` frames by
    reason: ``blurred``, ``cropped``, ``badly_exposed``, ``alike``, ``over_limit``."""

    frames: list[int]
    reason: list[str]
    quality: list[float]
    sharpness: list[float]
    left_out: dict[str, list[int]]

    def summary(self) -> dict[str, Any]:
        """For report.json: one list a column, and ranges of what was left out."""
        return {
            "candidates": len(self.frames) + sum(map(len, self.left_out.values())),
            "chosen": {
                "index": self.frames,
                "reason": self.reason,
                "quality": [round(value, 3) for value in self.quality],
                "sharpness": [round(value, 4) for value in self.sharpness],
            },
            "left_out": {
                reason: {"count": len(frames), "frames": ranges(frames)}
                for reason, frames in self.left_out.items()
                if frames
            },
        }


def choose_frames(
    hands: Sequence[HandLandmarks],
    quality: Mapping[int, FrameQuality],
    times: Mapping[int, float],
    limit: int,
) -> FrameChoice:
    """At most ``limit`` of ``hands`` (frames that may be fitted, in order, two or more)."""
    measures = [quality[hand.index] for hand in hands]
    sharp = np.array([m.sharpness for m in measures])
    sharp_ref = max(float(np.percentile(sharp, 75)), 1e-9)
    clock = np.array([times[hand.index] for hand in hands])
    worth = _worth(hands, measures, np.minimum(sharp / sharp_ref, 1.0), clock)
    bad = _bad(measures, sharp / sharp_ref)
    usable = np.array([reason == "" for reason in bad])
    if int(usable.sum()) < min(_FEW, len(hands)):
        usable[:] = True
    picked, reasons, alike = _spread(hands, clock, np.where(usable, worth, 0.0), limit)
    why = dict(zip(picked, reasons, strict=True))
    left: dict[str, list[int]] = {
        name: [] for name in ("blurred", "cropped", "badly_exposed", "alike", "over_limit")
    }
    for row, hand in enumerate(hands):
        if row not in why:
            left[bad[row] if not usable[row] else "alike" if row in alike else "over_limit"].append(
                hand.index
            )
    order = sorted(picked)
    return FrameChoice(
        [hands[row].index for row in order],
        [why[row] for row in order],
        [float(worth[row]) for row in order],
        [float(sharp[row]) for row in order],
        left,
    )


def ranges(indices: Sequence[int]) -> str:
    """Rising ``indices`` in short: ``3-5,9``."""
    runs: list[list[int]] = []
    for index in indices:
        if runs and index == runs[-1][1] + 1:
            runs[-1][1] = index
        else:
            runs.append([index, index])
    return ",".join(str(a) if a == b else f"{a}-{b}" for a, b in runs)


def _worth(
    hands: Sequence[HandLandmarks],
    measures: Sequence[FrameQuality],
    sharp: NDArray[np.float64],
    clock: NDArray[np.float64],
) -> NDArray[np.float64]:
    """How good each frame is, 0..1, before it is asked what it adds."""
    points = np.stack([hand.points for hand in hands]).astype(np.float64)
    scale = np.array([max(hand.scale, 1e-6) for hand in hands])
    step = np.linalg.norm(np.diff(points, axis=0), axis=2).mean(1) / np.maximum(np.diff(clock), 1e-3)
    # The slower of the two neighbouring steps: after a gap or a jump one of them says nothing.
    speed = np.minimum(np.append(step, np.inf), np.insert(step, 0, np.inf)) / scale
    seen = np.array(
        [hand.score * m.inside * (1 - m.clipped) for hand, m in zip(hands, measures, strict=True)]
    )
    return np.asarray(np.sqrt(sharp) * seen / (1 + (speed / _FAST) ** 2), np.float64)


def _bad(measures: Sequence[FrameQuality], sharp: NDArray[np.float64]) -> list[str]:
    """Why a frame should not be fitted at all, or an empty word."""
    usual = float(np.median([m.clipped for m in measures]))
    return [
        "blurred"
        if s < _BLURRED
        else "cropped"
        if m.inside < _CROPPED
        else "badly_exposed"
        if m.clipped > usual + _BURNT
        else ""
        for m, s in zip(measures, sharp, strict=True)
    ]


def _spread(
    hands: Sequence[HandLandmarks], clock: NDArray[np.float64], worth: NDArray[np.float64], limit: int
) -> tuple[list[int], list[str], set[int]]:
    """Rows taken one by one, why each, and the rows too much like one of them to be taken.

    Each part of a distance is in units of what a step of an even choice would make, so that pose, place and
    time count alike however long the clip is and however lively the hand.
    """
    count = len(clock)
    shapes = pose_shapes(hands)
    places = np.stack([hand.points for hand in hands]).astype(np.float64).reshape(count, -1)
    places /= np.sqrt(21) * float(np.median([max(hand.scale, 1e-6) for hand in hands]))

    def parts(row: int) -> NDArray[np.float64]:
        """Distances [3,count] from ``row``: of shape, of landmarks in hand sizes, of time in seconds."""
        moved = np.linalg.norm(places - places[row], axis=1)
        return np.stack([pose_distances(shapes, shapes[row]), moved, np.abs(clock - clock[row])])

    even = np.unique(np.linspace(0, count - 1, min(limit, count) + 1).round().astype(int))
    steps = np.array([parts(a)[:, b] for a, b in pairwise(even)])
    units = np.maximum(steps.mean(0), (_ALIKE, _STILL, 1e-6))[:, None]
    far = np.full(count, np.inf)
    most, alike = np.zeros(count, np.int64), np.zeros(count, bool)
    picked: list[int] = []
    reasons: list[str] = []
    row = int(np.argmax(worth))
    while True:
        picked.append(row)
        reasons.append("best" if len(picked) == 1 else ("pose", "place", "time")[most[row]])
        apart = parts(row)
        squares = (apart / units) ** 2
        nearer = squares.sum(0) < far
        far = np.where(nearer, squares.sum(0), far)
        most = np.where(nearer, squares.argmax(0), most)
        alike |= (apart < np.array([[_ALIKE], [_STILL], [_SOON]])).all(0)
        alike[picked] = True
        gain = np.where(alike, 0.0, worth * far)
        if len(picked) < limit and gain.max() > 0.0:
            row = int(np.argmax(gain))
        elif len(picked) == 1 and count > 1:
            row = int(np.argmax(apart[2]))  # nothing differs, but a fit needs two frames
        else:
            return picked, reasons, set(np.flatnonzero(alike).tolist()) - set(picked)
