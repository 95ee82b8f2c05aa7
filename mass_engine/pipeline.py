"""The whole way from a video to an avatar: read, track, segment, align, convert, fit, evaluate, save."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import torch

from mass_engine.avatar import Avatar, row_pose
from mass_engine.evaluation.scores import mean_scores, score_view
from mass_engine.export.ply import write_ply
from mass_engine.fitting.report import FitReport, machine, peak_memory_bytes, versions
from mass_engine.fitting.trainer import FitResult, fit_hand, schedule_for
from mass_engine.options import FitOptions
from mass_engine.preprocess import Clip, Warn, prepare
from mass_engine.progress import Progress, ProgressMeter
from mass_engine.tracking.tracks import Tracks, write_tracks

#: Frames shown in previews/.
PREVIEWS = 8


@dataclass(frozen=True)
class FitOutcome:
    """What :func:`fit` returns."""

    avatar: Avatar
    report: FitReport
    tracks: Tracks
    clip: Clip


def fit(
    video: Path,
    options: FitOptions | None = None,
    report: Callable[[Progress], None] | None = None,
    warn: Warn | None = None,
) -> FitOutcome:
    """Reconstruct the hand in ``video``. Raises EngineError when the video cannot be used."""
    options = options or FitOptions()
    warnings: list[dict[str, str]] = []

    def note(code: str, message: str, advice: str) -> None:
        warnings.append({"code": code, "message": message, "advice": advice})
        if warn is not None:
            warn(code, message, advice)

    meter = ProgressMeter(report or (lambda _: None))
    clip = prepare(video, options, meter, note)
    meter.update("convert", 0.0)
    result = fit_hand(
        clip.views,
        clip.start,
        clip.model,
        clip.camera,
        schedule_for(options.preset),
        options.seed,
        lambda fraction, message: meter.update("fit", fraction, message),
    )
    kind, rows = _evaluate(result, clip, meter)
    tracks = _tracks(video.name, clip, result)
    meter.update("save", 0.0)
    meter.close()
    summary = FitReport(
        video={"name": video.name, **asdict(clip.info), "frames_read": clip.frames_read},
        options={
            name: str(value) if isinstance(value, Path) else value for name, value in asdict(options).items()
        },
        side=clip.model.side,
        fov={"degrees": round(clip.camera.fov_degrees, 2), "assumed": clip.fov_assumed},
        frames={
            "tracked": clip.tracked,
            "fitted": [view.index for view in clip.views if not view.heldout],
            "heldout": [view.index for view in clip.views if view.heldout],
            "choice": clip.choice.summary(),
        },
        surfels={
            "kept": len(result.avatar.kept),
            "converted": result.avatar.binding.count,
            "trimmed_as_not_hand": result.trimmed,
            "never_seen": result.unseen,
        },
        metrics=mean_scores(rows),
        scored_frames={"kind": kind, "count": len(rows)},
        per_frame=rows,
        seconds={name: round(value, 3) for name, value in meter.seconds.items()},
        peak_memory_bytes=peak_memory_bytes(),
        rejected_steps=result.rejected_steps,
        seed=options.seed,
        versions=versions(),
        machine=machine(),
        warnings=warnings,
    )
    return FitOutcome(result.avatar, summary, tracks, clip)


def fit_to_directory(
    video: Path,
    out: Path,
    options: FitOptions,
    report: Callable[[Progress], None] | None = None,
    warn: Warn | None = None,
) -> FitReport:
    """:func:`fit`, with everything the command line promises written to ``out``."""
    out.mkdir(parents=True, exist_ok=True)
    outcome = fit(video, options, report, warn)
    outcome.avatar.save(out)
    write_tracks(outcome.tracks, out / "tracks.json")
    write_ply(outcome.avatar.cloud("rest"), out / "surfels.ply", "2dgs")
    _write_previews(outcome, out / "previews")
    outcome.report.write(out)
    return outcome.report


def _evaluate(result: FitResult, clip: Clip, meter: ProgressMeter) -> tuple[str, list[dict[str, Any]]]:
    """Scores of the held-out frames, or of up to 32 training frames when none were held out."""
    held = [row for row, view in enumerate(clip.views) if view.heldout]
    rows = held or torch.linspace(0, len(clip.views) - 1, min(32, len(clip.views))).round().int().tolist()
    pose = result.avatar.frames.pose
    scores: list[dict[str, Any]] = []
    for done, row in enumerate(rows):
        view = clip.views[row]
        scores.append({"index": view.index, **score_view(result.avatar, view, row_pose(pose, row))})
        meter.update("evaluate", (done + 1) / len(rows))
    return ("heldout" if held else "training"), scores


def _tracks(name: str, clip: Clip, result: FitResult) -> Tracks:
    pose = result.avatar.frames.pose
    with torch.no_grad():
        joints = clip.model.joints(pose).numpy()
    return Tracks(
        name,
        clip.info.fps,
        (clip.info.width, clip.info.height),
        clip.camera.K,
        [view.index for view in clip.views],
        [view.time for view in clip.views],
        pose,
        joints,
        torch.stack([torch.from_numpy(view.points) for view in clip.views]).numpy(),
        [view.score for view in clip.views],
        clip.template,
        any(view.at_joints for view in clip.views),
    )


def _write_previews(outcome: FitOutcome, directory: Path) -> None:
    """A few frames of the clip beside their renders, and the named poses."""
    shutil.rmtree(directory, ignore_errors=True)
    directory.mkdir(parents=True)
    views, avatar = outcome.clip.views, outcome.avatar
    for row in torch.linspace(0, len(views) - 1, min(PREVIEWS, len(views))).round().int().unique().tolist():
        view = views[row]
        rgba = avatar.image(row_pose(avatar.frames.pose, row), view.camera).picture()
        over = rgba[..., 3:] / 255.0
        beside = (rgba[..., :3] * over + view.rgb * (0.25 * (1 - over))).astype("uint8")
        pair = cv2.hconcat([view.rgb, beside])
        cv2.imwrite(str(directory / f"frame-{view.index:06d}.jpg"), pair[..., ::-1])
    for name in ("rest", "fist", "point", "pinch", "spread"):
        rgba = avatar.render(name, "orbit:0,0", 384, 384)
        cv2.imwrite(str(directory / f"pose-{name}.png"), cv2.cvtColor(rgba, cv2.COLOR_RGBA2BGRA))
