"""``mass-engine bench pareto``: speed and size against accuracy on held-out frames, ours and the baselines.

Every clip is prepared once; every variant then runs on the same crops, masks and start poses. Variants that
register alike, and the baselines, go on from one registration; seconds count it for each of them. Preparing
is not counted. Frames a second are of one posed render at the crop's size on this machine; the mesh baseline
is drawn by a plain numpy z-buffer, so its speed says nothing about meshes.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from mass_engine.evaluation.arguments import add_refined_frames
from mass_engine.evaluation.baselines import (
    BASELINES,
    DESCRIPTIONS,
    Registered,
    fit_baseline,
    frames_per_second,
    register,
)
from mass_engine.evaluation.bench_clips import clips_of
from mass_engine.evaluation.charts import PALETTE, Chart, Series, draw
from mass_engine.evaluation.command import tell
from mass_engine.evaluation.heldout import (
    REFINED,
    REFINED_LABEL,
    REFINED_METRIC,
    RefinedScores,
    number,
    score_refined,
    with_refined,
)
from mass_engine.evaluation.registrations import Registrations
from mass_engine.evaluation.results_file import read_rows, write_results, write_text
from mass_engine.evaluation.scores import Frame, Renderable, frames_of, mean_scores, placed, score_view
from mass_engine.evaluation.variants import DEFAULT, variants
from mass_engine.fitting.schedule import Schedule, schedule_for
from mass_engine.preprocess import Clip
from mass_engine.threads import one_thread

METRICS = ("psnr_in_mask", "psnr_hand_on_black", "ms_ssim_hand_on_black", "silhouette_iou")
#: (column, label of its axis).
COSTS = (("seconds", "fit, seconds"), ("fps", "rendered frames a second"), ("bytes", "size, bytes"))
LABELS = {
    "psnr_in_mask": "PSNR in the mask, dB",
    "psnr_hand_on_black": "PSNR of the hand on black, dB",
    "ms_ssim_hand_on_black": "MS-SSIM of the hand on black",
}
#: Test-time refinement takes seconds a frame: these groups alone get that second figure.
REFINED_GROUPS = ("preset", "baseline")

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
    after_test_time_pose_refinement: RefinedScores = field(default_factory=RefinedScores)
    error: str = ""


@dataclass
class Bench:
    """What is asked of one clip. ``known`` points are not measured again."""

    clip: Clip
    name: str
    seed: int
    quick: bool
    registrations: Registrations
    refined_frames: int
    known: Sequence[Point] = ()

    def points(self, tell: Tell) -> Iterator[Point]:
        """Every variant and every baseline; known ones first of all."""
        yield from self.known
        done = {(point.group, point.name) for point in self.known}
        made = {
            repr(schedule): point
            for group, schedules in variants(self.quick).items()
            for label, schedule in schedules.items()
            for point in self.known
            if (point.group, point.name) == (group, label)
        }
        for group, schedules in variants(self.quick).items():
            for label, schedule in schedules.items():
                if (group, label) in done:
                    continue
                tell(f"{self.name}: {label}")
                found = made.get(repr(schedule))
                if found is None:
                    found = made[repr(schedule)] = self._ours(group, label, schedule)
                yield replace(found, group=group, name=label)
        wanted = [name for name in BASELINES if ("baseline", name) not in done]
        if not wanted:
            return
        tell(f"{self.name}: registration for the baselines")
        hand: Registered = register(self.registrations, schedule_for("draft" if self.quick else DEFAULT))
        held = [view for view in self.clip.views if view.heldout]
        for baseline in wanted:
            tell(f"{self.name}: {baseline}")
            start = time.perf_counter()
            try:
                fitted = fit_baseline(baseline, hand, self.seed, 0.3 if self.quick else 1.0)
            except (ValueError, RuntimeError) as error:
                yield _failed(self.name, "baseline", baseline, error)
                continue
            seconds = hand.seconds + time.perf_counter() - start
            frames = placed(fitted, hand.frames, held)
            yield self._point(fitted, frames, "baseline", baseline, seconds, fitted.size_bytes, 0)

    def _ours(self, group: str, label: str, schedule: Schedule) -> Point:
        try:
            result, seconds = self.registrations.fit(schedule)
        except (ValueError, RuntimeError) as error:
            return _failed(self.name, group, label, error)
        avatar = result.avatar
        with tempfile.TemporaryDirectory() as folder:
            avatar.save(Path(folder))
            size = sum(path.stat().st_size for path in Path(folder).iterdir())
        frames = frames_of(avatar, [view for view in self.clip.views if view.heldout])
        return self._point(avatar, frames, group, label, seconds, size, avatar.skin.count)

    def _point(
        self,
        subject: Renderable,
        frames: list[Frame],
        group: str,
        label: str,
        seconds: float,
        size: int,
        surfels: int,
    ) -> Point:
        with one_thread():
            rows = [score_view(*frame) for frame in frames]
            again = score_refined(frames, self.refined_frames if group in REFINED_GROUPS else 0)
            _, view, pose = frames[0]
            fps = frames_per_second(subject, pose, view.camera)
        means = mean_scores(rows)
        kept = {metric: means.get(metric) for metric in METRICS}
        return Point(self.name, group, label, seconds, fps, size, surfels, kept, again)


def _failed(clip: str, group: str, name: str, error: Exception) -> Point:
    return Point(clip, group, name, 0.0, 0.0, 0, 0, {}, error=f"{type(error).__name__}: {error}")


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
            row[metric] = _mean([point.metrics.get(metric) for point in own])
        second = [point.after_test_time_pose_refinement for point in own]
        row[REFINED] = _mean([one.metrics.get(REFINED_METRIC) for one in second])
        row["before"] = _mean([one.as_fitted.get(REFINED_METRIC) for one in second])
        rows.append(row)
    return rows


def _mean(values: Sequence[float | None]) -> float | None:
    """None if any is missing: a mean over other clips would say something else."""
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known and len(known) == len(values) else None


def markdown(points: Sequence[Point], clips: Sequence[str], command: str) -> str:
    """The table of means, what failed, and what the baselines are."""
    lines = [
        f"`{command}`: means over {', '.join(clips)}. `seconds`: registration and what comes after it, torch "
        f"in one thread, {os.cpu_count()} cores. The last column: {REFINED_METRIC} of a few held-out frames "
        "as fitted, and after test-time pose refinement; presets and baselines only.",
        "",
    ]
    lines.append(
        "| what changes | variant | s | fps | kB | surfels | " + " | ".join(METRICS) + f" | {REFINED_LABEL} |"
    )
    lines.append("|---|---|---|---|---|---|" + "---|" * (len(METRICS) + 1))
    for row in averaged(points):
        cells = [f"{row['seconds']:.1f}", f"{row['fps']:.0f}", f"{row['bytes'] / 1000:.0f}"]
        cells += [f"{row['surfels']:.0f}", *(number(row.get(name)) for name in METRICS)]
        before, after = row["before"], row[REFINED]
        cells.append("" if after is None else f"{number(before, 2)} to {number(after, 2)}")
        lines.append(f"| {row['group']} | {row['name']} | " + " | ".join(cells) + " |")
    lines += ["", *[f"- {name}: {text}." for name, text in DESCRIPTIONS.items()]]
    lines += [f"- failed: {p.clip}, {p.name}: {p.error}" for p in points if p.error]
    return "\n".join(lines) + "\n"


def charts(points: Sequence[Point], out: Path) -> list[Path]:
    """Three metrics against each cost, clip by clip one above the other; each clip's front is a line, the
    default preset a star."""
    written: list[Path] = []
    clips = list(dict.fromkeys(point.clip for point in points))
    named = dict.fromkeys((point.group, point.name) for point in points if not point.error)
    numbers = {key: str(place + 1) for place, key in enumerate(named)}
    for metric in METRICS[:3]:
        for cost, label in COSTS:
            panels = []
            for clip in clips:
                rows = averaged([point for point in points if point.clip == clip])
                known = [row for row in rows if row.get(metric) is not None and row[cost] > 0]
                if known:
                    title = f"Held-out frames of {clip}"
                    series = _series(known, metric, cost, numbers)
                    panels.append(Chart(title, label, LABELS[metric], series, log_x=True))
            if panels:
                written += draw(panels, out / f"pareto-{metric}-{cost}", stacked=True)
    return written


def _series(
    rows: Sequence[dict[str, Any]], metric: str, cost: str, numbers: dict[tuple[str, str], str]
) -> list[Series]:
    """One clip's front, default and groups; ``numbers`` of the variants are the same for every clip."""
    places = [(float(row[cost]), float(row[metric])) for row in rows]
    best = front(places, most=cost == "fps")
    xs, ys = [places[r][0] for r in best], [places[r][1] for r in best]
    series = [Series("front", xs, ys, marker="", color="#BBBBBB")]
    ours = [row for row in rows if (row["group"], row["name"]) == ("preset", DEFAULT)]
    if ours:
        star = [ours[0][cost]], [ours[0][metric]]
        series.append(Series("our default", *star, line=False, marker="*", color="#C00000", emphasis=True))
    for place, group in enumerate([*variants(quick=False), "baseline"]):  # each its own colour
        own = [row for row in rows if row["group"] == group]
        if not own:
            continue
        labels = [numbers[row["group"], row["name"]] for row in own]
        series.append(
            Series(
                group, [row[cost] for row in own], [row[metric] for row in own], labels, line=False,
                marker="s" if group == "baseline" else "o", color=PALETTE[place % len(PALETTE)],
                key=[f"{n}  {name}" for (of, name), n in numbers.items() if of == group],
            )
        )  # fmt: skip
    return series


