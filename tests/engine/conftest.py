"""One short clip of our own hand and one draft fit of it, shared by the tests that need a real result."""

from __future__ import annotations

from pathlib import Path

import pytest

from mass_engine.evaluation.demo_clip import ClipOptions, demo_frames
from mass_engine.options import FitOptions
from mass_engine.pipeline import fit_to_directory
from mass_engine.video.writer import write_video
from tests.engine.video.odd import tag


@pytest.fixture(scope="session")
def demo_clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two seconds of the built-in hand, 480x360, 16 frames a second, with a phone's personal tags."""
    path = tmp_path_factory.mktemp("clip") / "hand.mp4"
    options = ClipOptions(width=480, height=360, fps=16, seconds=2.0)
    write_video(path.with_name("plain.mp4"), demo_frames(options), options.fps)
    tag(path.with_name("plain.mp4"), path)
    return path


@pytest.fixture(scope="session")
def draft_run(demo_clip: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The RUN directory of a draft fit that held out every fourth frame."""
    out = tmp_path_factory.mktemp("run")
    fit_to_directory(demo_clip, out, FitOptions(preset="draft", holdout=4, refined_frames=1))
    return out
