"""`mass-engine bench raster`: how fast the rasteriser is, next to its yardsticks, measured in one run.

The scene is the built-in hand in a pose, its surface covered by two layers of surfels as an avatar's
attached and detached ones lie. Times are medians of interleaved repetitions with their quartiles.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import torch

from mass_engine.camera import Camera
from mass_engine.evaluation import raster_cuda, raster_profile
from mass_engine.evaluation.raster_scene import Scene, hand_camera, hand_scene
from mass_engine.evaluation.timing import Step, Timing, forward_step, measure, training_step
from mass_engine.raster import RasterOptions
from mass_engine.raster import cpu as cpu_backend
from mass_engine.raster._kernels import instruction_sets

SIZES = ((256, 256), (512, 334), (700, 500), (1400, 1000))
#: The paper's counts: 1538 faces, one or two Loop levels, two layers, with and without densification.
COUNTS = (12_304, 49_216, 196_864)


def _variants(scene: Scene, camera: Camera, args: argparse.Namespace) -> dict[str, Step]:
    color, everything = (
        RasterOptions(threads=args.threads),
        RasterOptions(outputs="all", threads=args.threads),
    )
    culled = RasterOptions(cull_backfaces=True, threads=args.threads)
    steps = {
        "forward": forward_step(scene, camera, color),
        "forward culled": forward_step(scene, camera, culled),
        "forward all": forward_step(scene, camera, everything),
        "fwd+bwd": training_step(scene, camera, color),
        "fwd+bwd all": training_step(scene, camera, everything),
    }
    for name in args.instruction_sets:
        options = replace(color, instruction_set=name, threads=1 if name == "scalar" else args.threads)
        label = name + (" 1 thread" if name == "scalar" else "")
        steps[f"forward {label}"] = forward_step(scene, camera, options)
        steps[f"fwd+bwd all {label}"] = training_step(scene, camera, replace(options, outputs="all"))
    return steps


def run(argv: Sequence[str]) -> int:
    """Entry point; prints Markdown tables and, with ``--out``, writes the figures as JSON."""
    parser = argparse.ArgumentParser(prog="mass-engine bench raster", description=__doc__)
    parser.add_argument("--counts", type=int, nargs="+", default=list(COUNTS), metavar="N")
    parser.add_argument("--sizes", nargs="+", default=[f"{w}x{h}" for w, h in SIZES], metavar="WxH")
    parser.add_argument("--seconds", type=float, default=1.0, help="time per figure")
    parser.add_argument("--threads", type=int, default=None)
    parser.add_argument("--instruction-sets", nargs="*", default=["scalar"], choices=instruction_sets())
    parser.add_argument("--reference", action="store_true", help="also time the torch reference (minutes)")
    parser.add_argument("--ablate", action="store_true", help="what each optimisation is worth instead")
    parser.add_argument("--profile", action="store_true", help="where the time goes instead, and the floor")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--out", type=Path, default=None, help="JSON file")
    args = parser.parse_args(argv)
    if args.device == "cuda":
        return _run_cuda(args)

    threads = args.threads or cpu_backend.available_threads()
    print(f"{cpu_backend.shared_renderer().instruction_set}, {threads} threads; median ms [quartiles]\n")
    rows: list[Row] = []
    header: list[str] = []
    for count in args.counts:
        scene = hand_scene(count)
        for size in args.sizes:
            width, height = (int(x) for x in size.split("x"))
            camera = hand_camera(scene, width, height)
            if args.profile:
                print(raster_profile.report(scene, camera, threads))
                continue
            if args.ablate:
                timings = measure(raster_profile.ablations(scene, camera, threads), args.seconds)
                print(f"{count} surfels, {size}\n")
                print(raster_profile.ablation_table(timings), flush=True)
            else:
                timings = measure(_variants(scene, camera, args), args.seconds)
                if args.reference:
                    slow = forward_step(scene, camera, RasterOptions(backend="reference"))
                    timings |= measure({"forward reference": slow}, 0.0)
                if list(timings) != header:
                    header = list(timings)
                    print("| surfels | size | " + " | ".join(header) + " |")
                    print("|---" * (len(header) + 2) + "|")
                print(f"| {count} | {size} | " + " | ".join(map(str, timings.values())) + " |", flush=True)
            rows += [_row(count, size, name, timing) for name, timing in timings.items()]
    _write(args.out, {"threads": threads}, rows)
    return 0


def _write(path: Path | None, where: dict[str, object], rows: list[Row]) -> None:
    if path:
        text = {**where, "torch": torch.__version__, "rows": [asdict(row) for row in rows]}
        path.write_text(json.dumps(text, indent=1) + "\n")


def _run_cuda(args: argparse.Namespace) -> int:
    """The same scenes on a GPU. Raises ``EngineError`` ``device.unavailable``."""
    device = raster_cuda.require()
    name = torch.cuda.get_device_name()
    print(f"{name}; median ms [quartiles], peak MiB\n")
    rows: list[Row] = []
    for count in args.counts:
        on_cpu = hand_scene(count)
        scene = on_cpu.to(device)
        for size in args.sizes:
            width, height = (int(x) for x in size.split("x"))
            camera = hand_camera(on_cpu, width, height)
            moved = Camera(camera.K.to(device), camera.world_to_camera.to(device), width, height)
            steps, pairs = raster_cuda.variants(scene, moved)
            figures = raster_cuda.measure(steps | raster_cuda.gsplat_variants(scene, moved), args.seconds)
            print(f"{count} surfels, {size}, {pairs} pairs of surfel and tile\n")
            print("| | ms | peak MiB |\n|---|---|---|")
            for what, figure in figures.items():
                print(f"| {what} | {figure.timing} | {figure.peak_bytes / 2**20:.0f} |")
                rows.append(_row(count, size, what, figure.timing, figure.peak_bytes))
            print("\n" + raster_cuda.floor(on_cpu, camera, pairs), flush=True)
    _write(args.out, {"device": name}, rows)
    return 0


@dataclass(frozen=True)
class Row:
    """One figure of the JSON file; times in milliseconds."""

    surfels: int
    size: str
    what: str
    median_ms: float
    quartiles_ms: tuple[float, float]
    repetitions: int
    peak_bytes: int | None = None  # of device memory


def _row(surfels: int, size: str, what: str, timing: Timing, peak_bytes: int | None = None) -> Row:
    return Row(surfels, size, what, timing.median, timing.quartiles, timing.repetitions, peak_bytes)


if __name__ == "__main__":
    sys.exit(run(sys.argv[1:]))