def run(rest: Sequence[str]) -> None:
    """The command."""
    parser = argparse.ArgumentParser(prog="mass-engine bench pareto", description=__doc__)
    parser.add_argument("videos", type=Path, nargs="*", metavar="VIDEO")
    parser.add_argument("--out", type=Path, default=Path("bench-pareto"))
    parser.add_argument("--quick", action="store_true", help="a tiny grid, only to see that it works")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--max-frames", type=int, default=160, help="training frames")
    parser.add_argument("--heldout", type=int, default=24, help="held-out frames at most")
    add_refined_frames(parser, 4)
    parser.add_argument("--registrations", type=Path, metavar="DIR", help="keep them, for bench needed too")
    parser.add_argument("--resume", action="store_true", help="go on with the results in --out")
    arguments = parser.parse_args(rest)
    out: Path = arguments.out
    out.mkdir(parents=True, exist_ok=True)
    names = ("quick", "seed", "max_frames", "heldout", "refined_frames")
    settings = {name: getattr(arguments, name) for name in names}
    file = out / "pareto.json"
    points = [Point(**with_refined(row)) for row in read_rows(file, arguments.resume, settings)]
    points = [point for point in points if not point.error]
    command = " ".join(["mass-engine bench pareto", *rest])
    clips = []
    with tempfile.TemporaryDirectory() as scratch:
        for name, clip in clips_of(
            arguments.videos, arguments.quick, 0, arguments.max_frames, out, arguments.heldout
        ):
            clips.append(name)
            folder = (arguments.registrations or Path(scratch)) / name
            known = [point for point in points if point.clip == name]
            points = [point for point in points if point.clip != name]
            registrations = Registrations(clip, arguments.seed, folder)
            bench = Bench(
                clip, name, arguments.seed, arguments.quick, registrations, arguments.refined_frames, known
            )
            for point in bench.points(tell):
                points.append(point)
                write_results(file, command, settings, [asdict(one) for one in points])
    table = markdown(points, clips, command)
    write_text(out / "pareto.md", table)
    print(table)
    for path in charts(points, out):
        print(f"wrote {path}")
