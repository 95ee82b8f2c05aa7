"""The main hand of a clip, or both of a person: which of the hands followed, their sides, frames to trust.

Nothing here about a frame that is not held out depends on a frame that is.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from mass_engine.errors import EngineError
from mass_engine.hand.pose import Side
from mass_engine.tracking.between import between
from mass_engine.tracking.continuity import FlowRecorder, bridge
from mass_engine.tracking.landmarks import BONES, HandLandmarks
from mass_engine.tracking.models import HandNetworks
from mass_engine.tracking.sides import SIDES, label_sides
from mass_engine.tracking.tracker import HandTracker, TrackerOptions
from mass_engine.video.reader import Frame

_MIN_FRAMES, _MIN_SHARE, _ENOUGH_FRAMES = 5, 0.1, 30
_MIN_SCALE = 40.0  # pixels, diagonal of the landmarks' box
_JUMP = 0.2  # distance from where the neighbours put the hand, in hand sizes
_BONE_CHANGE = 0.8  # mean absolute log ratio of the bones' lengths to the clip's
_SURE_SIDE = 0.3  # how far from 1/2 the mean probability of a side must be
_NEAR = 6  # frames: neighbours further away say nothing about a jump


@dataclass(frozen=True)
class Track:
    """The main hand over a clip.

    ``hands`` by frame index, in order, all with the voted ``side``; ``side_confidence`` 0.5..1 is the
    share of the vote that went to it; ``times`` in seconds of all frames read; ``heldout`` frame indices;
    ``width``, ``height`` of the frames in pixels; ``other_hands`` the most frames in which any one other
    hand was followed; ``same_side`` those in which another hand, surely of the same side, was seen beside it.
    ``estimated``: held-out frames in which it was misread or lost, from their neighbours (:mod:`.between`).
    """

    side: Side
    side_confidence: float
    hands: Mapping[int, HandLandmarks]
    times: tuple[float, ...]
    heldout: frozenset[int]
    width: int
    height: int
    other_hands: int
    same_side: int = 0
    estimated: Mapping[int, HandLandmarks] = field(default_factory=dict)

    @property
    def missed(self) -> list[int]:
        """Frames in which the main hand was not found."""
        return [i for i in range(len(self.times)) if i not in self.hands]

    @property
    def trusted(self) -> list[int]:
        """Frames to fit to: tracked, trusted, not held out."""
        return [i for i, hand in self.hands.items() if hand.trusted and i not in self.heldout]


class TrackBuilder:
    """Collects tracking results frame by frame, for callers that use the images in the same pass."""

    def __init__(self, networks: HandNetworks, options: TrackerOptions | None = None) -> None:
        self._tracker = HandTracker(networks, options)
        self._flow = FlowRecorder()
        self._found: dict[int, list[HandLandmarks]] = {}
        self._times: list[float] = []
        self._heldout: set[int] = set()
        self._size = (0, 0)

    def add(self, frame: Frame, heldout: bool = False) -> list[HandLandmarks]:
        """Track ``frame``; frames come in order, each once. Returns every hand seen in it."""
        hands = self._tracker(frame.rgb, frame.index, update=not heldout)
        self._found[frame.index] = hands
        self._times.append(frame.time)
        self._size = frame.rgb.shape[1], frame.rgb.shape[0]
        if heldout:
            self._heldout.add(frame.index)
        else:
            self._flow.add(frame.rgb, frame.index, hands)
        return hands

    def finish(self) -> Track:
        """Choose the main hand. Raises EngineError ``video.no_hand`` or ``video.hand_too_small``."""
        return main_hand(self._found, self._times, self._heldout, *self._size, self._flow)

    def finish_both(self) -> dict[Side, Track]:
        """The right and the left hand, see :func:`both_hands`."""
        return both_hands(self._found, self._times, self._heldout, *self._size, self._flow)


def track_main_hand(
    frames: Iterable[Frame],
    networks: HandNetworks,
    is_heldout: Callable[[int], bool] | None = None,
    options: TrackerOptions | None = None,
) -> Track:
    """Follow the main hand through ``frames``, keeping no image. See :class:`TrackBuilder`."""
    builder = TrackBuilder(networks, options)
    for frame in frames:
        builder.add(frame, is_heldout is not None and is_heldout(frame.index))
    return builder.finish()


def main_hand(
    found: Mapping[int, Sequence[HandLandmarks]],
    times: Sequence[float],
    heldout: Iterable[int],
    width: int,
    height: int,
    flow: FlowRecorder | None = None,
) -> Track:
    """Choose the main hand among all ``found`` hands by frame, vote on its side, mark its outliers.

    With ``flow`` its landmarks are bridged where they jump and the picture does not.
    """
    held = frozenset(heldout)
    runs: dict[int, dict[int, HandLandmarks]] = {}
    for index, seen in found.items():
        for hand in seen if index not in held else ():
            runs.setdefault(hand.track, {})[index] = hand
    chosen = _choose(runs)
    hands = {i: h for track in chosen for i, h in runs[track].items()}
    _require_hand(hands, len(times) - len(held))
    others = max((len(run) for track, run in runs.items() if track not in chosen), default=0)
    same = _same_side([run for track, run in runs.items() if track not in chosen], hands)
    right = _mean_right(hands)
    side: Side = "right" if right >= 0.5 else "left"
    hands, doubted = _put_right(hands, flow)
    trusted = {i: h for i, h in hands.items() if i not in doubted}
    marked = {i: replace(h, side=side, trusted=i not in doubted) for i, h in hands.items()}
    read = {index: _pick(found[index], chosen, trusted) for index in sorted(held & found.keys())}
    kept, estimated = _hold_out(read, marked, trusted)
    return Track(
        side, max(right, 1 - right), kept, tuple(times), held, width, height, others, same, estimated
    )


def both_hands(
    found: Mapping[int, Sequence[HandLandmarks]],
    times: Sequence[float],
    heldout: Iterable[int],
    width: int,
    height: int,
    flow: FlowRecorder | None = None,
) -> dict[Side, Track]:
    """The right and the left hand of one person, or only the one that is there; as :func:`main_hand`.

    Raises EngineError ``video.no_hand`` or ``video.hand_too_small`` when neither can be used.
    """
    held = frozenset(heldout)
    labelled = label_sides({i: seen for i, seen in found.items() if i not in held})
    tracks: dict[Side, Track] = {}
    errors: list[EngineError] = []
    for side in SIDES:
        hands = {i: pair[side] for i, pair in labelled.items() if side in pair}
        try:
            _require_hand(hands, len(times) - len(held))
        except EngineError as error:
            errors.append(error)
            continue
        right = _mean_right(hands)
        hands, doubted = _put_right(hands, flow)
        trusted = {i: h for i, h in hands.items() if i not in doubted}
        marked = {i: replace(h, side=side, trusted=i not in doubted) for i, h in hands.items()}
        read: dict[int, HandLandmarks | None] = {}
        for index in sorted(held & found.keys()):
            # A held-out frame is read from where the frame before left the tracker: its tracks are those.
            before = max((i for i in labelled if i < index), default=None)
            last = None if before is None else labelled[before].get(side)
            read[index] = _pick(found[index], [] if last is None else [last.track], trusted)
        kept, estimated = _hold_out(read, marked, trusted)
        others = sum(side not in pair for pair in labelled.values())
        certainty = right if side == "right" else 1 - right
        tracks[side] = Track(
            side, certainty, kept, tuple(times), held, width, height, others, estimated=estimated
        )
    if not tracks:
        raise errors[0]
    return tracks


def _mean_right(hands: Mapping[int, HandLandmarks]) -> float:
    """The vote on the side: the mean probability of a right hand, weighted by presence."""
    votes = np.array([hand.right for hand in hands.values()])
    weights = np.array([hand.score for hand in hands.values()])
    return float((votes * weights).sum() / weights.sum())


def _put_right(
    hands: Mapping[int, HandLandmarks], flow: FlowRecorder | None
) -> tuple[dict[int, HandLandmarks], set[int]]:
    """``hands`` with short misreadings bridged, and the frames not to trust."""
    if flow is None:
        return dict(hands), _outliers(hands)
    bridged, loose = bridge(hands, flow)
    return bridged, _outliers(bridged) | loose


def _hold_out(
    read: Mapping[int, HandLandmarks | None],
    hands: Mapping[int, HandLandmarks],
    trusted: Mapping[int, HandLandmarks],
) -> tuple[dict[int, HandLandmarks], dict[int, HandLandmarks]]:
    """``hands`` with what was ``read`` in held-out frames, in order; and estimates where that is not to be
    trusted, or nothing was read."""
    kept, estimated = dict(hands), {}
    side = next(iter(hands.values())).side
    for index, hand in read.items():
        good = hand is not None and _jump(hand, trusted) <= _JUMP
        if hand is not None:
            kept[index] = replace(hand, side=side, trusted=good)
        guess = None if good else between(index, hand, hands, trusted)
        if guess is not None:
            estimated[index] = guess
    return dict(sorted(kept.items())), estimated


def _choose(runs: Mapping[int, Mapping[int, HandLandmarks]]) -> list[int]:
    """The heaviest run, and the runs that continue it: other frames, not clearly the other side."""

    def weight(track: int) -> float:
        return sum(hand.score * hand.scale for hand in runs[track].values())

    chosen: list[int] = []
    taken: set[int] = set()
    main_side = 0.0
    for track in sorted(runs, key=weight, reverse=True):
        side = float(np.mean([hand.right for hand in runs[track].values()])) - 0.5
        if not chosen:
            main_side = side
        opposite = (
            len(runs[track]) >= 10 and side * main_side < 0 and min(abs(side), abs(main_side)) > _SURE_SIDE
        )
        if opposite or taken & runs[track].keys():
            continue
        chosen.append(track)
        taken |= runs[track].keys()
    return chosen


def _same_side(others: Sequence[Mapping[int, HandLandmarks]], main: Mapping[int, HandLandmarks]) -> int:
    """Frames in which one of ``others`` is beside ``main`` and surely of the same side: not one person's."""
    side = float(np.mean([hand.right for hand in main.values()])) - 0.5
    frames: set[int] = set()
    for run in others:
        other = float(np.mean([hand.right for hand in run.values()])) - 0.5
        if side * other > 0 and min(abs(side), abs(other)) > _SURE_SIDE:
            frames |= run.keys() & main.keys()
    return len(frames)


