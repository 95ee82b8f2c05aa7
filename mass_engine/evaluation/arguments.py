"""What ``mass-engine eval`` and ``mass-engine report`` take. No heavy import: --help must be quick."""

from __future__ import annotations

import argparse
from pathlib import Path

from mass_engine.errors import BadArgumentError
from mass_engine.options import PRESETS

DATASETS = ("arctic", "interhand", "hand-appearance")


def add_refined_frames(parser: argparse.ArgumentParser, default: int) -> None:
    """``--refined-frames`` of whatever scores held-out frames.

    Given a number below 0 the parser raises BadArgumentError ``options.invalid``.
    """
    parser.add_argument("--refined-frames", type=_refined_frames, default=default, metavar="N",
        help="held-out frames scored once more after test-time pose refinement, seconds each (default: "
        "%(default)s; 0: none)")  # fmt: skip


def _refined_frames(text: str) -> int:
    count = int(text)
    if count < 0:
        raise BadArgumentError("options.invalid", "--refined-frames is below 0.", "Use 0 for none.")
    return count


def add_eval_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``mass-engine eval TARGET``."""
    add = parser.add_argument
    add("target", metavar="RUN|" + "|".join((*DATASETS, "synthetic")), help="what to score")
    add("--video", type=Path, help="RUN: the video it was fitted to")
    add("--masks", type=Path, metavar="DIR", help="masks as for fit")
    add("--root", type=Path, metavar="DIR", help="a data set as distributed")
    add("--mano", type=Path, metavar="FILE", help="data sets: your MANO_RIGHT.pkl (or left, with --side)")
    add("--sequence", action="append", default=[], metavar="NAME", help="only this part; may be repeated")
    add("--side", choices=("right", "left"), default="right", help="arctic: which hand")
    add("--tracks", metavar="[KIND:]PATH", help="arctic: other poses than the data set's, as for fit")
    add("--views", type=int, default=40, metavar="N", help="interhand: training cameras")
    add("--preset", choices=PRESETS, default="auto")
    add("--seed", type=int, default=0)
    add("--max-frames", type=int, default=160, metavar="N")
    add("--lpips", action="append", type=Path, default=[], metavar="FILE",
        help="your LPIPS weights, one file a network (see the README); without: not computed")  # fmt: skip
    add("--no-refine", action="store_true", help="leave out the figure after test-time pose refinement")
    add("--quick", action="store_true", help="synthetic: few small frames and the draft preset")
    add("--out", type=Path, metavar="DIR", help="where results go (RUN: into the run itself)")
