"""Bridging landmarks that jump although the picture does not."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from mass_engine.tracking.continuity import FlowRecorder, bridge
from mass_engine.tracking.landmarks import HandLandmarks

FRAMES = 40


def texture() -> NDArray[np.uint8]:
    """Soft blobs, so that flow finds its way."""
    noise = np.random.default_rng(0).random((80, 100, 3))
    return (cv2.resize(noise, (400, 320), interpolation=cv2.INTER_CUBIC).clip(0, 1) * 255).astype(np.uint8)


def shift(frame: int, speed: float) -> tuple[float, float]:
    return speed * frame, 0.5 * speed * frame


def picture(frame: int, speed: float) -> NDArray[np.uint8]:
    """The texture moved by ``speed`` pixels a frame."""
    dx, dy = shift(frame, speed)
    moved = cv2.warpAffine(
        texture(), np.array([[1.0, 0, dx], [0, 1.0, dy]]), (400, 320), borderMode=cv2.BORDER_REFLECT
    )
    return np.asarray(moved, np.uint8)


def true_points(frame: int, speed: float) -> NDArray[np.float32]:
    rest = np.random.default_rng(1).uniform((120, 80), (240, 200), (21, 2))
    return (rest + shift(frame, speed)).astype(np.float32)


def hand(frame: int, points: NDArray[np.float32]) -> HandLandmarks:
    return HandLandmarks(frame, "right", points, np.full((21, 3), float(frame), np.float32), 0.9, 0.9)


def clip(
    wrong: range, speed: float = 1.0, skip: tuple[int, ...] = ()
) -> tuple[dict[int, HandLandmarks], FlowRecorder]:
    """A clip whose landmarks are mixed up in the frames of ``wrong``."""
    flow, hands = FlowRecorder(), {}
    for frame in range(FRAMES):
        if frame in skip:
            continue
        points = true_points(frame, speed)
        if frame in wrong:
            points = points[np.random.default_rng(2).permutation(21)]
        hands[frame] = hand(frame, points)
        flow.add(picture(frame, speed), frame, [hands[frame]])
    return hands, flow


@pytest.mark.parametrize("skip", [(), (7, 15, 19, 23, 31)])
def test_a_short_wrong_run_is_bridged(skip: tuple[int, ...]) -> None:
    hands, flow = clip(range(16, 22), skip=skip)
    bridged, loose = bridge(hands, flow)
    assert not loose
    for frame, made in bridged.items():
        apart = np.linalg.norm(made.points - true_points(frame, 1.0), axis=1).mean()
        assert apart < 2.0, frame
        assert (made.score < 0.5) == (16 <= frame < 22)
        assert np.array_equal(made.as_read, hands[frame].points)
        assert made.world[0, 0] == pytest.approx(frame, abs=0.7)
        if not 16 <= frame < 22:
            assert made == hands[frame] or np.array_equal(made.points, hands[frame].points)


def test_what_moves_with_the_picture_stays() -> None:
    hands, flow = clip(range(0), speed=4.0)
    assert all(bridged is hands[frame] for frame, bridged in bridge(hands, flow)[0].items())


def test_a_long_run_is_believed() -> None:
    hands, flow = clip(range(14, 28))
    assert all(bridged is hands[frame] for frame, bridged in bridge(hands, flow)[0].items())


@pytest.mark.parametrize("wrong", [range(35, 40), range(6)])
def test_a_run_at_an_end_has_nothing_to_meet_and_is_not_trusted(wrong: range) -> None:
    hands, flow = clip(wrong)
    bridged, loose = bridge(hands, flow)
    assert all(made is hands[frame] for frame, made in bridged.items())
    assert loose == set(wrong)


def test_a_hand_that_returns_for_a_moment_is_believed() -> None:
    """A gap is no break: nothing contradicts the few frames behind it."""
    hands, flow = clip(range(0), skip=(28, 29, 30, 31, 32, 33))
    assert bridge(hands, flow)[1] == set()


def test_a_small_break_near_an_end_is_no_misreading() -> None:
    hands, flow = clip(range(0))
    for frame in range(35, FRAMES):
        hands[frame] = replace(hands[frame], points=hands[frame].points + np.float32(11))
    assert bridge(hands, flow)[1] == set()


def test_a_moment_that_contradicts_itself_is_not_trusted() -> None:
    """Seen for a few frames after a gap, and read in two ways."""
    hands, flow = clip(range(38, 40), skip=(28, 29, 30, 31, 32, 33))
    assert bridge(hands, flow)[1] == set(range(34, 40))


def test_flow_is_only_computed_at_first_and_where_landmarks_leave_their_way() -> None:
    def computed(flow: FlowRecorder) -> list[int]:
        return [i for i, steps in flow.ahead.items() for step in steps.values() if step[1] is not None]

    assert computed(clip(range(0), speed=1.0)[1]) == [0]
    assert computed(clip(range(35, 38))[1])[-5:] == [34, 35, 36, 37, 38]


def test_ends_that_do_not_meet_are_left_alone() -> None:
    """After the break the hand is elsewhere for good: nothing says which side is right."""
    hands, flow = clip(range(0))
    for frame in range(16, FRAMES):
        moved = hands[frame].points + np.float32(80 if frame >= 20 else 40)
        hands[frame] = replace(hands[frame], points=moved)
    assert all(bridged is hands[frame] for frame, bridged in bridge(hands, flow)[0].items())


def test_a_gap_without_flow_is_not_crossed() -> None:
    hands, flow = clip(range(16, 22), skip=(17, 18, 19, 20))
    assert all(bridged is hands[frame] for frame, bridged in bridge(hands, flow)[0].items())
