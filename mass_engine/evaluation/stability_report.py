"""The tables and figures of ``mass-engine bench stability``."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mass_engine.evaluation.baselines import BASELINES
from mass_engine.evaluation.charts import PALETTE, Chart, Series, draw
from mass_engine.evaluation.heldout import REFINED, REFINED_LABEL, REFINED_METRIC, RefinedScores
from mass_engine.evaluation.perturb import axes

#: More than this lost is a failure, dB.
FAILURE = 3.0
OURS = "ours"
#: The axis of the clip as it is, the first place of every other axis.
UNCHANGED = "as it is"
_LABELS = {"psnr": "PSNR in the mask, dB", "psnr_on_black": "PSNR of the hand on black, dB"}


Row = dict[str, Any]


@dataclass(frozen=True)
class Trial:
    """One run of one method. ``psnr`` (in the mask), ``psnr_on_black`` and ``iou`` are means over the
    held-out frames, None where there are none; ``error`` says why."""

    clip: str
    axis: str
    value: float
    level: str
    method: str
    seed: int
    psnr: float | None
    psnr_on_black: float | None
    iou: float | None
    after_test_time_pose_refinement: RefinedScores = field(default_factory=RefinedScores)
    seconds: float = 0.0
    error: str = ""


def summarised(found: Sequence[Trial]) -> list[Row]:
    """Mean, worst, best and failure rate of every axis, level and method over clips and seeds; the levels in
    the order of their axis, whatever ran first."""
    base = {(t.clip, t.method, t.seed): t for t in found if t.axis == UNCHANGED}
    known = axes()
    rows = []
    for axis in axes_of(found):
        own_axis = [t for t in found if t.axis in (UNCHANGED, axis)]
        order = [level.name for level in known.get(axis, [])]
        keys = dict.fromkeys((t.value, t.level, t.method) for t in own_axis)
        for key in sorted(keys, key=lambda key: order.index(key[1]) if key[1] in order else len(order)):
            own = [t for t in own_axis if (t.value, t.level, t.method) == key]
            failed = [t for t in own if _failed(t, base.get((t.clip, t.method, t.seed)))]
            second = [t.after_test_time_pose_refinement for t in own]
            row = {
                "axis": axis,
                "value": key[0],
                "level": key[1],
                "method": key[2],
                "runs": len(own),
                "iou": _mean([t.iou for t in own]),
                REFINED: _mean([one.metrics.get(REFINED_METRIC) for one in second]),
                "before": _mean([one.as_fitted.get(REFINED_METRIC) for one in second]),
                "failure_rate": len(failed) / len(own),
            }
            for column in _LABELS:
                values = [value for t in own if (value := getattr(t, column)) is not None]
                row[column] = _mean(values)
                row[f"{column}_worst"] = min(values, default=None)
                row[f"{column}_best"] = max(values, default=None)
            rows.append(row)
    return rows


def axes_of(found: Sequence[Trial]) -> list[str]:
    """The axes measured so far; only the unchanged clip's name while there is nothing else."""
    return list(dict.fromkeys(t.axis for t in found if t.axis != UNCHANGED)) or [UNCHANGED]


def _failed(trial: Trial, base: Trial | None) -> bool:
    """It raised, or either PSNR is more than FAILURE under the same method's on the clip as it is."""
    if trial.psnr is None or trial.psnr_on_black is None:
        return True
    if base is None or base.psnr is None or base.psnr_on_black is None:
        return False
    return max(base.psnr - trial.psnr, base.psnr_on_black - trial.psnr_on_black) > FAILURE


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None and math.isfinite(value)]
    return sum(known) / len(known) if known else None


def markdown(found: Sequence[Trial], command: str, notes: Sequence[str]) -> str:
    """Two tables an axis: scores as fitted, with failures, and the second figure if there is one."""
    rows = summarised(found)
    lines = [
        f"`{command}`: held-out frames: PSNR in the mask, mean (worst to best of several runs) / PSNR of the "
        "hand on black, mean, in dB; then the share of runs that fail (raise, are not finite, or lose more "
        f"than {FAILURE:g} dB of either).",
        "",
        *[f"- {note}" for note in notes],
        "",
    ]
    for axis in dict.fromkeys(row["axis"] for row in rows):
        own = [row for row in rows if row["axis"] == axis]
        lines += [f"**{axis}**", "", *_table(own, _cell), ""]
        if any(row[REFINED] is not None for row in own):
            lines += [
                f"{axis}, {REFINED_LABEL}: {REFINED_METRIC} of a few held-out frames, before and after",
                "",
            ]
            lines += [*_table(own, _refined_cell), ""]
    errors = dict.fromkeys(f"{t.axis}, {t.level}, {t.method}: {t.error}" for t in found if t.error)
    lines += [f"- {error}" for error in errors]
    return "\n".join(lines) + "\n"


