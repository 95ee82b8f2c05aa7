"""``mass-engine bench clips RUN...``: the best score of every clip among any runs, as bars."""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mass_engine.errors import BadArgumentError
from mass_engine.evaluation.charts import draw_bars
from mass_engine.evaluation.heldout import FILE_NAME, REFINED, REFINED_LABEL, read_report


def best_by_clip(runs: Sequence[Path], metric: str) -> dict[str, dict[str, float]]:
    """The best ``metric`` of every clip: of held-out frames, and after test-time pose refinement where
    ``mass-engine eval RUN`` has been. Runs without held-out frames are left out.

    Raises BadArgumentError ``eval.no_run``, ``bench.metric``.
    """
    found: dict[str, dict[str, float]] = {}
    known: set[str] = set()
    for run in runs:
        report = read_report(run)
        path = run / FILE_NAME
        evaluation: dict[str, Any] = json.loads(path.read_text()) if path.is_file() else {}
        if not evaluation and report.get("scored_frames", {}).get("kind") != "heldout":
            continue
        first = evaluation.get("metrics") or report.get("metrics", {})
        second = evaluation.get(REFINED, {}).get("metrics", {})
        known |= first.keys()
        name = Path(str(report["video"].get("name", run.name))).stem
        clip = run.resolve().name if name == "video" else name  # data sets name their folder
        for label, metrics in (("held out", first), (REFINED_LABEL, second)):
            value = metrics.get(metric)
            if value is not None and value > found.get(clip, {}).get(label, -math.inf):
                found.setdefault(clip, {})[label] = float(value)
    if known and metric not in known:
        raise BadArgumentError("bench.metric", f"No run has {metric}.", f"Use {', '.join(sorted(known))}.")
    return dict(sorted(found.items()))


def run(rest: Sequence[str]) -> None:
    """The command."""
    parser = argparse.ArgumentParser(prog="mass-engine bench clips", description=__doc__)
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN")
    parser.add_argument("--metric", default="psnr_hand_on_black")
    parser.add_argument("--out", type=Path, default=Path("bench-clips"))
    arguments = parser.parse_args(rest)
    values = best_by_clip(arguments.runs, arguments.metric)
    if not values:
        raise BadArgumentError("bench.no_holdout", "No run held frames out.", "Fit with --holdout 8, say.")
    labels = list(dict.fromkeys(label for group in values.values() for label in group))
    lines = [f"Best {arguments.metric} of every clip.", "", "| clip | " + " | ".join(labels) + " |"]
    lines.append("|---|" + "---|" * len(labels))
    for clip, group in values.items():
        cells = [f"{group[label]:.3f}" if label in group else "" for label in labels]
        lines.append(f"| {clip} | " + " | ".join(cells) + " |")
    out: Path = arguments.out
    out.mkdir(parents=True, exist_ok=True)
    (out / "clips.md").write_text("\n".join(lines) + "\n")
    (out / "clips.json").write_text(
        json.dumps({"metric": arguments.metric, "clips": values}, indent=2) + "\n"
    )
    print("\n".join(lines))
    for path in draw_bars(f"Best {arguments.metric} of each clip", arguments.metric, values, out / "clips"):
        print(f"wrote {path}")
