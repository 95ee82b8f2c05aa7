"""How much a fit depends on chance and on where it starts.

``python benchmarks/fit_stability.py VIDEO seeds [--count 12]``
``python benchmarks/fit_stability.py VIDEO noise [--radians 0 0.1 0.2 0.3] [--count 3]``

Reduced fits (preset ``auto``, ``--max-frames`` 48): held-out scores over seeds, or with noise of that
standard deviation on every number of the start poses' joint rotations (axis-angle, the wrist's too).
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from mass_engine.evaluation.scores import heldout_means
from mass_engine.fitting.schedule import schedule_for
from mass_engine.fitting.trainer import fit_hand
from mass_engine.options import FitOptions
from mass_engine.preprocess import Clip, prepare
from mass_engine.progress import ProgressMeter


def run(clip: Clip, seed: int, radians: float) -> dict[str, Any]:
    """One fit: mean held-out scores and seconds."""
    random = torch.Generator().manual_seed(1000 + seed)

    def shaken(values: torch.Tensor) -> torch.Tensor:
        return values + radians * torch.randn(values.shape, generator=random)

    pose = clip.start
    start = replace(pose, global_orient=shaken(pose.global_orient), hand_pose=shaken(pose.hand_pose))
    started = time.perf_counter()
    result = fit_hand(clip.views, start, clip.model, clip.camera, schedule_for("auto"), seed, lambda *_: None)
    finite = all(bool(torch.isfinite(value).all()) for value in vars(result.avatar.appearance).values())
    return {
        "seed": seed,
        "radians": radians,
        **heldout_means(result.avatar, clip.views),
        "finite": finite,
        "undone_steps": result.state.notes.get("undone_steps", 0),
        "surfels": result.avatar.skin.count,
        "seconds": round(time.perf_counter() - started, 1),
    }


def main() -> None:
    """Run, print, write JSON."""
    parser = argparse.ArgumentParser()
    parser.add_argument("video", type=Path)
    parser.add_argument("what", choices=("seeds", "noise"))
    parser.add_argument("--radians", type=float, nargs="+", default=[0.0, 0.1, 0.2, 0.3])
    parser.add_argument("--count", type=int, default=12)
    parser.add_argument("--max-frames", type=int, default=48)
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    options = FitOptions(holdout=8, max_frames=arguments.max_frames)
    clip = prepare(arguments.video, options, ProgressMeter(lambda _: None), lambda *_: None)
    rows = []
    for radians in arguments.radians if arguments.what == "noise" else [0.0]:
        for seed in range(arguments.count):
            rows.append(run(clip, seed, radians))
            print(rows[-1], flush=True)
    print(f"| noise, rad | fits | PSNR in mask, mean | worst | spread | MS-SSIM |\n{'|---' * 6}|")
    for radians in sorted({row["radians"] for row in rows}):
        these = [row for row in rows if row["radians"] == radians]
        psnr = [row["psnr_in_mask"] for row in these]
        ssim = [row["ms_ssim_hand_on_black"] for row in these]
        print(
            f"| {radians} | {len(these)} | {sum(psnr) / len(psnr):.2f} | {min(psnr):.2f} "
            f"| {max(psnr) - min(psnr):.2f} | {sum(ssim) / len(ssim):.4f} |"
        )
    if arguments.out is not None:
        arguments.out.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