def _table(rows: Sequence[Row], cell: Callable[[Row], str]) -> list[str]:
    """A line a level, a column a method."""
    methods = [name for name in (OURS, *BASELINES) if any(row["method"] == name for row in rows)]
    lines = [f"| level | runs | {' | '.join(methods)} |", "|---" * (len(methods) + 2) + "|"]
    for level in dict.fromkeys(row["level"] for row in rows):
        own = {row["method"]: row for row in rows if row["level"] == level}
        cells = [cell(own[name]) if name in own else "" for name in methods]
        runs = max(row["runs"] for row in own.values())
        lines.append(f"| {level} | {runs} | {' | '.join(cells)} |")
    return lines


def _cell(row: Row) -> str:
    if row["psnr"] is None or row["psnr_on_black"] is None:
        return "failed"
    lost = f", {row['failure_rate']:.0%} fail" if row["failure_rate"] else ""
    spread = f" ({row['psnr_worst']:.2f} to {row['psnr_best']:.2f})" if row["runs"] > 1 else ""
    return f"{row['psnr']:.2f}{spread} / {row['psnr_on_black']:.2f}{lost}"


def _refined_cell(row: Row) -> str:
    return "" if row[REFINED] is None else f"{row['before']:.2f} to {row[REFINED]:.2f}"


def charts(found: Sequence[Trial], out: Path, wanted: Sequence[str] = ()) -> list[Path]:
    """One figure an axis (``wanted``: only these): both PSNR of every method, its worst run as a thin second
    line, with a gap where no run came out; under them the share of runs that fail."""
    written: list[Path] = []
    rows = summarised(found)
    for axis in dict.fromkeys(row["axis"] for row in rows):
        if wanted and axis not in wanted:
            continue
        own = [row for row in rows if row["axis"] == axis]
        levels = list(dict.fromkeys(row["level"] for row in own))
        titles = f"Stability: {axis}", ""
        panels = [
            Chart(title, axis, label, _lines(own, levels, column), ticks=levels, height=3.2)
            for title, (column, label) in zip(titles, _LABELS.items(), strict=True)
        ]
        failures = _failures(own, levels)
        panels.append(
            Chart("", axis, "runs that fail, %", failures, ticks=levels, bars=True, top=100, height=1.8)
        )
        name = "".join(c if c.isalnum() else "-" for c in axis.split(",")[0]).strip("-")
        written += draw(panels, out / f"stability-{name}", stacked=True)
    return written


def _lines(rows: Sequence[Row], levels: Sequence[str], column: str) -> list[Series]:
    series = []
    several = any(row["runs"] > 1 for row in rows)
    for method, color, places, own in _by_method(rows, levels):
        series.append(Series(method, places, [_plotted(row[column]) for row in own], color=color))
        if several:
            worst = [_plotted(row[f"{column}_worst"]) for row in own]
            series.append(Series(f"{method}, worst", places, worst, color=color, faint=True))
    if several:
        series.append(Series("worst run", [], [], marker="", color="#555555", dotted=True))
    return series


def _failures(rows: Sequence[Row], levels: Sequence[str]) -> list[Series]:
    return [
        Series(method, places, [100 * row["failure_rate"] for row in own], color=color)
        for method, color, places, own in _by_method(rows, levels)
    ]


def _by_method(
    rows: Sequence[Row], levels: Sequence[str]
) -> Iterator[tuple[str, str, list[float], list[Row]]]:
    """Every method's name, colour, places on the axis and rows there."""
    for name, color in zip((OURS, *BASELINES), PALETTE, strict=False):
        points = {row["level"]: row for row in rows if row["method"] == name}
        places = [place for place, level in enumerate(levels) if level in points]
        if points:
            yield name, color, [float(place) for place in places], [points[levels[p]] for p in places]


def _plotted(value: float | None) -> float:
    """A gap in the line where there is no value."""
    return math.nan if value is None else value
