"""The tracker on rendered clips: accuracy, recall, and that held-out frames leave no trace."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from mass_engine.errors import EngineError
from mass_engine.tracking.landmarks import hand_scale
from mass_engine.tracking.models import HandNetworks
from mass_engine.tracking.track import Track, track_main_hand
from mass_engine.tracking.tracker import HandTracker
from mass_engine.video.reader import Frame
from tests.engine.tracking.clips import frames, needs_truth, truth_points


def held(index: int) -> bool:
    return index % 8 == 7


def track(clip: Sequence[Frame]) -> Track:
    return track_main_hand(clip, HandNetworks.load(), held)


@needs_truth
@pytest.mark.parametrize(("name", "found", "error"), [("dev_a", 96, 0.07), ("dev_b", 92, 0.085)])
def test_accuracy_on_the_rendered_clips(name: str, found: int, error: float) -> None:
    result = track(frames(name))
    truth = truth_points(name)
    assert len(result.hands) >= found
    assert result.side == "right"
    assert result.side_confidence > 0.9
    errors = [
        np.linalg.norm(hand.points - truth[i], axis=1).mean() / hand_scale(truth[i])
        for i, hand in result.hands.items()
    ]
    assert np.mean(errors) < error


@needs_truth
def test_a_mirrored_clip_is_a_left_hand_at_the_mirrored_place() -> None:
    clip = frames("dev_a")[:24]
    mirrored = [replace(frame, rgb=np.ascontiguousarray(frame.rgb[:, ::-1])) for frame in clip]
    here, there = track(clip), track(mirrored)
    assert (here.side, there.side) == ("right", "left")
    shifts = [
        (here.hands[i].points[:, 0] - (clip[0].rgb.shape[1] - there.hands[i].points[:, 0])).mean()
        for i in here.hands
    ]
    # Pixel centres at +0.5: an image of width W mirrors x to W - x, without a systematic shift.
    assert abs(float(np.mean(shifts))) < 1.5


@needs_truth
def test_held_out_frames_leave_no_trace() -> None:
    clip = list(frames("dev_b")[:40])
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 256, clip[0].rgb.shape, dtype=np.uint8)
    poisoned = [replace(frame, rgb=noise) if held(frame.index) else frame for frame in clip]
    clean, other = track(clip), track(poisoned)
    kept = [i for i in clean.hands if not held(i)]
    assert kept == [i for i in other.hands if not held(i)]
    for i in kept:
        np.testing.assert_array_equal(clean.hands[i].points, other.hands[i].points)
        assert clean.hands[i].trusted == other.hands[i].trusted
    assert any(held(i) for i in clean.hands)
    assert not any(held(i) for i in other.hands)


@needs_truth
def test_a_hand_that_leaves_is_lost_and_found_again() -> None:
    clip = list(frames("dev_a")[:40])
    empty = np.full_like(clip[0].rgb, 190)
    empty[:, ::7] = 170
    gone = range(15, 30)
    result = track([replace(frame, rgb=empty) if frame.index in gone else frame for frame in clip])
    assert not set(result.hands) & set(gone)
    assert set(result.hands) >= set(range(15)) | set(range(31, 40))
    assert len({hand.track for hand in result.hands.values() if hand.track >= 0}) == 2


@needs_truth
def test_two_hands_are_kept_apart() -> None:
    tracker = HandTracker(HandNetworks.load())
    for frame in frames("dev_a")[:14]:
        pair = np.concatenate([frame.rgb, frame.rgb[:, ::-1]], axis=1)
        hands = tracker(pair, frame.index)
    assert len(hands) == 2
    assert {hand.side for hand in hands} == {"left", "right"}
    assert {hand.points[:, 0].mean() > 640 for hand in hands} == {False, True}


@needs_truth
def test_the_larger_of_two_hands_is_the_main_one() -> None:
    small = [
        np.pad(frame.rgb[::2, ::2], ((120, 120), (0, 0), (0, 0)), mode="edge") for frame in frames("dev_a")
    ]
    pairs = [
        replace(frame, rgb=np.concatenate([other, frame.rgb[:, ::-1]], axis=1))
        for frame, other in zip(frames("dev_a")[:30], small, strict=False)
    ]
    result = track(pairs)
    assert result.side == "left"
    assert all(hand.points[:, 0].mean() > 320 for hand in result.hands.values())
    assert result.other_hands > 5


def test_no_hand_at_all_is_a_clear_error() -> None:
    rng = np.random.default_rng(3)
    wall = rng.normal(128, 20, (240, 320, 3)).clip(0, 255).astype(np.uint8)
    with pytest.raises(EngineError, match=r"found in 0 of 9 frames") as caught:
        track([Frame(i, i / 30, np.roll(wall, 5 * i, axis=1)) for i in range(10)])
    assert caught.value.code == "video.no_hand"
