"""The whole way from a video to an avatar: read, track, segment, align, convert, fit, evaluate, save."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from mass_engine.avatar import Avatar, row_pose
from mass_engine.device import choose_device, device_report
from mass_engine.errors import BadArgumentError
from mass_engine.evaluation.heldout import RefinedScores, score_refined
from mass_engine.evaluation.scores import frames_of, mean_scores, score_view
from mass_engine.export.ply import write_ply
from mass_engine.fitting.evidence import spread
from mass_engine.fitting.looks import Show
from mass_engine.fitting.report import (
    SHARED_STAGES,
    FitReport,
    HandsReport,
    curves,
    machine,
    peak_memory_bytes,
    versions,
)
from mass_engine.fitting.schedule import schedule_for
from mass_engine.fitting.trainer import FitResult, fit_hand
from mass_engine.options import FitOptions
from mass_engine.preprocess import Clip, prepare_hand
from mass_engine.progress import FIT_STAGES, Progress, ProgressMeter
from mass_engine.survey import Survey, SurveyedHand, Warn, survey
from mass_engine.tracking.sides import SIDES
from mass_engine.tracking.tracks import Tracks, write_tracks

#: Where a RUN directory keeps the steps of a fit that is not finished.
CHECKPOINTS = "checkpoint"
#: Frames shown in previews/.
PREVIEWS = 8


@dataclass(frozen=True)
class FitOutcome:
    """What :func:`fit` returns."""

    avatar: Avatar
    report: FitReport
    tracks: Tracks
    clip: Clip


Report = Callable[[Progress], None]


def fit(
    video: Path,
    options: FitOptions | None = None,
    report: Report | None = None,
    warn: Warn | None = None,
    show: Show | None = None,
    checkpoints: Path | None = None,
) -> FitOutcome:
    """Reconstruct the hand in ``video``; finished steps are kept in the folder ``checkpoints``. ``show``
    gets a look at it now and then.

    Raises EngineError when the video cannot be used, BadArgumentError ``options.invalid`` for
    ``side="both"``: see :func:`fit_hands`.
    """
    options = options or FitOptions()
    if options.side == "both":
        raise BadArgumentError(
            "options.invalid", "fit() makes one avatar.", "Use fit_hands() for both hands, or another side."
        )
    notes = _Notes(warn)
    meter = ProgressMeter(report or (lambda _: None))
    found = survey(video, options, meter, notes)
    return _fit_hand(video, found, found.hands[0], options, meter, notes, show, checkpoints)


def fit_hands(
    video: Path,
    options: FitOptions | None = None,
    report: Report | None = None,
    warn: Warn | None = None,
    show: Show | None = None,
    checkpoints: Path | None = None,
) -> Iterator[FitOutcome]:
    """Reconstruct both hands of the person in ``video`` (or the one there is), the right one first.

    ``options.side`` is taken as ``both``. One hand after the other, as the results are asked for: only one
    of them is in memory. Finished steps are kept in the folder ``checkpoints``. Raises EngineError when the
    video cannot be used.
    """
    options = replace(options or FitOptions(), side="both")
    shared = {name: share for name, share in FIT_STAGES.items() if name in SHARED_STAGES}
    own = {name: share for name, share in FIT_STAGES.items() if name not in shared}
    notes, whole = _Notes(warn), _Whole(report or (lambda _: None))
    first = sum(shared.values())
    meter = ProgressMeter(whole.part(0.0, first, ""), shared)
    found = survey(video, options, meter, notes)
    meter.close()
    for number, hand in enumerate(found.hands):
        share = (1 - first) / len(found.hands)
        note = f"{hand.side} hand" if len(found.hands) > 1 else ""
        part = ProgressMeter(whole.part(first + number * share, share, note), own)
        part.seconds |= meter.seconds
        yield _fit_hand(video, found, hand, options, part, notes, show, checkpoints)


class _Notes:
    """Collects warnings for the report and passes them on."""

    def __init__(self, warn: Warn | None) -> None:
        self.warnings: list[dict[str, str]] = []
        self._warn = warn

    def __call__(self, code: str, message: str, advice: str) -> None:
        self.warnings.append({"code": code, "message": message, "advice": advice})
        if self._warn is not None:
            self._warn(code, message, advice)


class _Whole:
    """Progress over several parts, each with a meter of its own."""

    def __init__(self, report: Report) -> None:
        self._report = report
        self._start = time.monotonic()

    def part(self, begin: float, share: float, note: str) -> Report:
        """Where the meter of the part from ``begin`` on reports to."""

        def report(step: Progress) -> None:
            fraction = begin + share * step.fraction
            elapsed = time.monotonic() - self._start
            left = elapsed * (1 - fraction) / fraction if fraction > 0.02 else None
            message = ": ".join(text for text in (note, step.message) if text)
            self._report(Progress(step.stage, fraction, left, message))

        return report


def _fit_hand(
    video: Path,
    found: Survey,
    hand: SurveyedHand,
    options: FitOptions,
    meter: ProgressMeter,
    notes: _Notes,
    show: Show | None,
    checkpoints: Path | None,
) -> FitOutcome:
    checkpoint = None if checkpoints is None else _checkpoint(checkpoints, hand.side, options)
    device = choose_device(options.device)
    clip = prepare_hand(video, found, hand, options, meter)
    meter.update("convert", 0.0)
    result = fit_hand(
        clip.views,
        clip.start,
        clip.model,
        clip.camera,
        schedule_for(options.preset, options.components),
        options.seed,
        lambda fraction, message: meter.update("fit", fraction, message),
        options.components,
        checkpoint,
        show,
        device,
        options.precision,
    )
    found_out = result.state.notes
    if found_out.get("undone_steps"):
        notes(
            "fit.stepped_back",
            f"The fit diverged and stepped back {found_out['undone_steps']} times.",
            "Look at the held-out frames; a clip with steadier light and less blur fits better.",
        )
    kind, rows, again = _evaluate(result, clip, meter, options.refined_frames)
    tracks = _tracks(video.name, clip, result)
    meter.update("save", 0.0)
    meter.close()
    summary = FitReport(
        video={"name": video.name, **asdict(clip.info), "frames_read": clip.frames_read},
        options={
            name: str(value) if isinstance(value, Path) else value for name, value in asdict(options).items()
        },
        side=clip.model.side,
        fov={
            "degrees": round(clip.camera.fov_degrees, 2),
            "source": clip.fov_source,
            "assumed": clip.fov_source == "assumed",
        },
        frames={
            "tracked": clip.tracked,
            "not_trusted": clip.doubted,
            "estimated": clip.estimated,
            "fitted": [view.index for view in clip.views if not view.heldout],
            "heldout": [view.index for view in clip.views if view.heldout],
            "choice": clip.choice.summary(),
        },
        surfels={
            "kept": result.avatar.skin.count,
            "detached": len(result.avatar.skin.detached),
            "trimmed_as_not_hand": result.trimmed,
            "never_seen": result.unseen,
        },
        metrics=mean_scores(rows),
        scored_frames={"kind": kind, "count": len(rows)},
        per_frame=rows,
        after_test_time_pose_refinement=asdict(again) if again.frames else {},
        seconds={name: round(value, 3) for name, value in meter.seconds.items()},
        peak_memory_bytes=peak_memory_bytes(),
        curves=curves(found_out),
        fit={**found_out, "steps": result.state.steps},
        seed=options.seed,
        versions=versions(),
        machine={**machine(), **device_report(device)},
        warnings=list(notes.warnings),
    )
    return FitOutcome(result.avatar, summary, tracks, clip)


def _checkpoint(folder: Path, side: str, options: FitOptions) -> Path:
    """The file that keeps the finished steps of one hand's fit; what is not to be gone on with is removed."""
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / f"{side}.safetensors"
    stages = list(FIT_STAGES)
    anew = options.from_stage is not None and stages.index(options.from_stage) <= stages.index("fit")
    if anew or not options.resume:
        file.unlink(missing_ok=True)
    return file