def _require_hand(hands: Mapping[int, HandLandmarks], frames: int) -> None:
    needed = min(frames, max(_MIN_FRAMES, min(_ENOUGH_FRAMES, round(_MIN_SHARE * frames))))
    if not hands or len(hands) < needed:
        raise EngineError(
            "video.no_hand",
            f"A hand was found in {len(hands)} of {frames} frames.",
            "Film one bare hand, whole, in good light, filling at least a quarter of the picture.",
        )
    scale = float(np.median([hand.scale for hand in hands.values()]))
    if scale < _MIN_SCALE:
        raise EngineError(
            "video.hand_too_small",
            f"The hand is only {scale:.0f} pixels across.",
            "Move the camera closer, or record at a higher resolution.",
        )


def _pick(
    hands: Sequence[HandLandmarks], chosen: Sequence[int], trusted: Mapping[int, HandLandmarks]
) -> HandLandmarks | None:
    """The main hand in a held-out frame: of a chosen run, else a newly found one where it should be."""
    for hand in hands:
        if hand.track in chosen:
            return hand
    new = [hand for hand in hands if hand.track < 0 and _jump(hand, trusted) <= 2 * _JUMP]
    return min(new, key=lambda hand: _jump(hand, trusted), default=None)


def _jump(hand: HandLandmarks, others: Mapping[int, HandLandmarks]) -> float:
    """Mean distance of ``hand`` from where its neighbours in time put it, in hand sizes; 0 without any."""
    before = max((i for i in others if hand.index - _NEAR <= i < hand.index), default=None)
    after = min((i for i in others if hand.index < i <= hand.index + _NEAR), default=None)
    if before is None and after is None:
        return 0.0
    if before is not None and after is not None:
        t = (hand.index - before) / (after - before)
        expected = (1 - t) * others[before].points + t * others[after].points
        slack = 1.0
    else:
        expected = others[before if after is None else after].points  # type: ignore[index]
        slack = 0.4  # with a neighbour on one side only, plain motion looks like a jump
    apart = float(np.linalg.norm(hand.points - expected, axis=1).mean())
    return slack * apart / max(hand.scale, 1e-6)


