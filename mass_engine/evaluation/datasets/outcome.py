"""What an evaluation on a data set gives: our rows beside the paper's, as JSON and as a Markdown table."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from mass_engine.errors import EngineError
from mass_engine.evaluation.datasets.paper import METRICS, PaperRow
from mass_engine.evaluation.heldout import REFINED_LABEL, HeldoutScores, number
from mass_engine.evaluation.lpips import LpipsSet
from mass_engine.evaluation.scores import mean_scores
from mass_engine.pipeline import FitOutcome
from mass_engine.tracking.tracks import write_tracks

Tell = Callable[[str], None]


@dataclass(frozen=True)
class EvalOptions:
    """What a user may choose about an evaluation on a data set.

    ``root`` holds the data as distributed; ``out`` is where runs and results go; ``mano`` is the user's MANO
    of the right hand (or the left one, with ``side`` left); ``sequences`` name the parts of the data set
    (none: all that are found); ``views``: of InterHand2.6M only.
    """

    root: Path
    out: Path
    mano: Path | None = None
    sequences: tuple[str, ...] = ()
    side: str = "right"
    preset: str = "auto"
    seed: int = 0
    max_frames: int = 160
    views: int = 40
    tracks: str | None = None
    masks: Path | None = None
    lpips: LpipsSet = field(default_factory=lambda: LpipsSet({}))
    refine: bool = True


@dataclass(frozen=True)
class OurRow:
    """One clip: how many frames were fitted and scored, and the scores of both kinds."""

    clip: str
    fitted: int
    scores: HeldoutScores
    views: int | None = None
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class DatasetResult:
    """``protocol`` says in sentences what was done; ``columns`` is which of our metrics stands in each of the
    paper's columns (:data:`METRICS`)."""

    name: str
    protocol: tuple[str, ...]
    columns: dict[str, str]
    paper: Sequence[PaperRow]
    ours: Sequence[OurRow]

    def markdown(self) -> str:
        """The table, under what was done."""
        shown = [metric for metric in METRICS if metric in self.columns]
        lines = [f"# {self.name}", "", *[f"- {sentence}" for sentence in self.protocol], ""]
        lines += [
            "Columns of ours: " + ", ".join(f"{metric} is `{self.columns[metric]}`" for metric in shown)
            + ". The paper does not state its conventions.",
            "",
            "| clip | method | views | frames scored | " + " | ".join(shown) + " |",
            "|---|---|---|---|" + "---|" * len(shown),
        ]  # fmt: skip
        for row in self.paper:
            cells = [number(getattr(row, metric), 4) for metric in shown]
            cells = ["" if getattr(row, m) is None else c for m, c in zip(shown, cells, strict=True)]
            lines.append(f"| {row.clip} | {row.method} | {row.views or ''} | | " + " | ".join(cells) + " |")
        for own in self.ours:
            for label, rows in (
                ("ours", own.scores.as_fitted),
                (f"ours, {REFINED_LABEL}", own.scores.refined),
            ):
                if not rows:
                    continue
                means = mean_scores(rows)
                cells = [number(means.get(self.columns[metric]), 4) for metric in shown]
                lines.append(
                    f"| {own.clip} | {label} | {own.views or ''} | {len(rows)} | " + " | ".join(cells) + " |"
                )
        for own in self.ours:
            lines += [f"- {own.clip}: {note}" for note in own.notes]
        return "\n".join(lines) + "\n"

    def summary(self) -> dict[str, Any]:
        """Everything, for JSON."""
        return {
            "dataset": self.name,
            "protocol": list(self.protocol),
            "columns": self.columns,
            "paper": [asdict(row) for row in self.paper],
            "ours": [
                {
                    "clip": row.clip,
                    "views": row.views,
                    "fitted": row.fitted,
                    "notes": list(row.notes),
                    **row.scores.summary(),
                }
                for row in self.ours
            ],
        }

    def write(self, out: Path) -> None:
        """OUT/results.json and OUT/results.md."""
        out.mkdir(parents=True, exist_ok=True)
        (out / "results.json").write_text(json.dumps(self.summary(), indent=2) + "\n")
        (out / "results.md").write_text(self.markdown())


def save_fit(outcome: FitOutcome, folder: Path) -> None:
    """The avatar, its tracks and the fit's report, as ``mass-engine fit`` names them."""
    outcome.avatar.save(folder)
    write_tracks([outcome.tracks], folder / "tracks.json")
    outcome.report.write(folder)


def missing(name: str, problem: str, layout: str) -> EngineError:
    """The error for a folder that is not the data set."""
    return EngineError(
        "eval.dataset", f"This is not {name} as distributed: {problem}.", f"Expected {layout}."
    )


def needs_mano(name: str) -> EngineError:
    """The error for poses without the hand they are of."""
    return EngineError(
        "eval.needs_mano",
        f"{name}'s poses are MANO's, and MANO cannot come with this program.",
        "Give your own with --mano MANO_RIGHT.pkl (MANO_LEFT.pkl with --side left).",
    )
