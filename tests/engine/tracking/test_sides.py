"""Keeping the right and the left hand of a person apart, on readings made by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mass_engine.errors import EngineError
from mass_engine.hand.pose import Side
from mass_engine.tracking.contact import mixed_frames
from mass_engine.tracking.landmarks import HandLandmarks
from mass_engine.tracking.models import HandNetworks
from mass_engine.tracking.sides import label_sides
from mass_engine.tracking.track import TrackBuilder, both_hands
from mass_engine.tracking.tracker import TrackerOptions
from tests.engine.tracking.clips import frames, landmarks, needs_truth, open_hand, truth_mask, truth_points

COUNT = 60


def two_hands(
    right_x: list[float], left_x: list[float], wrong: float = 0.0
) -> tuple[dict[int, list[HandLandmarks]], dict[int, dict[Side, int]]]:
    """Hands at these places, and which track has which side; a share ``wrong`` of readings is wrong."""
    rng = np.random.default_rng(0)
    found: dict[int, list[HandLandmarks]] = {}
    for i, (a, b) in enumerate(zip(right_x, left_x, strict=True)):
        votes = [abs(float(rng.random() < wrong) - p) for p in (0.95, 0.05)]
        found[i] = [landmarks(open_hand(x, 250), i, k, votes[k]) for k, x in enumerate((a, b))]
    return found, {i: {"right": 0, "left": 1} for i in found}


def tracks_of(found: dict[int, list[HandLandmarks]]) -> dict[int, dict[Side, int]]:
    return {i: {side: hand.track for side, hand in pair.items()} for i, pair in label_sides(found).items()}


def test_hands_apart_keep_their_sides_whatever_a_third_of_the_readings_say() -> None:
    found, expected = two_hands([100.0] * COUNT, [450.0] * COUNT, wrong=0.33)
    assert tracks_of(found) == expected


def test_hands_that_cross_do_not_change_sides() -> None:
    right = [100 + 6.0 * i for i in range(COUNT)]
    found, expected = two_hands(right, right[::-1], wrong=0.2)
    assert tracks_of(found) == expected


def test_tracks_that_take_over_each_others_hand_are_put_right() -> None:
    right = [100 + 6.0 * i for i in range(COUNT)]
    found, _ = two_hands(right, right[::-1], wrong=0.2)
    for i in range(31, COUNT):  # they meet at 29 and 30
        a, b = found[i]
        found[i] = [replace(b, track=0), replace(a, track=1)]
    labelled = tracks_of(found)
    assert all(labelled[i] == {"right": 0, "left": 1} for i in range(24))
    assert all(labelled[i] == {"right": 1, "left": 0} for i in range(36, COUNT))


def test_a_hand_that_is_lost_and_found_is_the_one_that_was_missing() -> None:
    found, _ = two_hands([100.0] * COUNT, [450.0] * COUNT)
    for i in range(20, 30):
        found[i] = found[i][:1]
    for i in range(30, COUNT):  # and read as a right hand, all the time
        found[i] = [found[i][0], replace(found[i][1], track=2, right=0.7)]
    labelled = tracks_of(found)
    assert all(labelled[i] == {"right": 0} for i in range(20, 30))
    assert all(labelled[i] == {"right": 0, "left": 2} for i in range(30, COUNT))


def test_one_hand_read_wrongly_after_a_gap_stays_one_hand() -> None:
    found = {i: [landmarks(open_hand(), i, 0, 0.95)] for i in range(40)}
    found |= {i: [landmarks(open_hand(), i, 1, 0.1)] for i in range(42, 52)}
    assert all(set(pair) == {"right"} for pair in label_sides(found).values())


def test_both_hands_are_marked_and_held_out_frames_follow_them() -> None:
    found, _ = two_hands([100.0] * COUNT, [450.0] * COUNT, wrong=0.2)
    held = set(range(7, COUNT, 8))
    found[15] = [replace(found[15][0], track=-1), replace(found[15][1], track=-1)]
    result = both_hands(found, [i / 30 for i in range(COUNT)], held, 640, 480)
    assert set(result) == {"right", "left"}
    for side, x in (("right", 100.0), ("left", 450.0)):
        track = result[side]  # type: ignore[index]
        assert len(track.hands) == COUNT
        assert {hand.side for hand in track.hands.values()} == {side}
        assert all(abs(hand.points[0, 0] - x) < 1 for hand in track.hands.values())
        assert track.trusted == [i for i in range(COUNT) if i not in held]


def test_a_hand_that_is_not_there_is_left_out_and_none_at_all_is_refused() -> None:
    found = {i: [landmarks(open_hand(), i, 0, 0.95)] for i in range(COUNT)}
    assert set(both_hands(found, [i / 30 for i in range(COUNT)], (), 640, 480)) == {"right"}
    with pytest.raises(EngineError) as caught:
        both_hands({}, [i / 30 for i in range(COUNT)], (), 640, 480)
    assert caught.value.code == "video.no_hand"


@needs_truth
def test_real_looking_hands_that_cross_keep_their_sides() -> None:
    """A rendered right hand passes over its mirror image, which is hidden for a second."""
    clip, right = frames("dev_a"), truth_points("dev_a")
    width = clip[0].rgb.shape[1]
    builder = TrackBuilder(HandNetworks.load(), TrackerOptions(look_every=4))
    shifts = [int(420 - 840 * i / (len(clip) - 1)) for i in range(len(clip))]
    for frame, shift in zip(clip, shifts, strict=True):
        picture = np.full((frame.rgb.shape[0], 2 * width, 3), 150, np.uint8)
        picture[:, width // 2 : width // 2 + width] = frame.rgb[:, ::-1]
        rows, columns = np.nonzero(truth_mask("dev_a", frame.index))
        moved = columns + width // 2 + shift
        seen = (moved >= 0) & (moved < 2 * width)
        picture[rows[seen], moved[seen]] = frame.rgb[rows[seen], columns[seen]]
        builder.add(replace(frame, rgb=picture))
    tracks = builder.finish_both()
    assert set(tracks) == {"right", "left"}
    for side, other in (("right", "left"), ("left", "right")):
        hands, others = tracks[side], tracks[other].hands  # type: ignore[index]
        sure = set(hands.trusted) - mixed_frames(hands.hands, others)
        assert len(sure) > 30
        for i in sure:
            places = {
                "right": right[i] + [width / 2 + shifts[i], 0],
                "left": right[i] * [-1, 1] + [1.5 * width, 0],
            }
            off = {
                name: np.linalg.norm(hands.hands[i].points - p, axis=1).mean() for name, p in places.items()
            }
            assert off[side] < off[other], i
