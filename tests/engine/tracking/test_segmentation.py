"""Masks on a hand painted by the test, and on the rendered clips."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from mass_engine.tracking import capsules
from mass_engine.tracking.matting import refine_seam
from mass_engine.tracking.models import HandNetworks
from mass_engine.tracking.segmentation import BACKGROUND, HAND, IGNORE, HandSegmenter, hand_box
from mass_engine.tracking.track import track_main_hand
from tests.engine.tracking.clips import frames, landmarks, needs_truth, open_hand, truth_mask, worn_mask

SKIN, DARK_SKIN, CLOTH = (205, 150, 125), (95, 65, 52), (60, 70, 130)


def painted(
    points: NDArray[np.float32],
    skin: tuple[int, int, int],
    forearm: tuple[int, int, int] | None = None,
    cuff: float = 0.0,
    seed: int = 0,
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """A noisy hand over clutter, uint8 [360,320,3], and its true visible mask.

    The true hand is not the segmenter's rough one: fatter, with bulges. ``forearm`` paints an arm of that
    colour from ``cuff`` mm above the wrist to the lower edge.
    """
    rng = np.random.default_rng(seed)
    height, width = 360, 320
    coarse = rng.integers(90, 220, (9, 8, 3)).astype(np.float32)
    image = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
    for _ in range(6):
        x, y = (int(v) for v in rng.integers(0, 280, 2))
        colour = tuple(int(v) for v in rng.integers(60, 200, 3))
        cv2.rectangle(image, (x, y), (x + 50, y + 35), colour, -1)
    scale = capsules.pixels_per_mm(points)
    rough = capsules.draw(points, scale, height, width).distance
    bulge = cv2.resize(
        rng.normal(0, 1.5, (24, 21)).astype(np.float32), (width, height), interpolation=cv2.INTER_CUBIC
    )
    hand = rough < 1.0 + np.asarray(bulge)
    shade = 1 + 0.1 * np.sin(np.arange(width) / 25)[None, :, None]
    image = np.where(hand[..., None], np.array(skin) * shade, image)
    if forearm is not None:
        wrist = points[0]
        y, x = np.mgrid[0:height, 0:width]
        arm = (y > wrist[1] - cuff * scale) & (np.abs(x - wrist[0]) < 30 * scale)
        image = np.where(arm[..., None], np.array(forearm) * shade, image)
        hand = hand & ~arm
    noisy = image + rng.normal(0, 5, image.shape)
    return noisy.clip(0, 255).astype(np.uint8), np.asarray(hand)


def shaken(points: NDArray[np.float32], seed: int) -> NDArray[np.float32]:
    """Landmarks as a tracker gives them: two pixels off."""
    return (points + np.random.default_rng(seed).normal(0, 2, points.shape)).astype(np.float32)


def iou(labels: NDArray[np.uint8], truth: NDArray[np.bool_]) -> float:
    """Intersection over union where the label is not IGNORE."""
    judged = labels != IGNORE
    hand = (labels == HAND) & judged
    return float((hand & truth).sum() / ((hand | truth) & judged).sum())


def edge_offset(
    coverage: NDArray[np.float32], truth: NDArray[np.bool_], unjudged: NDArray[np.bool_]
) -> float:
    """How far the edge lies outside the true one, pixels, where both are within 4 pixels of it."""
    within = cv2.distanceTransform(truth.astype(np.uint8), cv2.DIST_L2, 5)
    without = cv2.distanceTransform((~truth).astype(np.uint8), cv2.DIST_L2, 5)
    band = (np.maximum(within, without) < 4) & (
        cv2.dilate(unjudged.astype(np.uint8), np.ones((9, 9), np.uint8)) == 0
    )
    return float((coverage - truth)[band].sum() * 8 / max(1, band.sum()))


def poses() -> list[NDArray[np.float32]]:
    return [open_hand(130 + 12 * i, 265 - 6 * i, 1.0 + 0.04 * i) for i in range(6)]


@pytest.mark.parametrize("skin", [SKIN, DARK_SKIN])
def test_a_painted_hand_is_found_to_its_outline(skin: tuple[int, int, int]) -> None:
    scenes = [(*painted(points, skin, seed=i), points) for i, points in enumerate(poses())]
    samples = [(image, landmarks(shaken(points, i))) for i, (image, _, points) in enumerate(scenes)]
    segmenter = HandSegmenter.train(samples[:4])
    for (image, truth, points), (_, tracked) in zip(scenes, samples, strict=True):
        labels = segmenter(image, tracked).full(*image.shape[:2])
        assert set(np.unique(labels)) <= {BACKGROUND, IGNORE, HAND}
        # The wrist has no edge of its own in this scene, so it is judged above the wrist.
        above = np.arange(labels.shape[0])[:, None] < points[0, 1]
        assert iou(labels, truth & above) > 0.9
        rough = (
            capsules.draw(tracked.points, capsules.pixels_per_mm(tracked.points), *labels.shape).distance < 0
        )
        assert iou(labels, truth & above) > iou(
            np.where(rough & above, HAND, 0).astype(np.uint8), truth & above
        )


def test_a_bare_forearm_is_ignored_not_background() -> None:
    scenes = [(*painted(points, SKIN, SKIN, cuff=0.0, seed=i), points) for i, points in enumerate(poses())]
    segmenter = HandSegmenter.train([(image, landmarks(points)) for image, _, points in scenes])
    image, truth, points = scenes[2]
    labels = segmenter(image, landmarks(points)).full(*image.shape[:2])
    x, y = (int(v) for v in points[0])
    assert (labels[y + 28 : y + 40, x - 15 : x + 15] == IGNORE).all()
    assert (labels == HAND)[truth].mean() > 0.93, "the palm must not be taken for forearm"


def test_a_sleeve_over_the_wrist_is_not_hand() -> None:
    scenes = [(*painted(points, SKIN, CLOTH, cuff=25.0, seed=i), points) for i, points in enumerate(poses())]
    segmenter = HandSegmenter.train([(image, landmarks(points)) for image, _, points in scenes])
    for image, truth, points in scenes:
        labels = segmenter(image, landmarks(points)).full(*image.shape[:2])
        x, y = (int(v) for v in points[0])
        assert (labels[y - 18 : y + 20, x - 15 : x + 15] == IGNORE).mean() > 0.95
        assert iou(labels, truth) > 0.9


def test_a_hand_at_the_border_and_one_outside_it() -> None:
    image, _ = painted(open_hand(160, 260), SKIN)
    segmenter = HandSegmenter.train([(image, landmarks(open_hand(160, 260)))])
    for x, y in ((5, 200), (315, 100), (160, 700), (-900, -900)):
        points = open_hand(x, y)
        left, top, width, height = hand_box(points, *image.shape[:2])
        assert left >= 0
        assert top >= 0
        assert left + width <= image.shape[1]
        assert top + height <= image.shape[0]
        mask = segmenter(image, landmarks(points))
        assert mask.labels.shape == (height, width)
        assert mask.full(*image.shape[:2]).shape == image.shape[:2]


def test_training_needs_a_sample() -> None:
    with pytest.raises(ValueError, match="at least one"):
        HandSegmenter.train([])


def test_the_same_input_gives_the_same_mask() -> None:
    image, _ = painted(open_hand(160, 260), SKIN)
    tracked = landmarks(open_hand(160, 260))
    first, second = (HandSegmenter.train([(image, tracked)])(image, tracked).labels for _ in range(2))
    np.testing.assert_array_equal(first, second)


@needs_truth
@pytest.mark.parametrize(("name", "goal"), [("dev_a", 0.975), ("dev_b", 0.955)])
def test_overlap_on_the_rendered_clips(name: str, goal: float) -> None:
    clip = frames(name)
    track = track_main_hand(clip, HandNetworks.load(), lambda index: index % 8 == 7)
    read = {i: replace(hand, points=hand.as_read) for i, hand in track.hands.items() if hand.trusted}
    samples = [(clip[i].rgb, read[i]) for i in track.trusted[:: len(track.trusted) // 16]]
    segmenter = HandSegmenter.train(samples)
    scores, lost, offsets, painted_over = [], [], [], []
    for i in list(read)[::3]:
        mask = segmenter(clip[i].rgb, read[i])
        labels = mask.full(*clip[i].rgb.shape[:2])
        truth, worn = truth_mask(name, i), worn_mask(name, i)
        scores.append(iou(np.where(worn, IGNORE, labels).astype(np.uint8), truth))
        lost.append(float((labels[truth] == IGNORE).mean()))
        painted_over.append((float((labels[worn] == HAND).sum()), float(worn.sum())))
        offsets.append(edge_offset(mask.full_coverage(*labels.shape), truth, (labels == IGNORE) | worn))
    assert np.mean(scores) >= goal
    assert np.mean(lost) < 0.02, "a mask must not win by ignoring the hand"
    assert abs(np.mean(offsets)) < 0.3, "the hand must be neither too fat nor too thin"
    hidden, total = np.sum(painted_over, axis=0)
    assert hidden <= 0.1 * total, "a ring or a watch is no hand"


def test_coverage_is_soft_at_the_edge_and_agrees_with_the_labels() -> None:
    scenes = [(*painted(points, SKIN, seed=i), points) for i, points in enumerate(poses())]
    segmenter = HandSegmenter.train([(image, landmarks(points)) for image, _, points in scenes])
    for image, _, points in scenes:
        sharp = segmenter(image, landmarks(points))
        image = cv2.GaussianBlur(image, (0, 0), 1.0).astype(np.uint8)
        mask = segmenter(image, landmarks(points))
        assert mask.coverage.dtype == np.float32
        assert mask.coverage.min() >= 0
        assert mask.coverage.max() <= 1
        np.testing.assert_array_equal(mask.coverage > 0.5, mask.labels == HAND)
        assert (mask.coverage[mask.labels == IGNORE] == 0).all()
        soft = (mask.coverage > 0.02) & (mask.coverage < 0.98)
        hard = (sharp.coverage > 0.02) & (sharp.coverage < 0.98)
        assert soft.sum() > hard.sum() > 0


def test_a_thing_over_the_hand_is_ignored_and_the_hand_around_it_is_not() -> None:
    scenes = [(*painted(points, SKIN, seed=i), points) for i, points in enumerate(poses())]
    held = []
    for image, truth, points in scenes:  # a green stick across the palm, longer than the hand is wide
        thing = np.zeros(truth.shape, np.uint8)
        x, y = (int(v) for v in points[[0, 4]].mean(0))
        cv2.rectangle(thing, (x - 60, y - 12), (x + 60, y + 12), 1, -1)
        noise = np.random.default_rng(1).normal(0, 4, image.shape)
        green = (np.array((40, 150, 60)) + noise).clip(0, 255).astype(np.uint8)
        held.append((np.where(thing[..., None] > 0, green, image).astype(np.uint8), truth, thing > 0, points))
    segmenter = HandSegmenter.train([(image, landmarks(points)) for image, _, _, points in held])
    for image, truth, hides, points in held:
        labels = segmenter(image, landmarks(points)).full(*image.shape[:2])
        assert (labels[hides] == HAND).mean() < 0.03
        hiding = cv2.erode((hides & truth).astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
        assert (labels[hiding] == IGNORE).mean() > 0.8
        above = np.arange(labels.shape[0])[:, None] < points[0, 1]
        clear = above & (cv2.dilate(hides.astype(np.uint8), np.ones((5, 5), np.uint8)) == 0)
        assert iou(np.where(clear, labels, IGNORE).astype(np.uint8), truth) > 0.9
        assert (labels[truth & clear] == IGNORE).mean() < 0.03


def test_next_to_a_sleeve_what_has_its_colour_is_not_hand() -> None:
    image = np.full((60, 80, 3), CLOTH, np.uint8)
    image[:30] = SKIN
    image[30] = (np.array(SKIN) + np.array(CLOTH)) // 2  # a pixel of both
    hand = np.zeros((60, 80), bool)
    hand[:33] = True  # three rows too far
    seam = refine_seam(image, hand, ~hand, 1.0)
    assert (seam[30:33, 5:-5]).all()
    assert not seam[:30].any()
    bare = np.full((60, 80, 3), SKIN, np.uint8)
    assert not refine_seam(bare, hand, ~hand, 1.0).any(), "a bare forearm has the hand's colour"
