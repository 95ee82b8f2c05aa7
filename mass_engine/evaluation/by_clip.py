"""``mass-engine bench clips RUN...``: the best score of every clip among any runs, as bars."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from mass_engine.errors import BadArgumentError
from mass_engine.evaluation.charts import draw_bars
from mass_engine.evaluation.heldout import FILE_NAME, REFINED, REFINED_LABEL, read_report
from mass_engine.evaluation.results_file import write_text

#: Videos that data sets write, each into a folder named after the clip.
_UNNAMED = ("video", "pictures")


@dataclass(frozen=True)
class Best:
    """The best run of one clip: its folder, and its figures by name."""

    run: str
    figures: dict[str, float]


def best_by_clip(runs: Sequence[Path], metric: str) -> dict[str, Best]:
    """The run with the best ``metric`` on the held-out frames of every clip, with its figure after test-time
    pose refinement where ``mass-engine eval RUN`` has been. Runs without held-out frames are left out.

    Raises BadArgumentError ``eval.no_run``, ``bench.metric``.
    """
    found: dict[str, Best] = {}
    known: set[str] = set()
    for run in runs:
        report, evaluation = read_report(run), _evaluation(run)
        if not evaluation and report.get("scored_frames", {}).get("kind") != "heldout":
            continue
        first = evaluation.get("metrics") or report.get("metrics", {})
        second = evaluation.get(REFINED, {}).get("metrics", {})
        known |= first.keys()
        name = Path(str(report["video"].get("name", run.name))).stem
        clip = run.resolve().name if name in _UNNAMED else name
        figures = {"held out": first.get(metric), REFINED_LABEL: second.get(metric)}
        value = figures["held out"]
        if value is None or (clip in found and value <= found[clip].figures["held out"]):
            continue
        found[clip] = Best(str(run), {label: v for label, v in figures.items() if v is not None})
    if known and metric not in known:
        raise BadArgumentError("bench.metric", f"No run has {metric}.", f"Use {', '.join(sorted(known))}.")
    return dict(sorted(found.items()))


def _evaluation(run: Path) -> dict[str, Any]:
    """RUN/evaluation.json; nothing where there is none."""
    path = run / FILE_NAME
    try:
        return dict(json.loads(path.read_text())) if path.is_file() else {}
    except ValueError as error:
        raise BadArgumentError(
            "eval.no_run", f"{path} is no evaluation ({error}).", "Make it again with mass-engine eval RUN."
        ) from error


def run(rest: Sequence[str]) -> None:
    """The command."""
    parser = argparse.ArgumentParser(prog="mass-engine bench clips", description=__doc__)
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN")
    parser.add_argument("--metric", default="psnr_hand_on_black")
    parser.add_argument("--out", type=Path, default=Path("bench-clips"))
    arguments = parser.parse_args(rest)
    metric: str = arguments.metric
    found = best_by_clip(arguments.runs, metric)
    if not found:
        raise BadArgumentError("bench.no_holdout", "No run held frames out.", "Fit with --holdout 8, say.")
    labels = list(dict.fromkeys(label for best in found.values() for label in best.figures))
    lines = [f"Best {metric} of every clip.", "", f"| clip | {' | '.join(labels)} | run |"]
    lines.append("|---" * (len(labels) + 2) + "|")
    for clip, best in found.items():
        cells = [f"{best.figures[label]:.3f}" if label in best.figures else "" for label in labels]
        lines.append(f"| {clip} | {' | '.join(cells)} | {best.run} |")
    out: Path = arguments.out
    out.mkdir(parents=True, exist_ok=True)
    write_text(out / "clips.md", "\n".join(lines) + "\n")
    data = {"metric": metric, "clips": {clip: asdict(best) for clip, best in found.items()}}
    write_text(out / "clips.json", json.dumps(data, indent=2) + "\n")
    print("\n".join(lines))
    values = {clip: best.figures for clip, best in found.items()}
    for path in draw_bars(f"Best {metric} of each clip", metric, values, out / "clips"):
        print(f"wrote {path}")
