"""FLIP against its authors' implementation."""

from __future__ import annotations

import flip_evaluator
import numpy as np
import pytest
import torch

from mass_engine.evaluation.flip import flip, flip_map
from tests.engine.evaluation.test_metrics import pair


@pytest.mark.parametrize("noise", [0.02, 0.2])
def test_flip_agrees_with_its_authors(noise: float) -> None:
    a, b = pair(96, noise)
    theirs, mean, _ = flip_evaluator.evaluate(
        a.numpy().astype(np.float32), b.numpy().astype(np.float32), "LDR", applyMagma=False
    )
    ours = flip_map(b, a).numpy()
    np.testing.assert_allclose(ours, theirs[..., 0], atol=2e-3)
    assert abs(flip(b, a) - mean) < 3e-4


def test_flip_is_zero_for_equal_pictures_and_sees_more_from_nearby() -> None:
    a, b = pair(64, 0.1)
    assert flip(a, a) == 0.0
    assert 0 < flip(a, b, 67.0) < flip(a, b, 20.0) < 1
    black, white = torch.zeros(16, 16, 3), torch.ones(16, 16, 3)
    assert flip(black, white) > 0.9
