"""``mass-engine bench fit``: where the time of a fit goes, on this machine."""

from __future__ import annotations

import argparse
import itertools
import json
import os
import platform
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from tempfile import TemporaryDirectory

from mass_engine.device import DEVICES
from mass_engine.evaluation.arguments import add_refined_frames
from mass_engine.evaluation.demo_clip import ClipOptions, demo_frames
from mass_engine.evaluation.heldout import REFINED_LABEL, REFINED_METRIC, RefinedScores, number, score_refined
from mass_engine.evaluation.scores import frames_of
from mass_engine.fitting.report import FitReport
from mass_engine.options import PRECISIONS, PRESETS, FitOptions
from mass_engine.pipeline import fit
from mass_engine.video.writer import write_video


def run(argv: Sequence[str]) -> None:
    """Fit each video (or the demo clip) with each preset and print Markdown tables."""
    parser = argparse.ArgumentParser(prog="mass-engine bench fit")
    parser.add_argument(
        "videos", type=Path, nargs="*", metavar="VIDEO", help="default: the made-up demo clip"
    )
    parser.add_argument("--preset", choices=PRESETS, nargs="+", default=["auto"])
    parser.add_argument("--holdout", type=int, default=8)
    add_refined_frames(parser, 4)
    parser.add_argument("--max-frames", type=int, default=FitOptions.max_frames)
    parser.add_argument("--device", choices=DEVICES, default="auto")
    parser.add_argument(
        "--precision",
        choices=PRECISIONS,
        nargs="+",
        default=["float32"],
        help="of the matrix products on a GPU: each in turn, for its seconds and its dB",
    )
    parser.add_argument("--out", type=Path, metavar="FILE.json", help="the whole reports")
    arguments = parser.parse_args(argv)
    with TemporaryDirectory() as folder:
        videos: list[Path] = list(arguments.videos)
        if not videos:
            videos = [Path(folder) / "demo.mp4"]
            write_video(videos[0], demo_frames(), ClipOptions().fps)
        reports = []
        print(f"{platform.machine()}, {os.cpu_count()} cores\n", flush=True)
        for video in videos:
            for preset, precision in itertools.product(arguments.preset, arguments.precision):
                options = FitOptions(
                    preset=preset,
                    holdout=arguments.holdout,
                    max_frames=arguments.max_frames,
                    device=arguments.device,
                    precision=precision,
                )
                outcome = fit(video, options)
                held = [view for view in outcome.clip.views if view.heldout]
                # After the fit, whose seconds these are not.
                again = score_refined(frames_of(outcome.avatar, held), arguments.refined_frames)
                reports.append(replace(outcome.report, after_test_time_pose_refinement=asdict(again)))
                _print(reports[-1], preset if precision == "float32" else f"{preset}, {precision}")
    if arguments.out is not None:
        arguments.out.write_text(json.dumps([asdict(report) for report in reports], indent=1) + "\n")


def _print(report: FitReport, preset: str) -> None:
    parts: dict[str, float] = report.fit["seconds"]
    registration = sum(seconds for name, seconds in parts.items() if name.startswith("stage 1, texture"))
    rows = {
        **{name: seconds for name, seconds in report.seconds.items() if name != "fit"},
        **{name: seconds for name, seconds in parts.items() if not name.startswith("stage 1, texture")},
        "stage 1, texture": registration,
    }
    total = sum(report.seconds.values())
    on_gpu = report.machine.get("gpu_peak_memory_bytes")
    if on_gpu is not None:
        print(f"{report.machine['gpu']}: {on_gpu / 2**30:.2f} GiB of its memory at most\n")
    print(
        f"{report.video['name']}, {preset}: {len(report.frames['fitted'])} frames fitted, "
        f"{report.surfels['kept']} surfels, {total:.0f} s of which the fit {report.seconds['fit']:.0f} s, "
        f"{report.peak_memory_bytes / 2**30:.2f} GiB, "
        f"PSNR in mask {number(report.metrics['psnr_in_mask'], 2)} dB, "
        f"MS-SSIM {number(report.metrics['ms_ssim_hand_on_black'], 4)} ({report.scored_frames['kind']})\n"
    )
    again = RefinedScores(**report.after_test_time_pose_refinement)
    if again.frames:
        print(f"{REFINED_METRIC} of {len(again.frames)} of them {REFINED_LABEL}: {again.cell()} dB\n")
    print("| part | seconds |\n|---|---|")
    for name, seconds in rows.items():
        print(f"| {name} | {seconds:.1f} |")
    print(flush=True)
