"""Which frames are fitted, and why."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mass_engine.frame_choice import FrameChoice, choose_frames, ranges
from mass_engine.quality import FrameQuality
from mass_engine.tracking.landmarks import HandLandmarks
from tests.engine.tracking.clips import landmarks, open_hand

GOOD = FrameQuality(sharpness=0.1, light=120.0, clipped=0.0, inside=1.0)


def squeezed(phases: list[float]) -> list[HandLandmarks]:
    """Hands of as many poses as there are different ``phases``, 0 to 1."""
    hands = []
    for i, phase in enumerate(phases):
        points = open_hand(0, 0)
        points[:, 0] *= np.float32(np.cos(1.2 * phase))
        hands.append(landmarks(points + np.float32(250), i))
    return hands


def choose(
    hands: list[HandLandmarks], limit: int, quality: dict[int, FrameQuality] | None = None, fps: float = 30.0
) -> FrameChoice:
    measures = {hand.index: GOOD for hand in hands} | (quality or {})
    return choose_frames(hands, measures, {hand.index: hand.index / fps for hand in hands}, limit)


def test_a_steady_motion_is_covered_evenly() -> None:
    hands = squeezed([i / 99 for i in range(100)])
    choice = choose(hands, 10)
    assert len(choice.frames) == 10
    assert choice.frames == sorted(choice.frames)
    assert 5 <= np.diff(choice.frames).min() <= np.diff(choice.frames).max() <= 20
    assert choice.reason.count("best") == 1


def test_a_burst_of_motion_gets_more_frames_than_rest() -> None:
    hands = squeezed([0.0] * 60 + [i / 19 for i in range(20)] + [1.0] * 60)
    choice = choose(hands, 20)
    moving = [index for index in choice.frames if 60 <= index < 80]
    assert len(moving) >= 6, "20 of 140 frames, but all of the poses"
    assert "pose" in [choice.reason[choice.frames.index(index)] for index in moving]


def test_sharp_frames_go_before_blurred_neighbours_and_ruined_ones_go_out() -> None:
    hands = squeezed([i / 59 for i in range(60)])
    soft = {i: replace(GOOD, sharpness=0.03) for i in range(60) if i % 2}
    ruined = {i: replace(GOOD, sharpness=0.005) for i in range(20, 24)}
    burnt = {30: replace(GOOD, clipped=0.8)}
    gone = {32: replace(GOOD, inside=0.5)}
    choice = choose(hands, 15, soft | ruined | burnt | gone)
    assert sum(index % 2 for index in choice.frames) <= 3
    assert choice.left_out["blurred"] == [20, 21, 22, 23]
    assert choice.left_out["badly_exposed"] == [30]
    assert choice.left_out["cropped"] == [32]
    assert not {20, 21, 22, 23, 30, 32} & set(choice.frames)


def test_a_doubtful_reading_is_no_find_however_odd_its_pose() -> None:
    hands = squeezed([0.3 + 0.002 * i for i in range(60)])
    odd = landmarks(open_hand(250, 250)[::-1].copy(), 30)
    sure, doubtful = ([*hands[:30], replace(odd, score=score), *hands[31:]] for score in (0.95, 0.02))
    assert 30 in choose(sure, 8, fps=1).frames
    assert 30 not in choose(doubtful, 8, fps=1).frames


def test_what_shows_nothing_new_is_left_out_even_below_the_limit() -> None:
    still = squeezed([0.5] * 240)
    choice = choose(still, 1000, fps=240)
    assert 8 <= len(choice.frames) <= 20, "one second of slow motion of a still hand"
    assert len(choice.left_out["alike"]) == 240 - len(choice.frames)
    lively = squeezed([0.2 + i % 8 / 9 for i in range(80)])
    assert len(choose(lively, 1000).frames) == 80


@pytest.mark.parametrize("count", [2, 3, 7])
def test_short_clips_keep_two_frames(count: int) -> None:
    assert len(choose(squeezed([0.5] * count), 2, fps=240).frames) == 2
    awful = {i: replace(GOOD, inside=0.1) for i in range(count)}
    assert len(choose(squeezed([i / count for i in range(count)]), 2, awful).frames) == 2


def test_the_choice_is_the_same_every_time_and_sums_up() -> None:
    rng = np.random.default_rng(1)
    hands = squeezed(list(rng.random(90)))
    quality = {i: replace(GOOD, sharpness=float(s)) for i, s in enumerate(rng.random(90))}
    first, again = choose(hands, 25, quality), choose(hands, 25, quality)
    assert first == again
    summary = first.summary()
    assert summary["candidates"] == 90
    assert len(summary["chosen"]["index"]) == len(summary["chosen"]["reason"]) == 25
    assert sum(part["count"] for part in summary["left_out"].values()) == 65
    assert set(summary["left_out"]) <= {"blurred", "cropped", "badly_exposed", "alike", "over_limit"}


def test_ranges() -> None:
    assert ranges([]) == ""
    assert ranges([3]) == "3"
    assert ranges([1, 2, 3, 7, 9, 10]) == "1-3,7,9-10"
