"""Scoring the held-out frames of a finished fit: as fitted, and once more after test-time refinement."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from mass_engine.avatar import Avatar
from mass_engine.errors import BadArgumentError, EngineError
from mass_engine.evaluation.lpips import LpipsSet
from mass_engine.evaluation.refine import RefineOptions, refine_pose
from mass_engine.evaluation.scores import (
    Frame,
    frames_of,
    mean_scores,
    score_view,
    score_view_fully,
)
from mass_engine.fitting.evidence import spread
from mass_engine.fitting.report import FILE_NAME as REPORT
from mass_engine.options import FitOptions
from mass_engine.preprocess import Clip, prepare
from mass_engine.progress import ProgressMeter

#: What the second figure is called wherever it is written.
REFINED = "after_test_time_pose_refinement"
REFINED_LABEL = "after test-time pose refinement"
#: What tables show of it: the error that the refinement lowers is that of the whole picture.
REFINED_METRIC = "psnr_hand_on_black"
FILE_NAME = "evaluation.json"

Tell = Callable[[str], None]


@dataclass(frozen=True)
class HeldoutScores:
    """``as_fitted`` is the result: poses of held-out frames never saw their colours. ``refined`` is the
    second figure (empty when not asked for). One row a frame."""

    as_fitted: list[dict[str, Any]]
    refined: list[dict[str, Any]] = field(default_factory=list)

    def summary(self) -> dict[str, Any]:
        """Means and rows by name, for JSON."""
        result: dict[str, Any] = {
            "frames": len(self.as_fitted),
            "metrics": mean_scores(self.as_fitted),
            "per_frame": self.as_fitted,
        }
        if self.refined:
            result[REFINED] = {"metrics": mean_scores(self.refined), "per_frame": self.refined}
        return result

    def write(self, run: Path) -> None:
        """RUN/evaluation.json."""
        (run / FILE_NAME).write_text(json.dumps(self.summary(), indent=2) + "\n")

    def markdown(self) -> str:
        """Both figures side by side."""
        first, second = mean_scores(self.as_fitted), mean_scores(self.refined)
        head = "| metric | held out |" + (f" {REFINED_LABEL} |" if second else "")
        lines = [head, "|---|---|" + ("---|" if second else "")]
        for name, value in first.items():
            cells = [number(value), *([number(second[name])] if second else [])]
            lines.append(f"| {name} | " + " | ".join(cells) + " |")
        return "\n".join(lines)


@dataclass(frozen=True)
class RefinedScores:
    """The second figure of a few held-out ``frames`` (indices): mean ``metrics`` after test-time pose
    refinement, and of the same frames ``as_fitted``. In JSON it is under :data:`REFINED`."""

    frames: list[int] = field(default_factory=list)
    metrics: dict[str, float | None] = field(default_factory=dict)
    as_fitted: dict[str, float | None] = field(default_factory=dict)

    def cell(self, metric: str = REFINED_METRIC, digits: int = 2) -> str:
        """A table's cell, before and after; empty where nothing was refined."""
        if not self.frames:
            return ""
        return f"{number(self.as_fitted[metric], digits)} to {number(self.metrics[metric], digits)}"


def with_refined(row: dict[str, Any]) -> dict[str, Any]:
    """A row of a results file, its second figure made whole."""
    return {**row, REFINED: RefinedScores(**row.get(REFINED, {}))}


def number(value: float | None, digits: int = 3) -> str:
    """A table's cell."""
    return "not computed" if value is None else f"{value:.{digits}f}"


def score_frames(
    frames: Sequence[Frame],
    lpips: LpipsSet | None = None,
    refine: RefineOptions | None = None,
    progress: Callable[[float], None] | None = None,
) -> HeldoutScores:
    """Score ``frames``, and once more refined if ``refine`` is given."""
    rows, again = [], []
    for done, (subject, view, pose) in enumerate(frames):
        rows.append({"index": view.index, **score_view_fully(subject, view, pose, lpips)})
        if refine is not None:
            better = refine_pose(subject, view, pose, refine)
            again.append({"index": view.index, **score_view_fully(subject, view, better, lpips)})
        if progress is not None:
            progress((done + 1) / len(frames))
    return HeldoutScores(rows, again)


