"""``mass-engine eval``: from arguments to an evaluation and a table on the terminal."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from mass_engine.errors import BadArgumentError
from mass_engine.evaluation.arguments import DATASETS
from mass_engine.evaluation.datasets import arctic, hand_appearance, interhand
from mass_engine.evaluation.datasets.outcome import EvalOptions
from mass_engine.evaluation.heldout import FILE_NAME, evaluate_run
from mass_engine.evaluation.lpips import LpipsSet
from mass_engine.evaluation.synthetic import benchmark
from mass_engine.evaluation.synthetic.benchmark import SyntheticOptions


def tell(text: str) -> None:
    """Progress and notes, beside the result."""
    print(text, file=sys.stderr, flush=True)


def evaluate(arguments: argparse.Namespace) -> None:
    """Run one evaluation. Raises BadArgumentError ``eval.*`` and whatever a fit raises."""
    lpips = LpipsSet.load(arguments.lpips)
    if arguments.target in DATASETS:
        _dataset(arguments, lpips)
    elif arguments.target == "synthetic":
        out = arguments.out or Path("eval-synthetic")
        options = SyntheticOptions(
            out,
            tuple(arguments.sequence),
            arguments.preset,
            arguments.seed,
            arguments.quick,
            lpips,
            not arguments.no_refine,
        )
        print(benchmark.markdown(benchmark.run(options, tell), options))
        print(f"wrote {out / 'results.md'}")
    else:
        run = Path(arguments.target)
        if arguments.video is None:
            raise BadArgumentError(
                "eval.needs_video",
                "A run does not hold the pictures it is scored against.",
                "Give the video it was fitted to with --video.",
            )
        scores = evaluate_run(run, arguments.video, arguments.masks, lpips, not arguments.no_refine, tell)
        print(scores.markdown())
        print(f"wrote {run / FILE_NAME}")


def _dataset(arguments: argparse.Namespace, lpips: LpipsSet) -> None:
    name = arguments.target
    if arguments.root is None:
        raise BadArgumentError("eval.needs_root", f"Where is {name}?", "Give its folder with --root.")
    if arguments.views < 1 or arguments.max_frames < 2:
        raise BadArgumentError("eval.invalid", "--views or --max-frames is too small.", "Use 10 or more.")
    out = arguments.out or Path(f"eval-{name}")
    options = EvalOptions(
        arguments.root,
        out,
        arguments.mano,
        tuple(arguments.sequence),
        arguments.side,
        arguments.preset,
        arguments.seed,
        arguments.max_frames,
        arguments.views,
        arguments.tracks,
        arguments.masks,
        lpips,
        not arguments.no_refine,
    )
    run = {"arctic": arctic, "interhand": interhand, "hand-appearance": hand_appearance}[name]
    result = run.evaluate(options, tell)
    result.write(out)
    print(result.markdown())
    print(f"wrote {out / 'results.md'}")