def fit_to_directory(
    video: Path,
    out: Path,
    options: FitOptions,
    report: Report | None = None,
    warn: Warn | None = None,
) -> FitReport:
    """:func:`fit`, with everything the command line promises written to ``out``."""
    out.mkdir(parents=True, exist_ok=True)
    return _write(fit(video, options, report, warn, _live_preview(out), out / CHECKPOINTS), out)


def fit_hands_to_directory(
    video: Path,
    out: Path,
    options: FitOptions,
    report: Report | None = None,
    warn: Warn | None = None,
) -> HandsReport:
    """:func:`fit_hands`, each hand written to a folder of its own, ``out/right`` and ``out/left``; ``out``
    itself gets the report and the tracks of both."""
    out.mkdir(parents=True, exist_ok=True)
    for side in SIDES:
        shutil.rmtree(out / side, ignore_errors=True)
    reports, tracks = [], []
    for outcome in fit_hands(video, options, report, warn, _live_preview(out), out / CHECKPOINTS):
        folder = out / outcome.report.side
        folder.mkdir()
        reports.append(_write(outcome, folder))
        tracks.append(outcome.tracks)
    write_tracks(tracks, out / "tracks.json")
    shutil.rmtree(out / CHECKPOINTS, ignore_errors=True)
    shutil.rmtree(out / "previews", ignore_errors=True)
    both = HandsReport.of(reports)
    both.write(out)
    return both


def _live_preview(out: Path) -> Show:
    """Keeps the latest look at the hand in ``out/previews/live.jpg``, which the results replace."""

    def show(picture: NDArray[np.uint8]) -> None:
        folder = out / "previews"
        folder.mkdir(exist_ok=True)
        part = folder / "live.part.jpg"
        cv2.imwrite(str(part), picture[..., ::-1])
        part.replace(folder / "live.jpg")  # whoever reads it sees one picture or the other

    return show


def _write(outcome: FitOutcome, out: Path) -> FitReport:
    outcome.avatar.save(out)
    write_tracks([outcome.tracks], out / "tracks.json")
    write_ply(outcome.avatar.cloud("rest"), out / "surfels.ply", "2dgs")
    _write_previews(outcome, out / "previews")
    outcome.report.write(out)
    shutil.rmtree(out / CHECKPOINTS, ignore_errors=True)
    return outcome.report


def _evaluate(
    result: FitResult, clip: Clip, meter: ProgressMeter, refined: int
) -> tuple[str, list[dict[str, Any]], RefinedScores]:
    """Scores of the held-out frames, or of up to 32 training frames when none were held out; and the second
    figure of ``refined`` held-out frames."""
    held = [view for view in clip.views if view.heldout]
    chosen = held or [clip.views[row] for row in spread(range(len(clip.views)), 32)]
    frames = frames_of(result.avatar, chosen)
    share = len(chosen) / (len(chosen) + 20 * refined)  # of the time, roughly: a refinement renders thousands
    scores: list[dict[str, Any]] = []
    for done, frame in enumerate(frames):
        scores.append({"index": frame[1].index, **score_view(*frame)})
        meter.update("evaluate", share * (done + 1) / len(frames))
    again = score_refined(
        frames if held else [],
        refined,
        lambda done: meter.update("evaluate", share + (1 - share) * done, "test-time pose refinement"),
    )
    return ("heldout" if held else "training"), scores, again


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
