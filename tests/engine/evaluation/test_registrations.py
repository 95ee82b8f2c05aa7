"""Fits that share a registration are the fits they would be alone; clips are reduced for benchmarks."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from mass_engine.evaluation.baselines import register
from mass_engine.evaluation.bench_clips import reduced, rows_of
from mass_engine.evaluation.registrations import Registrations
from mass_engine.fitting.schedule import Schedule, schedule_for
from mass_engine.fitting.trainer import Trainer, fit_hand
from mass_engine.frame_choice import FrameChoice
from mass_engine.hand.builtin import load_builtin
from mass_engine.preprocess import Clip
from mass_engine.tracking.segmentation import HAND
from mass_engine.video.reader import VideoInfo
from tests.engine.fitting.clips import CAMERA, make_views, true_poses

FRAMES, HELD = 6, frozenset({3})


def small_clip() -> Clip:
    poses = true_poses(FRAMES)
    info = VideoInfo(CAMERA.width, CAMERA.height, FRAMES, 30.0, FRAMES / 30, "h264", 0, None)
    choice = FrameChoice([], [], [], [], {})
    views = make_views(poses, heldout=HELD)
    model = load_builtin("right")
    return Clip(info, CAMERA, "given", "builtin", model, views, poses, FRAMES, FRAMES, [], [], choice)


def small_schedule() -> Schedule:
    draft = schedule_for("draft")
    return replace(
        draft,
        geometry=tuple(replace(stage, visits=2) for stage in draft.geometry),
        outline=draft.outline[:2],
        appearance=tuple(replace(stage, side=120, visits=1) for stage in draft.appearance),
        heldout=draft.heldout[:1],
    )


def test_a_shared_registration_runs_once_and_changes_no_bit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clip, schedule = small_clip(), small_schedule()
    outlines: list[int] = []
    outline = Trainer._outline

    def counted(self: Trainer, progress: object) -> None:
        outlines.append(self.seed)
        outline(self, progress)  # type: ignore[arg-type]

    monkeypatch.setattr(Trainer, "_outline", counted)
    shared = Registrations(clip, 0, tmp_path)
    other = replace(schedule, levels=0)
    first, seconds = shared.fit(other)
    assert seconds > sum(first.state.notes["seconds"][name] for name in first.state.steps) * 0.9
    second, _ = shared.fit(schedule)
    hand = register(shared, schedule)
    assert outlines == [0]
    again = Registrations(clip, 0, tmp_path)  # another process
    third, _ = again.fit(schedule)
    assert outlines == [0]
    alone = fit_hand(clip.views, clip.start, clip.model, clip.camera, schedule, 0, lambda *_: None)
    assert outlines == [0, 0]
    for result in (second, third):
        assert torch.equal(result.avatar.appearance.albedo, alone.avatar.appearance.albedo)
        assert torch.equal(result.avatar.frames.pose.hand_pose, alone.avatar.frames.pose.hand_pose)
    assert torch.equal(hand.shape.displacement, alone.avatar.shape.displacement)
    Registrations(clip, 1, tmp_path).fit(schedule)  # another seed registers anew
    assert outlines == [0, 0, 1]


def test_rows_and_reduced_views() -> None:
    clip = small_clip()
    fewer = rows_of(clip, [4, 1, 3])
    assert [view.index for view in fewer.views] == [1, 3, 4]
    assert torch.equal(fewer.start.transl, clip.start.transl[[1, 3, 4]])
    view = clip.views[0]
    small = reduced(view, 100)
    assert small.rgb.shape == (80, 100, 3)
    assert small.camera.width == 100
    assert np.array_equal(small.points, view.points)  # of the whole picture
    share = (small.labels == HAND).mean() / (view.labels == HAND).mean()
    assert 0.97 < share < 1.03
    assert reduced(view, 1000) is view
