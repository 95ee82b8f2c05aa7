"""What the fit reads from masks."""

from __future__ import annotations

import numpy as np
import torch

from mass_engine.camera import Camera
from mass_engine.fitting.views import View
from mass_engine.tracking.segmentation import BACKGROUND, HAND, IGNORE


def view(soft: bool) -> View:
    """A hand over the left half of 16x8 pixels with a soft last column, ignored rows below."""
    coverage = np.zeros((8, 16), np.float32)
    coverage[:, :8], coverage[:, 8] = 1.0, 0.6
    coverage[6:] = 0.0
    labels = np.where(coverage > 0.5, HAND, BACKGROUND).astype(np.uint8)
    labels[6:] = IGNORE
    camera = Camera.from_fov(16, 8, 60.0)
    rgb, points = np.zeros((8, 16, 3), np.uint8), np.zeros((21, 2), np.float32)
    return View(0, 0.0, False, rgb, labels, camera, points, 1.0, coverage=coverage if soft else None)


def test_the_hand_is_as_soft_as_its_coverage() -> None:
    level = view(soft=True).level(16)
    assert level.hand[0, 8] == torch.tensor(0.6)
    assert (level.valid[:6] == 1).all()
    assert (level.valid[6:] == 0).all()
    half = view(soft=True).level(8)
    torch.testing.assert_close(half.hand[0, 4], torch.tensor(0.3), atol=1 / 255, rtol=0)  # kept as a byte


def test_without_coverage_the_labels_count() -> None:
    level = view(soft=False).level(16)
    assert set(level.hand.unique().tolist()) == {0.0, 1.0}
    assert level.hand[0, 8] == 1
