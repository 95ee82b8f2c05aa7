"""Which of the hands followed is the right one and which the left, over a whole clip.

Tracks say which hand is which from frame to frame, but two hands that touch or cross may take over each
other's track; the network says left or right in every frame, but is often wrong. The most likely labelling
weighs both (Viterbi 1967 over two states): hands keep their side unless they were close, and then the
handedness before and after decides.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from mass_engine.hand.pose import Side
from mass_engine.tracking.landmarks import HandLandmarks

SIDES: tuple[Side, Side] = ("right", "left")

#: Frames in a row are wrong together: the log-odds of one count only so much.
_VOTE = 0.2
_LIMIT = 0.05  # no reading is surer than this
_SWAP_NEAR, _SWAP_APART = 2.0, 40.0  # what a track pays for another side, in log-odds
_NEAR = 1.0  # sizes of the larger hand between two hands' middles: their tracks may mix
#: A lone hand that is lost and soon found where it was is the same one, most likely.
_SOON, _PLACE, _SWAP_FOUND = 15, 0.6, 6.0


def label_sides(
    found: Mapping[int, Sequence[HandLandmarks]],
) -> dict[int, dict[Side, HandLandmarks]]:
    """The right and the left hand by frame, for frames in which there is one.

    ``found`` hands by frame, those of one ``track`` following each other. Of more than two hands in a frame
    the two most certain ones count: this is one person.
    """
    frames = [index for index in sorted(found) if found[index]]
    if not frames:
        return {}
    hands = [_two(found[index]) for index in frames]
    # State 0: the first hand is the right one. A lone hand has the missing one beside it.
    costs = np.array([[_vote(one, 0), _vote(one, 1)] for one in hands])
    best = costs[0]
    back = np.zeros((len(hands), 2), np.int64)
    for step in range(1, len(hands)):
        moves = _moves(hands[step - 1], hands[step])
        total = best[:, None] + moves
        back[step] = total.argmin(0)
        best = total.min(0) + costs[step]
    state = int(best.argmin())
    states = [state]
    for step in range(len(hands) - 1, 0, -1):
        state = int(back[step][state])
        states.append(state)
    return {
        index: {SIDES[place ^ state]: hand for place, hand in enumerate(two)}
        for index, two, state in zip(frames, hands, reversed(states), strict=True)
    }


def _two(hands: Sequence[HandLandmarks]) -> list[HandLandmarks]:
    return sorted(sorted(hands, key=lambda hand: -hand.score)[:2], key=lambda hand: hand.track)


def _vote(hands: Sequence[HandLandmarks], state: int) -> float:
    """Negative log-likelihood of the network's handedness when the first hand is ``SIDES[state]``."""
    total = 0.0
    for place, hand in enumerate(hands):
        right = float(np.clip(hand.right, _LIMIT, 1 - _LIMIT))
        total -= _VOTE * hand.score * float(np.log(right if place ^ state == 0 else 1 - right))
    return total


def _moves(before: Sequence[HandLandmarks], now: Sequence[HandLandmarks]) -> NDArray[np.float64]:
    """Cost [2,2] from a state of ``before`` to one of ``now``: hands that go on should keep their sides."""
    price = _SWAP_NEAR if _are_near(before) or _are_near(now) else _SWAP_APART
    cost = np.zeros((2, 2))
    for old, one in enumerate(before):
        for new, two in enumerate(now):
            if one.track == two.track:
                keeps = price
            elif (
                len(before) == len(now) == 1 and two.index - one.index <= _SOON and _apart(one, two) < _PLACE
            ):
                keeps = _SWAP_FOUND
            else:
                continue
            for a, b in ((0, 0), (0, 1), (1, 0), (1, 1)):
                cost[a, b] += keeps * float((old ^ a) != (new ^ b))
    return cost


def _apart(one: HandLandmarks, two: HandLandmarks) -> float:
    """Distance of two hands' middles in sizes of the larger one."""
    apart = float(np.linalg.norm(one.points.mean(0) - two.points.mean(0)))
    return apart / max(one.scale, two.scale, 1e-6)


def _are_near(hands: Sequence[HandLandmarks]) -> bool:
    return len(hands) == 2 and _apart(hands[0], hands[1]) < _NEAR
