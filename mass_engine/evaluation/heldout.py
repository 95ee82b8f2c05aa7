"""Scoring the held-out frames of a finished fit: as fitted, and once more after test-time refinement."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from torch import Tensor

from mass_engine.avatar import Avatar
from mass_engine.errors import BadArgumentError, EngineError
from mass_engine.evaluation.lpips import LpipsSet
from mass_engine.evaluation.refine import RefineOptions, refine_pose
from mass_engine.evaluation.scores import Exposed, Renderable, mean_scores, score_view_fully
from mass_engine.fitting.report import FILE_NAME as REPORT
from mass_engine.fitting.views import View
from mass_engine.hand.pose import HandPose
from mass_engine.options import FitOptions
from mass_engine.preprocess import Clip, prepare
from mass_engine.progress import ProgressMeter

#: What the second figure is called wherever it is written.
REFINED = "after_test_time_pose_refinement"
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

    def markdown(self) -> str:
        """Both figures side by side."""
        first, second = mean_scores(self.as_fitted), mean_scores(self.refined)
        head = "| metric | held out |" + (" after test-time pose refinement |" if second else "")
        lines = [head, "|---|---|" + ("---|" if second else "")]
        for name, value in first.items():
            cells = [number(value), *([number(second[name])] if second else [])]
            lines.append(f"| {name} | " + " | ".join(cells) + " |")
        return "\n".join(lines)


def number(value: float | None, digits: int = 3) -> str:
    """A table's cell."""
    return "not computed" if value is None else f"{value:.{digits}f}"


def score_frames(
    subject: Renderable,
    views: Sequence[View],
    poses: Sequence[HandPose],
    lpips: LpipsSet | None = None,
    refine: RefineOptions | None = None,
    progress: Callable[[float], None] | None = None,
    gains: Sequence[Tensor] | None = None,
) -> HeldoutScores:
    """Score ``views`` in their ``poses`` (batches of one), and once more refined if ``refine`` is given;
    ``gains`` ([3] each) by which the frames are brighter than the subject (None: they are not)."""
    rows, again = [], []
    for done, (view, pose) in enumerate(zip(views, poses, strict=True)):
        shown = subject if gains is None else Exposed(subject, gains[done])
        rows.append({"index": view.index, **score_view_fully(shown, view, pose, lpips)})
        if refine is not None:
            better = refine_pose(shown, view, pose, refine)
            again.append({"index": view.index, **score_view_fully(shown, view, better, lpips)})
        if progress is not None:
            progress((done + 1) / len(views))
    return HeldoutScores(rows, again)


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
    poses = [avatar.frames.pose_of(view.index) for view in held]
    gains = [avatar.frames.gain_of(view.index) for view in held]
    return score_frames(avatar, held, poses, lpips, refine, progress, gains)


def evaluate_run(
    run: Path,
    video: Path,
    masks: Path | None = None,
    lpips: LpipsSet | None = None,
    refine: bool = True,
    tell: Tell = lambda _: None,
) -> HeldoutScores:
    """Score the held-out frames of the RUN directory of a fit of ``video``, and write RUN/evaluation.json.

    The crops and masks are made again from the run's own tracks. Raises ``eval.no_run``, ``eval.other_video``
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
    (run / FILE_NAME).write_text(json.dumps(scores.summary(), indent=2) + "\n")
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
    """The run's own options, with its tracks instead of the tracker's."""
    known = {item.name for item in fields(FitOptions)}
    given = {name: value for name, value in report["options"].items() if name in known}
    for name in ("masks", "segmenter_weights"):
        given[name] = None if given.get(name) is None else Path(given[name])
    options = FitOptions(**{**given, "tracks": None, "side": "auto", "fov": None})
    return replace(options, tracks=run / "tracks.json", masks=masks or options.masks)
