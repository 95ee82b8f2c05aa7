"""Choosing the main hand, its side and its trustworthy frames, on readings made by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mass_engine.errors import EngineError
from mass_engine.tracking.landmarks import HandLandmarks
from mass_engine.tracking.track import Track, main_hand
from tests.engine.tracking.clips import landmarks, open_hand


def moving_hand(
    indices: range, track: int = 0, right: float = 0.95, x: float = 100.0, scale: float = 1.0
) -> dict[int, list[HandLandmarks]]:
    """A hand that drifts two pixels a frame."""
    return {i: [landmarks(open_hand(x + 2 * i, 250, scale), i, track, right)] for i in indices}


def together(*hands: dict[int, list[HandLandmarks]]) -> dict[int, list[HandLandmarks]]:
    result: dict[int, list[HandLandmarks]] = {}
    for run in hands:
        for index, found in run.items():
            result.setdefault(index, []).extend(found)
    return result


def choose(found: dict[int, list[HandLandmarks]], count: int, heldout: set[int] | None = None) -> Track:
    return main_hand(found, [i / 30 for i in range(count)], heldout or set(), 640, 480)


def test_the_side_is_voted_over_the_clip() -> None:
    found = moving_hand(range(20))
    for i in (3, 4, 11):
        found[i] = [replace(found[i][0], right=0.1, side="left")]
    result = choose(found, 20)
    assert {hand.side for hand in result.hands.values()} == {"right"}
    assert 0.7 < result.side_confidence < 0.95


def test_held_out_frames_do_not_vote() -> None:
    found = moving_hand(range(20), right=0.6)
    held = set(range(1, 20, 2))
    for i in held:
        found[i] = [replace(found[i][0], right=0.0, side="left")]
    assert choose(found, 20, held).side == "right"
    assert choose(found, 20).side == "left"


def test_a_later_run_continues_the_hand_and_a_simultaneous_one_does_not() -> None:
    found = together(
        moving_hand(range(10), track=0),
        moving_hand(range(14, 30), track=1),
        moving_hand(range(5, 20), track=2, x=350, scale=0.6),
    )
    result = choose(found, 30)
    assert {hand.track for hand in result.hands.values()} == {0, 1}
    assert result.missed == [10, 11, 12, 13]
    assert result.other_hands == 15


def test_the_other_hand_alone_is_not_taken_for_the_main_one() -> None:
    found = together(moving_hand(range(20), right=0.97), moving_hand(range(20, 32), track=1, right=0.03))
    assert max(choose(found, 32).hands) == 19


@pytest.mark.parametrize(("right", "frames"), [(0.95, 15), (0.05, 0), (0.6, 0)])
def test_a_second_hand_of_the_same_side_is_counted(right: float, frames: int) -> None:
    """Another person's; the same person's other hand and an unsure reading are not."""
    found = together(
        moving_hand(range(30), track=0), moving_hand(range(5, 20), track=1, right=right, x=350, scale=0.6)
    )
    assert choose(found, 30).same_side == frames


def test_a_jump_is_not_trusted_and_its_neighbours_are() -> None:
    found = moving_hand(range(20))
    found[9] = [replace(found[9][0], points=found[9][0].points + np.float32(90))]
    result = choose(found, 20)
    assert [i for i, hand in result.hands.items() if not hand.trusted] == [9]
    assert 9 not in result.trusted
    assert set(result.trusted) == set(range(20)) - {9}


def test_bones_unlike_the_rest_of_the_clip_are_not_trusted() -> None:
    found = moving_hand(range(20))
    found[5] = [replace(found[5][0], world=found[5][0].world * np.float32(0.3))]
    assert [i for i, hand in choose(found, 20).hands.items() if not hand.trusted] == [5]


def test_a_held_out_frame_takes_the_new_hand_only_where_the_main_one_should_be() -> None:
    found = moving_hand(range(20))
    here, away = found[7][0], landmarks(open_hand(450, 250), 7, -1)
    found[7] = [away, replace(here, track=-1)]
    result = choose(found, 20, {7})
    np.testing.assert_array_equal(result.hands[7].points, here.points)
    assert 7 not in result.trusted, "held-out frames are never fitted to"
    found[7] = [away]
    assert 7 not in choose(found, 20, {7}).hands


def test_a_held_out_frame_that_is_misread_or_lost_is_estimated_from_its_neighbours() -> None:
    found = moving_hand(range(40))
    expected = found[9][0].points
    jumped = [replace(found[9][0], points=expected + np.float32(90))]
    for there in (jumped, []):
        result = choose(found | {9: there}, 40, {9})
        assert list(result.estimated) == [9]
        estimate = result.estimated[9]
        np.testing.assert_allclose(estimate.points, expected, atol=1e-3)
        assert estimate.score < 0.2
        assert estimate.index == 9
        assert 9 not in result.trusted
        assert (9 in result.hands) == bool(there), "an estimate is no frame tracked"
    np.testing.assert_array_equal(choose(found | {9: jumped}, 40, {9}).estimated[9].as_read, jumped[0].points)


def test_a_held_out_frame_is_not_estimated_where_the_hand_may_be_gone() -> None:
    """It is taken to be there for a few frames more, and through gaps of a second."""
    away = moving_hand(range(20)) | {i: [] for i in range(20, 60)} | moving_hand(range(60, 80), track=1)
    assert list(choose(away, 80, {7, 23, 31, 39, 57}).estimated) == [23, 57]
    short = moving_hand(range(20)) | {i: [] for i in range(20, 45)} | moving_hand(range(45, 80), track=1)
    assert list(choose(short, 80, {7, 23, 31, 39}).estimated) == [23, 31, 39]
    ended = moving_hand(range(20)) | {i: [] for i in range(20, 40)}
    assert list(choose(ended, 40, {23, 31}).estimated) == [23]


def test_an_estimate_beyond_the_trusted_frames_has_their_pose_where_the_hand_was_read() -> None:
    found = moving_hand(range(20))
    last = found[18][0].points
    far = found[19][0].points + np.array((0, 150), np.float32)
    found[19] = [replace(found[19][0], points=far)]
    estimate = choose(found, 20, {19}).estimated[19]
    np.testing.assert_allclose(estimate.points - estimate.points[0], last - last[0], atol=1e-3)
    np.testing.assert_allclose(estimate.points.mean(0), far.mean(0), atol=1e-2)
    np.testing.assert_array_equal(estimate.as_read, far)


@pytest.mark.parametrize(
    ("tracked", "frames", "fails"),
    [(4, 40, True), (5, 40, False), (3, 3, False), (11, 120, True), (12, 120, False), (30, 2000, False)],
)
def test_how_many_frames_are_enough(tracked: int, frames: int, fails: bool) -> None:
    found = {i: [landmarks(open_hand(), i)] for i in range(tracked)}
    if not fails:
        assert len(choose(found, frames).hands) == tracked
        return
    with pytest.raises(EngineError, match=f"{tracked} of {frames}") as caught:
        choose(found, frames)
    assert caught.value.code == "video.no_hand"


def test_a_tiny_hand_is_refused() -> None:
    with pytest.raises(EngineError) as caught:
        choose(moving_hand(range(10), scale=0.15), 10)
    assert caught.value.code == "video.hand_too_small"
