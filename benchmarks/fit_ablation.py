"""What each part of the method is worth: held-out scores without it.

``python benchmarks/fit_ablation.py VIDEO [--seeds 0 1 2] [--max-frames N] [--out FILE.json]``

"full" is every part of the method at one Loop level and one fractal depth, which is about what clips of
640x480 can show, with fewer visits than the preset. Stage one up to the conversion to surfels is the same
for all but "no pose refinement": it is run once a seed, and the others go on from its checkpoint.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import shutil
import statistics
import tempfile
import time
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from mass_engine.evaluation.arguments import add_refined_frames
from mass_engine.evaluation.heldout import REFINED, REFINED_LABEL, REFINED_METRIC, score_refined
from mass_engine.evaluation.scores import frames_of, heldout_means
from mass_engine.fitting.components import Components
from mass_engine.fitting.schedule import Schedule, schedule_for
from mass_engine.fitting.trainer import fit_hand
from mass_engine.options import FitOptions
from mass_engine.preprocess import Clip, prepare
from mass_engine.progress import ProgressMeter

VARIANTS = {
    "full": Components(),
    "no binding": Components(binding="none"),
    "binding as printed": Components(binding="paper"),
    "no densification": Components(densify=False),
    "no detached": Components(detached=False),
    "one Loop level fewer": Components(levels=0),
    "no deformation": Components(deform=False),
    "no pose refinement": Components(refine_pose=False),
}
SCORES = ("psnr_in_mask", "ms_ssim_hand_on_black", "silhouette_iou")


def reduced(parts: Components) -> Schedule:
    """Everything everywhere, with fewer visits."""
    whole = schedule_for("auto", parts)
    return replace(
        whole,
        deforming=tuple(replace(stage, visits=2) for stage in whole.deforming),
        appearance=tuple(
            replace(stage, visits=visits) for stage, visits in zip(whole.appearance, (1, 2), strict=True)
        ),
        adaptive=False,
    )


class _ConvertedError(Exception):
    """Stage one's registration is on disk."""


def run(
    clip: Clip, parts: Components, seed: int, checkpoint: Path, refined: int = 0, stop: bool = False
) -> dict[str, Any]:
    """One fit from ``checkpoint`` on (or up to the conversion): mean held-out scores, those of ``refined``
    frames after test-time pose refinement, surfels, seconds."""

    def progress(_: float, name: str) -> None:
        if stop and name == "conversion":
            raise _ConvertedError

    started = time.perf_counter()
    result = fit_hand(
        clip.views, clip.start, clip.model, clip.camera, reduced(parts), seed, progress, parts, checkpoint
    )
    seconds = round(time.perf_counter() - started, 1)
    held = [view for view in clip.views if view.heldout]
    return {
        **heldout_means(result.avatar, clip.views),
        REFINED: asdict(score_refined(frames_of(result.avatar, held), refined)),
        "surfels": result.avatar.skin.count,
        "seconds": seconds,
        "undone_steps": result.state.notes.get("undone_steps", 0),
        "stage_two": result.state.notes.get("stage_two"),
    }


def _refined(rows: list[dict[str, Any]]) -> str:
    if not rows[0][REFINED]["frames"]:
        return ""
    before, after = (
        statistics.mean(row[REFINED][kind][REFINED_METRIC] for row in rows)
        for kind in ("as_fitted", "metrics")
    )
    return f"{before:.2f} to {after:.2f}"


def main() -> None:
    """Run, print a table, write JSON."""
    parser = argparse.ArgumentParser()
    parser.add_argument("video", type=Path)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--max-frames", type=int, default=FitOptions.max_frames)
    add_refined_frames(parser, 4)
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    options = FitOptions(holdout=8, max_frames=arguments.max_frames)
    clip = prepare(arguments.video, options, ProgressMeter(lambda _: None), lambda *_: None)
    found: dict[str, list[dict[str, Any]]] = {name: [] for name in VARIANTS}
    for seed in arguments.seeds:
        with tempfile.TemporaryDirectory() as folder:
            base = Path(folder) / "registered"
            with contextlib.suppress(_ConvertedError):
                run(clip, Components(), seed, base, stop=True)
            for name, parts in VARIANTS.items():
                own = Path(folder) / "own"
                own.unlink(missing_ok=True)
                if parts.refine_pose:
                    shutil.copy(base, own)
                found[name].append(run(clip, parts, seed, own, arguments.refined_frames))
                print(seed, name, found[name][-1], flush=True)
    print(
        f"| variant | PSNR in mask | spread | MS-SSIM | IoU | surfels | {REFINED_METRIC} {REFINED_LABEL} |\n"
        f"{'|---' * 7}|"
    )
    for name, rows in found.items():
        psnr, ssim, iou = ([row[score] for row in rows] for score in SCORES)
        spread = max(psnr) - min(psnr)
        print(
            f"| {name} | {statistics.mean(psnr):.2f} | {spread:.2f} | {statistics.mean(ssim):.4f} "
            f"| {statistics.mean(iou):.4f} | {rows[0]['surfels']} | {_refined(rows)} |"
        )
    if arguments.out is not None:
        arguments.out.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
