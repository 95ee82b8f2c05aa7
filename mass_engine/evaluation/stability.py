"""``mass-engine bench stability``: what is lost when the clip is worse than it should be, ours and baselines.

Each axis makes one thing worse in steps, on the prepared clip, for several seeds; held-out pictures and masks
stay clean, so a loss is the fit's. A run fails when it raises, gives numbers that are not finite, or loses
more than 3 dB inside the mask against the same method on the clip as it is.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mass_engine.errors import BadArgumentError, EngineError
from mass_engine.evaluation.baselines import BASELINES, BaselineName, fit_baseline, register
from mass_engine.evaluation.charts import Chart, Series, draw
from mass_engine.evaluation.command import tell
from mass_engine.evaluation.heldout import REFINED
from mass_engine.evaluation.pareto import clips_of, fit_clip
from mass_engine.evaluation.perturb import Level, axes
from mass_engine.evaluation.refine import RefineOptions, refine_pose
from mass_engine.evaluation.scores import Renderable, mean_scores, score_view
from mass_engine.fitting.schedule import Schedule, schedule_for
from mass_engine.hand.pose import HandPose
from mass_engine.preprocess import Clip

#: More than this lost is a failure, dB.
FAILURE = 3.0
OURS = "ours"

Tell = Callable[[str], None]


@dataclass(frozen=True)
class Trial:
    """One run of one method. ``psnr`` is None where there is none; ``error`` says why."""

    clip: str
    axis: str
    value: float
    level: str
    method: str
    seed: int
    psnr: float | None
    iou: float | None
    refined_psnr: float | None = None
    error: str = ""


def trials(
    clip: Clip,
    name: str,
    wanted: dict[str, list[Level]],
    methods: Sequence[str],
    seeds: Sequence[int],
    schedule: Schedule,
    refine: bool,
    effort: float,
    tell: Tell,
) -> Iterator[Trial]:
    """Every method at every level of every axis. The clip as it is is run once a seed for all axes."""
    done: dict[int, list[Trial]] = {}
    for axis, levels in wanted.items():
        for level in levels:
            for seed in seeds:
                if level.value == 0.0 and seed in done:
                    for trial in done[seed]:
                        yield Trial(**{**asdict(trial), "axis": axis})
                    continue
                tell(f"{name}: {axis} {level.name}, seed {seed}")
                random = np.random.default_rng([seed, *axis.encode()])
                found = list(
                    _run(
                        level.change(clip, random), name, axis, level, methods, seed, schedule, refine, effort
                    )
                )
                if level.value == 0.0:
                    done[seed] = found
                yield from found


def _run(
    clip: Clip,
    name: str,
    axis: str,
    level: Level,
    methods: Sequence[str],
    seed: int,
    schedule: Schedule,
    refine: bool,
    effort: float,
) -> Iterator[Trial]:
    def trial(method: str, make: Callable[[], tuple[Renderable, dict[int, HandPose]]]) -> Trial:
        place = (name, axis, level.value, level.name, method, seed)
        try:
            psnr, iou, second = _score(*make(), clip, refine)
        except (EngineError, RuntimeError, ValueError, ArithmeticError) as error:
            return Trial(*place, None, None, None, f"{type(error).__name__}: {error}"[:200])
        return Trial(*place, psnr, iou, second)

    def ours() -> tuple[Renderable, dict[int, HandPose]]:
        avatar = fit_clip(clip, schedule, seed)[0].avatar
        return avatar, {view.index: avatar.frames.pose_of(view.index) for view in clip.views}

    if OURS in methods:
        yield trial(OURS, ours)
    baselines = [method for method in BASELINES if method in methods]
    if not baselines:
        return
    try:
        hand = register(clip, schedule, seed)
    except (EngineError, RuntimeError, ValueError) as error:
        for method in baselines:
            yield Trial(name, axis, level.value, level.name, method, seed, None, None, None, str(error)[:200])
        return
    poses = {view.index: hand.pose(row) for row, view in enumerate(clip.views)}
    for method in baselines:

        def made(method: BaselineName = method) -> tuple[Renderable, dict[int, HandPose]]:
            return fit_baseline(method, hand, seed, effort), poses

        yield trial(method, made)


def _score(
    subject: Renderable, poses: dict[int, HandPose], clip: Clip, refine: bool
) -> tuple[float | None, float | None, float | None]:
    """Mean PSNR in the mask and silhouette IoU, and the PSNR after test-time refinement."""
    rows, again = [], []
    for view in clip.views:
        if view.heldout:
            rows.append(score_view(subject, view, poses[view.index]))
            if refine:
                better = refine_pose(subject, view, poses[view.index], RefineOptions())
                again.append(score_view(subject, view, better))
    first, second = mean_scores(rows), mean_scores(again)
    if any(not math.isfinite(row["psnr_in_mask"]) for row in rows):
        raise ArithmeticError("a held-out frame has no finite score")
    return first["psnr_in_mask"], first["silhouette_iou"], second.get("psnr_in_mask")


def summarised(found: Sequence[Trial]) -> list[dict[str, Any]]:
    """Mean, worst and failure rate of every axis, level and method over clips and seeds."""
    base = {(t.clip, t.method, t.seed): t.psnr for t in found if t.value == 0.0 and t.psnr is not None}
    rows = []
    for key in dict.fromkeys((t.axis, t.value, t.level, t.method) for t in found):
        own = [t for t in found if (t.axis, t.value, t.level, t.method) == key]
        known = [t.psnr for t in own if t.psnr is not None]
        again = [t.refined_psnr for t in own if t.refined_psnr is not None]
        failed = [
            t for t in own
            if t.psnr is None or t.psnr < base.get((t.clip, t.method, t.seed), -math.inf) - FAILURE
        ]  # fmt: skip
        rows.append(
            {
                "axis": key[0],
                "value": key[1],
                "level": key[2],
                "method": key[3],
                "runs": len(own),
                "psnr_in_mask": sum(known) / len(known) if known else None,
                "worst": min(known) if known else None,
                f"psnr_in_mask_{REFINED}": sum(again) / len(again) if again else None,
                "failure_rate": len(failed) / len(own),
            }
        )
    return rows


def markdown(found: Sequence[Trial], command: str) -> str:
    """One table an axis: mean / worst, dB, and failures."""
    rows = summarised(found)
    methods = list(dict.fromkeys(row["method"] for row in rows))
    lines = [
        f"`{command}`: PSNR in the mask of held-out frames, dB: mean / worst, and the share of runs that "
        f"fail (raise, are not finite, or lose more than {FAILURE:g} dB).",
        "",
    ]
    for axis in dict.fromkeys(row["axis"] for row in rows):
        lines += [
            f"**{axis}**",
            "",
            "| level | " + " | ".join(methods) + " |",
            "|---|" + "---|" * len(methods),
        ]
        own = [row for row in rows if row["axis"] == axis]
        for level in dict.fromkeys(row["level"] for row in own):
            cells = []
            for method in methods:
                row = next((r for r in own if (r["level"], r["method"]) == (level, method)), None)
                if row is None or row["psnr_in_mask"] is None:
                    cells.append("failed" if row else "")
                    continue
                lost = f", {row['failure_rate']:.0%} fail" if row["failure_rate"] else ""
                cells.append(f"{row['psnr_in_mask']:.2f} / {row['worst']:.2f}{lost}")
            lines.append(f"| {level} | " + " | ".join(cells) + " |")
        lines.append("")
    return "\n".join(lines)


def charts(found: Sequence[Trial], out: Path) -> list[Path]:
    """One figure an axis: mean PSNR of every method, and its worst as a thin second line."""
    written: list[Path] = []
    rows = summarised(found)
    for number, axis in enumerate(dict.fromkeys(row["axis"] for row in rows)):
        own = [row for row in rows if row["axis"] == axis and row["psnr_in_mask"] is not None]
        series = []
        for method in dict.fromkeys(row["method"] for row in own):
            points = sorted((r for r in own if r["method"] == method), key=lambda r: float(r["value"]))
            xs = [float(r["value"]) for r in points]
            series.append(Series(method, xs, [r["psnr_in_mask"] for r in points]))
            series.append(Series(f"{method}, worst", xs, [r["worst"] for r in points], marker="."))
        if series:
            chart = Chart(f"Stability: {axis} (0: as it is)", axis, "PSNR in the mask, dB", series)
            name = "".join(c if c.isalnum() else "-" for c in axis).strip("-")
            written += draw(chart, out / f"stability-{number:02d}-{name}")
    return written


def run(rest: Sequence[str]) -> None:
    """The command."""
    known = axes()
    parser = argparse.ArgumentParser(prog="mass-engine bench stability", description=__doc__)
    parser.add_argument("videos", type=Path, nargs="*", metavar="VIDEO")
    parser.add_argument("--out", type=Path, default=Path("bench-stability"))
    parser.add_argument("--quick", action="store_true", help="two axes, one level, only to see that it works")
    parser.add_argument("--axis", action="append", default=[], metavar="NAME", help="part of an axis's name")
    parser.add_argument("--method", action="append", default=[], choices=(OURS, *BASELINES))
    parser.add_argument("--preset", default="draft", choices=("draft", "auto", "full"))
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--max-frames", type=int, default=80)
    parser.add_argument("--refine", action="store_true", help="score after test-time refinement, too")
    arguments = parser.parse_args(rest)
    wanted = {
        name: levels
        for name, levels in known.items()
        if not arguments.axis or any(part in name for part in arguments.axis)
    }
    if not wanted or arguments.seeds < 1:
        raise BadArgumentError("bench.axis", "No such axis, or no seed.", f"Use part of: {', '.join(known)}.")
    methods = tuple(arguments.method) or (OURS, *BASELINES)
    seeds = list(range(arguments.seeds))
    if arguments.quick:
        wanted = {name: [levels[0], levels[-1]] for name, levels in list(wanted.items())[:2]}
        seeds = seeds[:1]
    out: Path = arguments.out
    out.mkdir(parents=True, exist_ok=True)
    command = " ".join(["mass-engine bench stability", *rest])
    found: list[Trial] = []
    for name, clip in clips_of(arguments.videos, arguments.quick, 0, arguments.max_frames, out):
        for trial in trials(
            clip, name, wanted, methods, seeds, schedule_for(arguments.preset), arguments.refine,
            0.3 if arguments.quick else 1.0, tell,
        ):  # fmt: skip
            found.append(trial)
            data = {"command": command, "quick": arguments.quick, "trials": [asdict(t) for t in found]}
            (out / "stability.json").write_text(json.dumps(data, indent=2) + "\n")
    table = markdown(found, command)
    (out / "stability.md").write_text(table)
    print(table)
    for path in charts(found, out):
        print(f"wrote {path}")
