"""``mass-engine bench pareto``: speed and size against accuracy on held-out frames, ours and the baselines.

Every clip is prepared once; every variant then runs the same fit on the same crops, masks and start poses.
Seconds are of the fit alone. Frames a second are of one posed render at the crop's size on this machine; the
mesh baseline is drawn by a plain numpy z-buffer, so its speed says nothing about meshes.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch

from mass_engine.evaluation.baselines import (
    BASELINES,
    DESCRIPTIONS,
    Registered,
    fit_baseline,
    frames_per_second,
    register,
)
from mass_engine.evaluation.charts import Chart, Series, draw
from mass_engine.evaluation.command import tell
from mass_engine.evaluation.heldout import REFINED, number, score_frames
from mass_engine.evaluation.refine import RefineOptions
from mass_engine.evaluation.scores import Renderable, mean_scores
from mass_engine.evaluation.synthetic.benchmark import scene_of
from mass_engine.fitting.schedule import Schedule, schedule_for
from mass_engine.fitting.trainer import FitResult, fit_hand
from mass_engine.hand.pose import HandPose
from mass_engine.options import PRESETS, FitOptions
from mass_engine.preprocess import Clip, prepare
from mass_engine.progress import ProgressMeter
from mass_engine.video.writer import write_video

DEFAULT = "auto"
HOLDOUT = 8
METRICS = ("psnr_in_mask", "psnr_hand_on_black", "ms_ssim_hand_on_black", "silhouette_iou")
#: (column, label of its axis).
COSTS = (("seconds", "fit, seconds"), ("fps", "rendered frames a second"), ("bytes", "bytes"))

Tell = Callable[[str], None]


@dataclass(frozen=True)
class Point:
    """One variant on one clip."""

    clip: str
    group: str
    name: str
    seconds: float
    fps: float
    bytes: int
    surfels: int
    metrics: dict[str, float | None]
    refined: dict[str, float | None]
    error: str = ""


def variants(quick: bool) -> dict[str, dict[str, Schedule]]:
    """Schedules by group and name: presets, and one thing of ``auto`` changed at a time."""
    base = schedule_for("draft" if quick else DEFAULT)
    groups: dict[str, dict[str, Schedule]] = {
        "preset": {name: schedule_for(name) for name in (("draft",) if quick else PRESETS)}
    }
    budgets = ((1, 0), (0, 1)) if quick else ((0, 1), (1, 0), (1, 1), (2, 0), (2, 1))
    groups["levels and depth"] = {
        f"L{levels} D{depth}": replace(base, levels=levels, depth=depth) for levels, depth in budgets
    }
    if quick:
        return groups
    groups["harmonics"] = {f"{count} harmonics": replace(base, harmonics=count) for count in (0, 3, 8, 15)}
    groups["resolution"] = {
        f"{side} px": replace(
            base,
            gather_side=side,
            appearance=tuple(replace(step, side=min(step.side, side)) for step in base.appearance),
        )
        for side in (160, 320, 640)
    }
    groups["iterations"] = {
        f"visits x{factor:g}": replace(
            base,
            appearance=tuple(
                replace(step, visits=max(1, round(factor * step.visits))) for step in base.appearance
            ),
        )
        for factor in (0.5, 2.0)
    }
    groups["capacity"] = {
        "every surfel, deformation": replace(base, adaptive=False),
        "every surfel, no deformation": replace(base, adaptive=False, detached=False, deforming=()),
        "as needed, no deformation": replace(base, detached=False, deforming=()),
    }
    groups["registration"] = {
        "no texture rounds": replace(base, texture=()),
        "half the texture rounds": replace(base, texture=base.texture[::2]),
    }
    return groups


def fit_clip(clip: Clip, schedule: Schedule, seed: int) -> tuple[FitResult, float]:
    """One fit of a prepared clip, and its seconds."""
    start = time.perf_counter()
    result = fit_hand(clip.views, clip.start, clip.model, clip.camera, schedule, seed, lambda *_: None)
    return result, time.perf_counter() - start


def measure(clip: Clip, name: str, quick: bool, seed: int, refine: bool, tell: Tell) -> Iterator[Point]:
    """Every variant and every baseline on one clip."""
    for group, schedules in variants(quick).items():
        for label, schedule in schedules.items():
            tell(f"{name}: {label}")
            try:
                result, seconds = fit_clip(clip, schedule, seed)
            except (ValueError, RuntimeError) as error:
                yield _failed(name, group, label, error)
                continue
            avatar = result.avatar
            with tempfile.TemporaryDirectory() as folder:
                avatar.save(Path(folder))
                size = sum(path.stat().st_size for path in Path(folder).iterdir())
            poses = {view.index: avatar.frames.pose_of(view.index) for view in clip.views}
            yield _point(avatar, clip, poses, name, group, label, seconds, size, avatar.skin.count, refine)
    tell(f"{name}: registration for the baselines")
    hand: Registered = register(clip, schedule_for("draft" if quick else DEFAULT), seed)
    poses = {view.index: hand.pose(row) for row, view in enumerate(clip.views)}
    for baseline in BASELINES:
        tell(f"{name}: {baseline}")
        start = time.perf_counter()
        try:
            made = fit_baseline(baseline, hand, seed, 0.3 if quick else 1.0)
        except (ValueError, RuntimeError) as error:
            yield _failed(name, "baseline", baseline, error)
            continue
        seconds = hand.seconds + time.perf_counter() - start
        yield _point(made, clip, poses, name, "baseline", baseline, seconds, made.size_bytes, 0, refine)


def _point(
    subject: Renderable,
    clip: Clip,
    poses: dict[int, HandPose],
    name: str,
    group: str,
    label: str,
    seconds: float,
    size: int,
    surfels: int,
    refine: bool,
) -> Point:
    held = [view for view in clip.views if view.heldout]
    scores = score_frames(
        subject, held, [poses[view.index] for view in held], None, RefineOptions() if refine else None
    )
    fps = frames_per_second(subject, poses[held[0].index], held[0].camera)
    first, second = mean_scores(scores.as_fitted), mean_scores(scores.refined)
    kept = {metric: first.get(metric) for metric in METRICS}
    again = {metric: second.get(metric) for metric in METRICS} if second else {}
    return Point(name, group, label, seconds, fps, size, surfels, kept, again)


def _failed(clip: str, group: str, name: str, error: Exception) -> Point:
    return Point(clip, group, name, 0.0, 0.0, 0, 0, {}, {}, f"{type(error).__name__}: {error}")


def front(points: Sequence[tuple[float, float]], most: bool) -> list[int]:
    """Rows that no other beats in both: less cost (or more, with ``most``) and more value."""
    order = sorted(
        range(len(points)), key=lambda row: ((-1 if most else 1) * points[row][0], -points[row][1])
    )
    best, kept = float("-inf"), []
    for row in order:
        if points[row][1] > best:
            kept.append(row)
            best = points[row][1]
    return kept


def averaged(points: Sequence[Point]) -> list[dict[str, Any]]:
    """Means over clips of every variant that succeeded on all of them."""
    clips = {point.clip for point in points}
    rows = []
    for key in dict.fromkeys((point.group, point.name) for point in points):
        own = [point for point in points if (point.group, point.name) == key and not point.error]
        if {point.clip for point in own} != clips:
            continue
        row: dict[str, Any] = {"group": key[0], "name": key[1]}
        for column in ("seconds", "fps", "bytes", "surfels"):
            row[column] = sum(getattr(point, column) for point in own) / len(own)
        for metric in METRICS:
            for kind in ("metrics", "refined"):
                values = [getattr(point, kind).get(metric) for point in own]
                known = [value for value in values if value is not None]
                name = metric if kind == "metrics" else f"{metric}_{REFINED}"
                row[name] = sum(known) / len(known) if len(known) == len(own) else None
        rows.append(row)
    return rows


def markdown(points: Sequence[Point], clips: Sequence[str], command: str) -> str:
    """The table of means, what failed, and what the baselines are."""
    names = (*METRICS, f"psnr_in_mask_{REFINED}")
    lines = [f"`{command}`: means over {', '.join(clips)}.", ""]
    lines.append("| what changes | variant | s | fps | kB | surfels | " + " | ".join(names) + " |")
    lines.append("|---|---|---|---|---|---|" + "---|" * len(names))
    for row in averaged(points):
        cells = [f"{row['seconds']:.1f}", f"{row['fps']:.0f}", f"{row['bytes'] / 1000:.0f}"]
        cells += [f"{row['surfels']:.0f}", *(number(row.get(name)) for name in names)]
        lines.append(f"| {row['group']} | {row['name']} | " + " | ".join(cells) + " |")
    lines += ["", *[f"- {name}: {text}." for name, text in DESCRIPTIONS.items()]]
    lines += [f"- failed: {p.clip}, {p.name}: {p.error}" for p in points if p.error]
    return "\n".join(lines) + "\n"


def charts(points: Sequence[Point], out: Path) -> list[Path]:
    """Two metrics against each cost; the front is a line, the default preset marked."""
    written: list[Path] = []
    rows = averaged(points)
    for metric in ("psnr_in_mask", "ms_ssim_hand_on_black"):
        for cost, label in COSTS:
            known = [row for row in rows if row.get(metric) is not None and row[cost] > 0]
            if not known:
                continue
            places = [(float(row[cost]), float(row[metric])) for row in known]
            series = []
            for group in dict.fromkeys(str(row["group"]) for row in known):
                own = [row for row in known if row["group"] == group]
                xs, ys = [row[cost] for row in own], [row[metric] for row in own]
                labels = [str(row["name"]) for row in own]
                marker = "s" if group == "baseline" else "o"
                series.append(Series(group, xs, ys, labels, line=False, marker=marker))
            best = front(places, most=cost == "fps")
            series.append(
                Series("front", [places[r][0] for r in best], [places[r][1] for r in best], marker="")
            )
            ours = [row for row in known if (row["group"], row["name"]) == ("preset", DEFAULT)]
            if ours:
                series.append(
                    Series(
                        "our default",
                        [ours[0][cost]],
                        [ours[0][metric]],
                        line=False,
                        marker="*",
                        emphasis=True,
                    )
                )
            chart = Chart(f"{metric} on held-out frames", label, metric, series, log_x=True)
            written += draw(chart, out / f"pareto-{metric}-{cost}")
    return written


def clips_of(
    videos: Sequence[Path], quick: bool, seed: int, max_frames: int, folder: Path
) -> Iterator[tuple[str, Clip]]:
    """The prepared clips; without ``videos`` one synthetic clip."""
    options = FitOptions(holdout=HOLDOUT, seed=seed, max_frames=max_frames)
    if not videos:
        scene = scene_of("plain", seed, quick)
        target = folder / "synthetic.mp4"
        write_video(target, (frame.rgb for frame in scene.frames()), scene.options.clip.fps, 16)
        videos = [target]
    for video in videos:
        yield video.stem, prepare(video, options, ProgressMeter(lambda _: None), lambda *_: None)


def run(rest: Sequence[str]) -> None:
    """The command."""
    parser = argparse.ArgumentParser(prog="mass-engine bench pareto", description=__doc__)
    parser.add_argument("videos", type=Path, nargs="*", metavar="VIDEO")
    parser.add_argument("--out", type=Path, default=Path("bench-pareto"))
    parser.add_argument("--quick", action="store_true", help="a tiny grid, only to see that it works")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--max-frames", type=int, default=160)
    parser.add_argument("--no-refine", action="store_true")
    arguments = parser.parse_args(rest)
    out: Path = arguments.out
    out.mkdir(parents=True, exist_ok=True)
    points: list[Point] = []
    names: list[str] = []
    command = " ".join(["mass-engine bench pareto", *rest])
    for name, clip in clips_of(arguments.videos, arguments.quick, arguments.seed, arguments.max_frames, out):
        names.append(name)
        for point in measure(clip, name, arguments.quick, arguments.seed, not arguments.no_refine, tell):
            points.append(point)
            data = {
                "command": command,
                "quick": arguments.quick,
                "threads": torch.get_num_threads(),
                "points": [asdict(one) for one in points],
            }
            (out / "pareto.json").write_text(json.dumps(data, indent=2) + "\n")
    table = markdown(points, names, command)
    (out / "pareto.md").write_text(table)
    print(table)
    for path in charts(points, out):
        print(f"wrote {path}")