def score_refined(
    frames: Sequence[Frame], count: int, progress: Callable[[float], None] | None = None
) -> RefinedScores:
    """The second figure of ``count`` of the ``frames``, evenly spread: it takes seconds a frame."""
    chosen = spread(range(len(frames)), count) if frames else []
    first, second = [], []
    for done, place in enumerate(chosen):
        subject, view, pose = frames[place]
        first.append(score_view(subject, view, pose))
        second.append(score_view(subject, view, refine_pose(subject, view, pose)))
        if progress is not None:
            progress((done + 1) / len(chosen))
    indices = [frames[place][1].index for place in chosen]
    return RefinedScores(indices, mean_scores(second), mean_scores(first))


def score_clip(
    avatar: Avatar,
    clip: Clip,
    lpips: LpipsSet | None = None,
    refine: RefineOptions | None = None,
    progress: Callable[[float], None] | None = None,
) -> HeldoutScores:
    """Score the held-out frames of the ``clip`` an avatar was fitted to. Raises ``eval.no_holdout``."""
    held = [view for view in clip.views if view.heldout]
    if not held:
        raise EngineError("eval.no_holdout", "No frame was held out.", "Fit with --holdout 8, say.")
    return score_frames(frames_of(avatar, held), lpips, refine, progress)


def evaluate_run(
    run: Path,
    video: Path,
    masks: Path | None = None,
    lpips: LpipsSet | None = None,
    refine: bool = True,
    tell: Tell = lambda _: None,
) -> HeldoutScores:
    """Score the held-out frames of the RUN directory of a fit of ``video``, and write RUN/evaluation.json.

    The crops and masks are made again as the fit made them. Raises ``eval.no_run``, ``eval.other_video``
    and what reading a video raises.
    """
    report = read_report(run)
    avatar = Avatar.load(run)
    options = _options(report, run, masks)
    if report["video"].get("name") != video.name:
        tell(f"note: the run is of {report['video'].get('name')}, not of {video.name}")
    clip = prepare(video, options, ProgressMeter(lambda _: None), lambda code, *_: tell(f"note: {code}"))
    found = {view.index for view in clip.views if view.heldout}
    wanted = set(avatar.frames.indices[avatar.frames.heldout].tolist())
    if not wanted:
        raise EngineError("eval.no_holdout", "No frame was held out.", "Fit with --holdout 8, say.")
    if found != wanted:
        raise EngineError(
            "eval.other_video",
            f"{len(wanted - found)} of the run's held-out frames are not in this video.",
            "Give the video the run was fitted to.",
        )
    scores = score_clip(avatar, clip, lpips, RefineOptions() if refine else None)
    scores.write(run)
    return scores


def read_report(run: Path) -> dict[str, Any]:
    """RUN/report.json. Raises BadArgumentError ``eval.no_run``."""
    try:
        report = json.loads((run / REPORT).read_text())
        if not {"video", "options", "frames"} <= report.keys():
            raise ValueError("it is no report of one hand")
    except (OSError, ValueError, AttributeError) as error:
        raise BadArgumentError(
            "eval.no_run", f"{run} is not the folder of one hand's fit ({error}).", "Give RUN or RUN/right."
        ) from error
    return dict(report)


def _options(report: dict[str, Any], run: Path, masks: Path | None) -> FitOptions:
    """The run's own options. Masks hang on where the hand was tracked: they are those of the fit again where
    the tracker found it; otherwise (given tracks, one of two hands) the run's own tracks come nearest."""
    known = {item.name for item in fields(FitOptions)}
    given = {name: value for name, value in report["options"].items() if name in known}
    for name in ("masks", "segmenter_weights"):
        given[name] = None if given.get(name) is None else Path(given[name])
    tracked = given.get("tracks") is None and given.get("side") != "both"
    options = FitOptions(**(given if tracked else {**given, "tracks": None, "side": "auto", "fov": None}))
    tracks = None if tracked else run / "tracks.json"
    return replace(options, tracks=tracks, masks=masks or options.masks)
