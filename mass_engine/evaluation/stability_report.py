"""The tables and figures of ``mass-engine bench stability``."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mass_engine.evaluation.baselines import BASELINES
from mass_engine.evaluation.charts import PALETTE, Chart, Series, draw
from mass_engine.evaluation.heldout import REFINED

#: More than this lost is a failure, dB.
FAILURE = 3.0
OURS = "ours"
#: The axis of the clip as it is, the first place of every other axis.
UNCHANGED = "as it is"
_LABELS = {"psnr": "PSNR in the mask, dB", "psnr_on_black": "PSNR of the hand on black, dB"}


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
    refined_psnr: float | None = None
    seconds: float = 0.0
    error: str = ""


def summarised(found: Sequence[Trial]) -> list[dict[str, Any]]:
    """Mean, worst and failure rate of every axis, level and method over clips and seeds."""
    base = {(t.clip, t.method, t.seed): t for t in found if t.axis == UNCHANGED}
    rows = []
    for axis in axes_of(found):
        own_axis = [t for t in found if t.axis in (UNCHANGED, axis)]
        keys = [
            dict.fromkeys((t.value, t.level, t.method) for t in own_axis if t.axis == name)
            for name in dict.fromkeys((UNCHANGED, axis))
        ]
        for key in [
            *keys[0],
            *(key for part in keys[1:] for key in reversed(part)),
        ]:  # worst levels ran first
            own = [t for t in own_axis if (t.value, t.level, t.method) == key]
            failed = [t for t in own if _failed(t, base.get((t.clip, t.method, t.seed)))]
            rows.append(
                {
                    "axis": axis,
                    "value": key[0],
                    "level": key[1],
                    "method": key[2],
                    "runs": len(own),
                    "psnr": _mean([t.psnr for t in own]),
                    "psnr_worst": min((t.psnr for t in own if t.psnr is not None), default=None),
                    "psnr_on_black": _mean([t.psnr_on_black for t in own]),
                    "psnr_on_black_worst": min(
                        (t.psnr_on_black for t in own if t.psnr_on_black is not None), default=None
                    ),
                    "iou": _mean([t.iou for t in own]),
                    f"psnr_{REFINED}": _mean([t.refined_psnr for t in own]),
                    "failure_rate": len(failed) / len(own),
                }
            )
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
    """One table an axis: mean and worst in the mask, mean on black, and failures."""
    rows = summarised(found)
    methods = list(dict.fromkeys(row["method"] for row in rows))
    lines = [
        f"`{command}`: held-out frames: PSNR in the mask, mean (worst of several runs) / PSNR of the hand on "
        "black, mean, in dB; then the share of runs that fail (raise, are not finite, or lose more than "
        f"{FAILURE:g} dB of either).",
        "",
        *[f"- {note}" for note in notes],
        "",
    ]
    for axis in dict.fromkeys(row["axis"] for row in rows):
        lines += [
            f"**{axis}**",
            "",
            f"| level | runs | {' | '.join(methods)} |",
            "|---" * (len(methods) + 2) + "|",
        ]
        own = [row for row in rows if row["axis"] == axis]
        for level in dict.fromkeys(row["level"] for row in own):
            cells = []
            for method in methods:
                row = next((r for r in own if (r["level"], r["method"]) == (level, method)), None)
                cells.append(_cell(row))
            runs = max(row["runs"] for row in own if row["level"] == level)
            lines.append(f"| {level} | {runs} | {' | '.join(cells)} |")
        lines.append("")
    errors = dict.fromkeys(f"{t.axis}, {t.level}, {t.method}: {t.error}" for t in found if t.error)
    lines += [f"- {error}" for error in errors]
    return "\n".join(lines) + "\n"


def _cell(row: dict[str, Any] | None) -> str:
    if row is None:
        return ""
    if row["psnr"] is None or row["psnr_on_black"] is None:
        return "failed"
    lost = f", {row['failure_rate']:.0%} fail" if row["failure_rate"] else ""
    worst = f" ({row['psnr_worst']:.2f})" if row["runs"] > 1 else ""
    return f"{row['psnr']:.2f}{worst} / {row['psnr_on_black']:.2f}{lost}"


def charts(found: Sequence[Trial], out: Path, wanted: Sequence[str] = ()) -> list[Path]:
    """One figure an axis (``wanted``: only these): both PSNR of every method, its worst run as a thin second
    line; a cross where a run fails, at the bottom and with a gap in the line where none came out."""
    written: list[Path] = []
    rows = summarised(found)
    for axis in dict.fromkeys(row["axis"] for row in rows):
        if wanted and axis not in wanted:
            continue
        own = [row for row in rows if row["axis"] == axis]
        levels = list(dict.fromkeys(row["level"] for row in own))
        panels = [
            Chart(f"Stability: {axis}", axis, label, _series(own, levels, column), ticks=levels)
            for column, label in _LABELS.items()
        ]
        name = "".join(c if c.isalnum() else "-" for c in axis.split(",")[0]).strip("-")
        written += draw(panels, out / f"stability-{name}")
    return written


def _series(rows: Sequence[dict[str, Any]], levels: Sequence[str], column: str) -> list[Series]:
    order = (OURS, *BASELINES)
    series = []
    lowest = min((row[column] for row in rows if row[column] is not None), default=0.0)
    crosses: list[tuple[float, float]] = []
    for method in [name for name in order if any(row["method"] == name for row in rows)]:
        points = {row["level"]: row for row in rows if row["method"] == method}
        places = [float(place) for place, level in enumerate(levels) if level in points]
        own = [points[level] for level in levels if level in points]
        color = PALETTE[order.index(method)]
        series.append(Series(method, places, [_plotted(row[column]) for row in own], color=color))
        if any(row["runs"] > 1 for row in own):
            worst = [_plotted(row[f"{column}_worst"]) for row in own]
            series.append(Series(f"{method}, worst", places, worst, color=color, faint=True))
        for place, row in zip(places, own, strict=True):
            if row["failure_rate"]:
                crosses.append((place, lowest if row[column] is None else row[column]))
    if crosses:
        xs, ys = [x for x, _ in crosses], [y for _, y in crosses]
        failing = Series("a run fails", xs, ys, line=False, marker="x", color="#000000")
        series.append(failing)
    return series


def _plotted(value: float | None) -> float:
    """A gap in the line where there is no value."""
    return math.nan if value is None else value
