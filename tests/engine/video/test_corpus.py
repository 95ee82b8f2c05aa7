"""Every hostile or odd file ends in its code or in its frames, inside its bounds of memory and time."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.engine.video.bounded import read_bounded
from tests.engine.video.broken import BROKEN, FRAMES
from tests.engine.video.odd import ODD

#: What reading one of these small files may add to a process.
GROWTH = 300 << 20


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_file_has_its_code(tmp_path: Path, name: str) -> None:
    make, code = BROKEN[name]
    path = tmp_path / "clip.mp4"
    make(path)
    outcome = read_bounded(path)
    assert outcome.code == ("" if code == FRAMES else code), outcome.message
    if code == FRAMES:
        assert outcome.times
    else:
        assert outcome.advice.endswith(".")
        assert str(tmp_path) not in outcome.message + outcome.advice
    assert outcome.grown < GROWTH


@pytest.mark.parametrize("name", ODD)
def test_an_odd_file_is_read_or_refused_with_advice(tmp_path: Path, name: str) -> None:
    odd = ODD[name]
    path = tmp_path / odd.name
    odd.make(path)
    outcome = read_bounded(path)
    assert outcome.code == odd.code, outcome.message
    assert outcome.warnings == odd.warnings
    if not odd.code:
        assert outcome.sizes == {odd.size}
        assert (np.diff(outcome.times) > 0).all()
        if odd.frames is not None:
            assert len(outcome.times) == odd.frames
            assert outcome.times[-1] == pytest.approx(odd.last, abs=4e-3)
    assert outcome.grown < GROWTH
