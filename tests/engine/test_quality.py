"""The gate before the fit: each finding is tripped by a clip made bad, none by a good one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from mass_engine.errors import EngineError
from mass_engine.options import FitOptions
from mass_engine.preprocess import prepare
from mass_engine.progress import ProgressMeter
from mass_engine.quality import (
    Finding,
    FrameQuality,
    QualityMeter,
    check_clip,
    measure,
    pose_distances,
    pose_shapes,
)
from mass_engine.tracking.landmarks import HandLandmarks
from mass_engine.tracking.models import HandNetworks
from mass_engine.tracking.track import TrackBuilder
from mass_engine.video.reader import Frame, read_frames
from mass_engine.video.writer import write_video
from tests.engine.tracking.clips import SHARED, landmarks, open_hand

Image = NDArray[np.uint8]
GOOD = FrameQuality(sharpness=0.1, light=120.0, clipped=0.0, inside=1.0)


def turning_hand(count: int = 30, scale: float = 1.0) -> list[HandLandmarks]:
    """A hand that is squeezed and stretched, as one that turns about its long axis looks."""
    hands = []
    for i in range(count):
        points = open_hand(0, 0, scale)
        points[:, 0] *= np.float32(np.cos(1.2 * i / count))
        hands.append(landmarks(points + np.float32(250), i))
    return hands


def codes(hands: list[HandLandmarks], quality: FrameQuality = GOOD, others: int = 0) -> dict[str, bool]:
    found = check_clip(hands, {hand.index: quality for hand in hands}, others)
    assert all(finding.advice.endswith(".") and finding.message.endswith(".") for finding in found)
    return {finding.code: finding.fatal for finding in found}


def test_a_good_clip_passes() -> None:
    assert codes(turning_hand()) == {}


@pytest.mark.parametrize(
    ("quality", "code", "fatal"),
    [
        (replace(GOOD, light=30.0), "video.too_dark", False),
        (replace(GOOD, light=8.0), "video.too_dark", True),
        (replace(GOOD, sharpness=0.01), "video.too_blurred", False),
        (replace(GOOD, inside=0.9), "video.hand_cropped", False),
        (replace(GOOD, inside=0.6), "video.hand_cropped", True),
    ],
)
def test_each_measure_has_its_code(quality: FrameQuality, code: str, fatal: bool) -> None:
    assert codes(turning_hand(), quality) == {code: fatal}


def test_size_motion_and_people() -> None:
    assert codes(turning_hand(scale=0.4)) == {"video.hand_too_small": False}
    still = [replace(hand, index=i) for i, hand in enumerate([turning_hand()[3]] * 30)]
    assert codes(still) == {"video.too_little_motion": False}
    assert codes(turning_hand(), others=15) == {"video.several_people": False}
    assert codes(turning_hand(), others=9) == {}


def test_a_turn_in_the_picture_a_shift_and_a_zoom_are_no_motion() -> None:
    hands = []
    for i in range(20):
        turn = 0.15 * i
        matrix = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        points = open_hand(0, 0, 1 + 0.03 * i) @ matrix.T + 300 + 5 * i
        hands.append(landmarks(points.astype(np.float32), i))
    shapes = pose_shapes(hands)
    np.testing.assert_allclose(pose_distances(shapes, shapes[0]), 0, atol=1e-3)
    assert "video.too_little_motion" in codes(hands)


def test_sharpness_falls_with_blur_and_not_with_light_or_size() -> None:
    rng = np.random.default_rng(0)
    noise = rng.normal(0, 1, (400, 400, 3)).astype(np.float32)
    coarse, fine = (cv2.GaussianBlur(noise, (0, 0), s) * gain for s, gain in ((40, 5000), (3, 150)))
    image = np.clip(128 + coarse + fine, 0, 255).astype(np.uint8)
    points = open_hand(200, 350, 1.6)
    sharp = measure(image, points)
    soft = measure(np.asarray(cv2.GaussianBlur(image, (0, 0), 8), np.uint8), points)
    assert soft.sharpness < 0.4 * sharp.sharpness
    dim = measure((image * 0.5).astype(np.uint8), points)
    assert dim.sharpness == pytest.approx(sharp.sharpness, rel=0.2)
    assert dim.light == pytest.approx(sharp.light / 2, rel=0.03)
    twice = np.asarray(cv2.resize(image, (800, 800), interpolation=cv2.INTER_CUBIC), np.uint8)
    assert measure(twice, 2 * points).sharpness == pytest.approx(sharp.sharpness, rel=0.25)
    assert measure(np.full_like(image, 255), points).clipped == 1.0
    assert measure(image, points + np.float32(200)).inside < 0.6
    measure(image, points + np.float32(5000))  # wholly outside: nothing to measure, nothing to fail


@lru_cache(maxsize=1)
def images_of(clip: Path) -> tuple[Image, ...]:
    return tuple(frame.rgb for frame in read_frames(clip))


def findings(images: list[Image]) -> dict[str, Finding]:
    """Track ``images`` and put them through the gate."""
    builder, seen = TrackBuilder(HandNetworks.load()), QualityMeter()
    for i, image in enumerate(images):
        frame = Frame(i, i / 16, np.ascontiguousarray(image))
        seen.add(frame, builder.add(frame))
    track = builder.finish()
    hands = [hand for hand in track.hands.values() if hand.trusted]
    return {finding.code: finding for finding in check_clip(hands, seen.of(hands), track.same_side)}


def _blurred(image: Image) -> Image:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), 4), np.uint8)


def _darkened(image: Image) -> Image:
    return (image * 0.15).astype(np.uint8)


def _shrunk(image: Image) -> Image:
    small = cv2.resize(image, None, fx=0.35, fy=0.35, interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.copyMakeBorder(small, 90, 90, 90, 90, cv2.BORDER_REPLICATE), np.uint8)


def _cropped(image: Image) -> Image:
    return image[:, :250]  # at 230 the hand is lost in half of the frames, which half hangs on the encoder


def _beside_another(image: Image) -> Image:
    return np.concatenate([image, image], 1)


@pytest.mark.parametrize(
    ("change", "code"),
    [
        (_blurred, "video.too_blurred"),
        (_darkened, "video.too_dark"),
        (_shrunk, "video.hand_too_small"),
        (_cropped, "video.hand_cropped"),
        (_beside_another, "video.several_people"),
    ],
)
def test_a_spoilt_clip_is_found_out(demo_clip: Path, change: Callable[[Image], Image], code: str) -> None:
    found = findings([change(image) for image in images_of(demo_clip)])
    assert list(found) == [code]
    assert not found[code].fatal


def test_a_still_hand_is_found_out(demo_clip: Path) -> None:
    assert list(findings([images_of(demo_clip)[0]] * 20)) == ["video.too_little_motion"]


def test_the_clip_itself_passes(demo_clip: Path) -> None:
    assert findings(list(images_of(demo_clip))) == {}


@pytest.mark.skipif(not SHARED.is_dir(), reason="the development clips are not beside the checkout")
@pytest.mark.parametrize(
    "name",
    ["clips/finger-counting.mp4", "clips/raised-hand.mp4", "truth/dev_a/video.mp4", "truth/dev_b/video.mp4"],
)
def test_good_clips_pass(name: str) -> None:
    step = 4 if name.startswith("clips") else 1
    images = [frame.rgb for frame in read_frames(SHARED / name) if frame.index % step == 0]
    assert findings(images) == {}


@pytest.mark.parametrize(
    ("light", "code"), [(0.0, "video.too_dark"), (1.0, "video.no_hand")], ids=["night", "day"]
)
def test_nothing_to_fit_is_refused_before_any_fit(tmp_path: Path, light: float, code: str) -> None:
    rng = np.random.default_rng(0)
    empty = cv2.GaussianBlur(rng.integers(80, 180, (240, 320, 3)).astype(np.uint8), (0, 0), 9)
    write_video(tmp_path / "clip.mp4", [(empty * light).astype(np.uint8)] * 6, 30)
    stages: list[str] = []
    with pytest.raises(EngineError) as caught:
        prepare(
            tmp_path / "clip.mp4",
            FitOptions(),
            ProgressMeter(lambda step: stages.append(step.stage)),
            lambda *_: None,
        )
    assert caught.value.code == code
    assert set(stages) <= {"read", "track"}
