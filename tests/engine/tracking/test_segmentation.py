"""Masks on a hand painted by the test, and on the rendered clips."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from mass_engine.tracking import capsules
from mass_engine.tracking.models import HandNetworks
from mass_engine.tracking.segmentation import BACKGROUND, HAND, IGNORE, HandSegmenter, hand_box
from mass_engine.tracking.track import track_main_hand
from tests.engine.tracking.clips import frames, landmarks, needs_truth, open_hand, truth_mask

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
@pytest.mark.parametrize(("name", "goal"), [("dev_a", 0.94), ("dev_b", 0.92)])
def test_overlap_on_the_rendered_clips(name: str, goal: float) -> None:
    clip = frames(name)
    track = track_main_hand(clip, HandNetworks.load(), lambda index: index % 8 == 7)
    samples = [(clip[i].rgb, track.hands[i]) for i in track.trusted[:: len(track.trusted) // 16]]
    segmenter = HandSegmenter.train(samples)
    scores, lost = [], []
    for i in list(track.hands)[::3]:
        labels = segmenter(clip[i].rgb, track.hands[i]).full(*clip[i].rgb.shape[:2])
        truth = truth_mask(name, i)
        scores.append(iou(labels, truth))
        lost.append(float((labels[truth] == IGNORE).mean()))
    assert np.mean(scores) >= goal
    assert np.mean(lost) < 0.02, "a mask must not win by ignoring the hand"
