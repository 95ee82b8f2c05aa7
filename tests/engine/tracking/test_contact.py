"""What one hand's mask may claim beside another hand."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from mass_engine.tracking import capsules
from mass_engine.tracking.contact import hide_other, is_apart, mixed_frames
from mass_engine.tracking.landmarks import HandLandmarks
from mass_engine.tracking.segmentation import BACKGROUND, HAND, IGNORE
from tests.engine.tracking.clips import landmarks, open_hand


def drawn(points: NDArray[np.float32]) -> NDArray[np.bool_]:
    hand = capsules.draw(points, capsules.pixels_per_mm(points), 300, 600)
    return np.asarray(hand.distance < 0, np.bool_)


def labels(*hands: HandLandmarks) -> NDArray[np.uint8]:
    """A mask that takes every hand in the picture for one's own."""
    inside = np.any([drawn(hand.points) for hand in hands], axis=0)
    return np.where(inside, np.uint8(HAND), np.uint8(BACKGROUND))


def test_hands_far_apart_do_not_concern_each_other() -> None:
    one, two = landmarks(open_hand(120, 250)), landmarks(open_hand(480, 250))
    assert is_apart(one, two)
    assert is_apart(one, None)
    mask = labels(one)
    assert hide_other(mask, one, two, (0, 0)) is mask


def test_the_other_hand_s_pixels_are_ignored_and_one_s_own_stay() -> None:
    one, two = landmarks(open_hand(160, 250)), landmarks(open_hand(330, 250))
    mask = labels(one, two)
    hidden = hide_other(mask, one, two, (0, 0))
    theirs, mine = drawn(two.points), drawn(one.points)
    assert (hidden[theirs] == IGNORE).all()
    far = cv2.distanceTransform((~theirs).astype(np.uint8), cv2.DIST_L2, 3) > 10
    assert (hidden[mine & far] == HAND).mean() > 0.99
    assert hidden[5, 5] == BACKGROUND


def test_where_hands_overlap_nothing_is_certain() -> None:
    one, two = landmarks(open_hand(200, 250)), landmarks(open_hand(240, 250))
    hidden = hide_other(labels(one, two), one, two, (0, 0))
    both = drawn(one.points) & drawn(two.points)
    assert both.sum() > 1000
    assert (hidden[both] == IGNORE).all()
    assert (hidden == HAND).any()


def test_the_window_may_lie_anywhere() -> None:
    one, two = landmarks(open_hand(160, 250)), landmarks(open_hand(330, 250))
    whole = hide_other(labels(one, two), one, two, (0, 0))
    part = hide_other(labels(one, two)[40:, 60:], one, two, (60, 40))
    assert (part == whole[40:, 60:]).mean() > 0.999


def test_frames_in_which_the_other_hand_hides_are_named() -> None:
    """The hand passes over another one, which is lost meanwhile, and goes on."""
    hands = {i: landmarks(open_hand(100 + 8 * i, 250), i) for i in range(60)}
    others = {i: landmarks(open_hand(330, 250), i, 1) for i in range(60) if not 20 <= i < 40}
    assert mixed_frames(hands, others) == set(range(20, 40))
    gone = {i: hand for i, hand in others.items() if i < 20}
    assert 30 in mixed_frames(hands, gone)
    assert 59 not in mixed_frames(hands, gone), "far from where it was lost, it does not matter"
    assert mixed_frames(hands, {}) == set()
