"""The arithmetic around the networks, on values made by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mass_engine.hand.pose import JOINT_NAMES
from mass_engine.tracking.landmarks import BONES, NETWORK_ORDER, region_of
from mass_engine.tracking.palm import Palm, anchors, decode, merge, overlap
from mass_engine.tracking.region import Region, upward_angle, wrap_angle
from tests.engine.tracking.clips import open_hand


def test_anchors_are_the_cell_centres_of_both_grids() -> None:
    centres = anchors()
    assert centres.shape == (2016, 2)
    np.testing.assert_allclose(centres[:2], [[0.5 / 24, 0.5 / 24]] * 2)
    np.testing.assert_allclose(centres[2], [1.5 / 24, 0.5 / 24])
    np.testing.assert_allclose(centres[24 * 24 * 2], [0.5 / 12, 0.5 / 12])
    np.testing.assert_allclose(centres[-1], [11.5 / 12, 11.5 / 12])


def test_decoding_one_anchor() -> None:
    raw, logits = np.zeros((2016, 18), np.float32), np.full((2016, 1), -50, np.float32)
    logits[100] = 0.0
    raw[100, :4] = 19.2, -9.6, 38.4, 57.6
    raw[100, 4:6] = 0.0, 19.2
    scores, points = decode(raw, logits, anchors(), 192, 0.3)
    np.testing.assert_allclose(scores, [0.5])
    x, y = anchors()[100]
    expected = [[x, y - 0.2], [x + 0.2, y + 0.1], [x, y + 0.1]]  # two corners, first keypoint
    np.testing.assert_allclose(points[0, :3], expected, atol=1e-6)


def test_overlap_of_boxes() -> None:
    box = np.array([0, 0, 2, 2], np.float32)
    others = np.array([[0, 0, 2, 2], [1, 1, 3, 3], [5, 5, 6, 6], [0, 0, 2, 1]], np.float32)
    np.testing.assert_allclose(overlap(box, others), [1, 1 / 7, 0, 0.5], atol=1e-6)


def test_merging_averages_what_overlaps_and_keeps_what_does_not() -> None:
    def at(x: float) -> np.ndarray:
        return np.array([[x, 0], [x + 1, 1], *[[x + 0.5, 0.5]] * 7], np.float32)

    palms = merge(np.array([0.3, 0.9, 0.5], np.float32), np.stack([at(0.3), at(0.0), at(5.0)]))
    assert [palm.score for palm in palms] == pytest.approx([0.9, 0.5])
    np.testing.assert_allclose(palms[0].box, [0.075, 0, 1.075, 1], atol=1e-6)
    assert merge(np.zeros(0, np.float32), np.zeros((0, 9, 2), np.float32)) == []


def test_the_region_of_an_upright_palm_reaches_up_over_the_fingers() -> None:
    keypoints = np.array([[50, 100], [0, 0], [50, 60], [0, 0], [0, 0], [0, 0], [0, 0]], np.float32)
    region = Palm(1.0, np.array([30, 60, 70, 100], np.float32), keypoints).region()
    assert region.angle == pytest.approx(0.0)
    assert (region.x, region.y, region.size) == pytest.approx((50, 60, 104))


@pytest.mark.parametrize(
    ("direction", "angle"), [((0, -1), 0), ((1, 0), math.pi / 2), ((-1, 0), -math.pi / 2), ((0, 1), -math.pi)]
)
def test_angles_are_clockwise_from_up(direction: tuple[int, int], angle: float) -> None:
    assert upward_angle(np.zeros(2), np.array(direction, float)) == pytest.approx(angle)


def test_a_crop_shows_the_region_turned_upright() -> None:
    image = np.zeros((100, 100, 3), np.uint8)
    image[45:55, 65:75] = 255  # to the right of the centre
    crop = Region(50.0, 50.0, 60.0, math.pi / 2).crop(image, 120)
    y, x = (float(v.mean()) for v in np.nonzero(crop[..., 0] > 128))
    # What lies 19.5 pixels to the right is now above; the crop is twice as fine.
    assert (x, y) == pytest.approx((60 - 2 * 0.5, 60 - 2 * 19.5), abs=0.6)


@settings(max_examples=50, deadline=None)
@given(angle=st.floats(-3.0, 3.0), scale=st.floats(0.2, 4.0), x=st.floats(-500, 500), y=st.floats(-500, 500))
def test_the_region_follows_the_hand(angle: float, scale: float, x: float, y: float) -> None:
    """Turning, scaling and moving the landmarks turns, scales and moves the region alike."""
    points = open_hand().astype(np.float64)
    base = region_of(points)
    cos, sin = math.cos(angle), math.sin(angle)
    moved = points @ (scale * np.array([[cos, sin], [-sin, cos]])) + (x, y)
    region = region_of(moved)
    assert wrap_angle(region.angle - base.angle - angle) == pytest.approx(0.0, abs=1e-6)
    assert region.size == pytest.approx(base.size * scale, rel=1e-6)
    centre = scale * np.array([cos * base.x - sin * base.y, sin * base.x + cos * base.y]) + (x, y)
    np.testing.assert_allclose([region.x, region.y], centre, atol=1e-6 * (1 + scale * base.size))


def test_the_region_holds_the_whole_hand() -> None:
    points = open_hand()
    region = region_of(points)
    matrix = np.vstack([region.to_image(1), [0, 0, 1]])
    inside = (np.linalg.inv(matrix) @ np.column_stack([points, np.ones(21)]).T)[:2]
    assert inside.min() > 0.05
    assert inside.max() < 0.95


def test_the_networks_order_becomes_ours() -> None:
    fingers = ("thumb", "index", "middle", "ring", "pinky")
    network = ["wrist"] + [f"{f}{j}" for f in fingers for j in (1, 2, 3, "_tip")]
    assert tuple(network[i] for i in NETWORK_ORDER) == JOINT_NAMES


def test_bones_form_one_tree() -> None:
    assert sorted(child for _, child in BONES) == list(range(1, 21))
    for parent, child in BONES:
        if parent:
            assert JOINT_NAMES[parent].rstrip("123") == JOINT_NAMES[child].split("_")[0].rstrip("123")
