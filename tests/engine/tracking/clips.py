"""The rendered clips with exact ground truth, where they lie beside the checkout."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from mass_engine.hand.pose import Side
from mass_engine.tracking.landmarks import HandLandmarks
from mass_engine.video.reader import Frame, read_frames

SHARED = Path(__file__).resolve().parents[4] / "shared"
TRUTH = SHARED / "truth"

needs_truth = pytest.mark.skipif(not TRUTH.is_dir(), reason="the rendered clips are not beside the checkout")

#: The truth's names for our 21 joints. Definitions differ by some millimetres.
TRUTH_NAMES = (
    "wrist",
    "index-proximal", "index-intermediate", "index-distal",
    "middle-proximal", "middle-intermediate", "middle-distal",
    "pinky-proximal", "pinky-intermediate", "pinky-distal",
    "ring-proximal", "ring-intermediate", "ring-distal",
    "thumb-metacarpal", "thumb-proximal", "thumb-distal",
    "thumb-tip", "index-tip", "middle-tip", "ring-tip", "pinky-tip",
)  # fmt: skip


@lru_cache(maxsize=2)
def frames(name: str) -> tuple[Frame, ...]:
    """All frames of a rendered clip."""
    return tuple(read_frames(TRUTH / name / "video.mp4"))


def truth_points(name: str) -> NDArray[np.float64]:
    """The true joints of a rendered clip in our order, pixels [T,21,2]."""
    with np.load(TRUTH / name / "truth.npz") as truth:
        names = [str(n) for n in truth["joint_names"]]
        joints = truth["joints"][:, [names.index(n) for n in TRUTH_NAMES]]
        camera, K = truth["world_to_camera"], truth["K"]
    seen = np.einsum("tij,tkj->tki", camera[:, :3, :3], joints) + camera[:, None, :3, 3]
    projected = seen @ K.T
    return np.asarray(projected[..., :2] / projected[..., 2:], np.float64)


def _mask(name: str, index: int) -> NDArray[np.uint8]:
    mask = cv2.imread(str(TRUTH / name / "masks" / f"{index:06d}.png"), cv2.IMREAD_GRAYSCALE)
    assert mask is not None
    return np.asarray(mask, np.uint8)


def truth_mask(name: str, index: int) -> NDArray[np.bool_]:
    """The bare hand of one frame, bool [H,W]."""
    return np.asarray(_mask(name, index) == 80)


def worn_mask(name: str, index: int) -> NDArray[np.bool_]:
    """Ring and watch of one frame, bool [H,W]."""
    return np.asarray(_mask(name, index) == 160)


def open_hand(x: float = 160.0, y: float = 200.0, scale: float = 1.0) -> NDArray[np.float32]:
    """21 points of a flat right hand from the back, fingers up, wrist at (x, y), ``scale`` pixels a mm."""
    fingers = {  # direction in degrees from up, then distances from the wrist in mm
        "index": (-14, (88, 128, 150, 170)),
        "middle": (-2, (84, 129, 155, 176)),
        "pinky": (24, (76, 109, 127, 147)),
        "ring": (10, (78, 119, 145, 166)),
        "thumb": (-48, (33, 79, 111, 138)),
    }
    joints, tips = [np.zeros(2)], {}
    for finger, (degrees, distances) in fingers.items():
        turn = np.radians(degrees)
        along = [np.array([np.sin(turn), -np.cos(turn)]) * d for d in distances]
        joints += along[:3]
        tips[finger] = along[3]
    joints += [tips[finger] for finger in ("thumb", "index", "middle", "ring", "pinky")]
    return (np.stack(joints) * scale + (x, y)).astype(np.float32)


def landmarks(
    points: NDArray[np.float32], index: int = 0, track: int = 0, right: float = 0.95
) -> HandLandmarks:
    """``points`` as a reading of the tracker, with plausible depth."""
    world = np.concatenate([(points - points.mean(0)) / 1000, np.zeros((21, 1), np.float32)], 1)
    side: Side = "right" if right >= 0.5 else "left"
    return HandLandmarks(index, side, points, world.astype(np.float32), 0.95, right, track)