def _bone_lengths(hand: HandLandmarks) -> NDArray[np.float64]:
    parents, children = (list(side) for side in zip(*BONES, strict=True))
    lengths = np.linalg.norm(hand.world[children] - hand.world[parents], axis=1).astype(np.float64)
    return np.asarray(np.maximum(lengths, 1e-4), np.float64)


def _outliers(hands: Mapping[int, HandLandmarks]) -> set[int]:
    """Frames whose hand jumps away from its neighbours or has bones unlike the rest of the clip."""
    lengths = {i: np.log(_bone_lengths(hand)) for i, hand in hands.items()}
    usual = np.median(np.stack(list(lengths.values())), axis=0)
    doubted = {i for i, log in lengths.items() if float(np.abs(log - usual).mean()) > _BONE_CHANGE}
    for _ in range(3):  # the worst first: an outlier makes its neighbours look like jumps, too
        kept = {i: h for i, h in hands.items() if i not in doubted}
        jumps = {i: _jump(h, kept) for i, h in kept.items()}
        order = sorted(jumps)
        peaks = {
            i
            for before, i, after in zip([None, *order[:-1]], order, [*order[1:], None], strict=True)
            if jumps[i] > _JUMP and jumps[i] >= max(jumps.get(before, 0), jumps.get(after, 0))  # type: ignore[arg-type]
        }
        if not peaks:
            break
        doubted |= peaks
    return doubted
