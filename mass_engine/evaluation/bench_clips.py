"""The clips that a benchmark is run on: prepared once, with few enough frames and pixels."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch

from mass_engine.errors import BadArgumentError, EngineError
from mass_engine.evaluation.synthetic.benchmark import scene_of
from mass_engine.evaluation.synthetic.scene import FOV
from mass_engine.fitting.evidence import spread
from mass_engine.fitting.views import View
from mass_engine.options import FitOptions
from mass_engine.preprocess import Clip, prepare
from mass_engine.progress import ProgressMeter
from mass_engine.tracking.segmentation import BACKGROUND, HAND, IGNORE
from mass_engine.video.writer import write_video

HOLDOUT = 8


def clips_of(
    videos: Sequence[Path],
    quick: bool,
    seed: int,
    max_frames: int,
    folder: Path,
    heldout: int = 1 << 16,
    side: int = 1 << 16,
) -> Iterator[tuple[str, Clip]]:
    """Name and prepared clip of every video; without ``videos`` one synthetic clip, written to ``folder``.

    At most ``heldout`` held-out frames, evenly spread, are kept; crops are reduced to ``side`` pixels.
    Raises BadArgumentError ``bench.invalid``, EngineError ``eval.no_holdout`` and what a fit raises.
    """
    if max_frames < 2 or heldout < 1 or side < 64:
        raise BadArgumentError(
            "bench.invalid",
            "Too few frames, held-out frames or pixels.",
            "Use --max-frames 2, --heldout 1 and --side 64 or more.",
        )
    fov = None
    if not videos:
        scene = scene_of("plain", seed, quick)
        target = folder / "synthetic.mp4"
        write_video(target, (frame.rgb for frame in scene.frames()), scene.options.clip.fps, 16)
        videos, fov = [target], FOV
    options = FitOptions(holdout=HOLDOUT, seed=seed, max_frames=max_frames, fov=fov)
    for video in videos:
        clip = prepare(video, options, ProgressMeter(lambda _: None), lambda *_: None)
        held = [row for row, view in enumerate(clip.views) if view.heldout]
        trained = [row for row, view in enumerate(clip.views) if not view.heldout]
        if not held:
            raise EngineError(
                "eval.no_holdout",
                f"{video.name} shows the hand in too few frames to hold one out.",
                f"Use a clip that shows it in {2 * HOLDOUT} frames or more.",
            )
        kept = rows_of(clip, [*trained, *spread(held, heldout)])
        yield video.stem, replace(kept, views=[reduced(view, side) for view in kept.views])


def rows_of(clip: Clip, rows: Sequence[int]) -> Clip:
    """The clip with these rows of its views alone, in time order."""
    keep = sorted(set(rows))
    index = torch.tensor(keep)
    return replace(clip, views=[clip.views[row] for row in keep], start=clip.start.rows(index))


def reduced(view: View, side: int) -> View:
    """The view with its longer side reduced to ``side`` pixels; itself where it is no longer."""
    height, width = view.labels.shape
    scale = side / max(height, width)
    if scale >= 1:
        return view
    size = max(1, round(width * scale)), max(1, round(height * scale))
    cover = (view.labels == HAND).astype(np.float32) if view.coverage is None else view.coverage
    cover = np.asarray(cv2.resize(cover, size, interpolation=cv2.INTER_AREA), np.float32)
    ignored = cv2.resize((view.labels == IGNORE).astype(np.float32), size, interpolation=cv2.INTER_AREA)
    labels = np.where(np.asarray(ignored) > 0.5, IGNORE, np.where(cover > 0.5, HAND, BACKGROUND))
    cover[labels == IGNORE] = 0
    return replace(
        view,
        rgb=np.asarray(cv2.resize(view.rgb, size, interpolation=cv2.INTER_AREA), np.uint8),
        labels=labels.astype(np.uint8),
        coverage=cover,
        camera=view.camera.resized(*size),
        _levels={},
        _outline=None,
    )
