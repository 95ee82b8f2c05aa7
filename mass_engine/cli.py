"""The command line.

Exit codes: 0 done, 2 bad arguments, 3 unusable input, 4 internal failure, 5 a device's memory did not suffice
(the same at a smaller setting may do), 130 interrupted.
"""

from __future__ import annotations

import argparse
import json
import signal
import sys
import traceback
from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path
from types import FrameType

from mass_engine.device import DEVICES, memory_error
from mass_engine.errors import OUT_OF_MEMORY, BadArgumentError, EngineError
from mass_engine.evaluation.arguments import add_eval_arguments
from mass_engine.fitting.components import BINDINGS, Components
from mass_engine.options import PRECISIONS, PRESETS, SEGMENTERS, SIDES, FitOptions
from mass_engine.progress import FIT_STAGES, Progress

#: Parts of the method that ``--no-...`` switches off.
COMPONENT_SWITCHES = {
    "densify": "no fractal surfels in the corners of faces",
    "detached": "no surfels that leave the mesh",
    "deform": "no network that moves and masks the detached surfels",
    "refine_pose": "the tracker's poses, the template's shape",
    "shading": "no light: one colour from every side",
    "harmonics": "no view-dependent colour",
    "settle": "attached surfels stay where the mesh has them",
}

#: ``mass-engine bench NAME``: the module whose ``run`` takes the rest of the line.
BENCHMARKS = {
    "raster": "bench_raster",
    "render": "bench_render",
    "fit": "bench_fit",
    "pareto": "pareto",
    "stability": "stability",
    "needed": "needed",
    "clips": "by_clip",
}

#: The exit code of ``device.out_of_memory``.
EXIT_OUT_OF_MEMORY = 5

Command = Callable[[argparse.Namespace], None]


def build_parser() -> argparse.ArgumentParser:
    """The parser of ``mass-engine``; every sub-command sets ``run``."""
    parser = argparse.ArgumentParser(
        prog="mass-engine", description="A phone video in, a posable hand of 2-D Gaussian surfels out."
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    fit = commands.add_parser("fit", help="fit an avatar to a video")
    fit.add_argument("video", type=Path)
    fit.add_argument("--out", type=Path, required=True, metavar="RUN")
    fit.add_argument(
        "--template",
        default="builtin",
        metavar="builtin|mano:FILE|gltf:FILE",
        help="the hand to start from; after the file ,tips=manopth or ,joints=MAP.json or ,side=left",
    )
    fit.add_argument(
        "--tracks",
        metavar="[KIND:]PATH",
        help="use these poses, do not track: tracks.json, or another program's (wilor:, hamer:, arctic:, "
        "harp:); after the path ,mano=FILE or ,offset=N or ,undistorted=yes",
    )
    fit.add_argument(
        "--masks",
        type=Path,
        metavar="DIR",
        help="DIR/%%06d.png: 0 background, 128 ignore, 255 hand; for both hands DIR/right/ and DIR/left/",
    )
    fit.add_argument(
        "--side",
        choices=SIDES,
        default="auto",
        help="which hand; both: a person's two hands, as RUN/right and RUN/left",
    )
    fit.add_argument(
        "--segmenter", choices=SEGMENTERS, default="colors", help="how masks are made; sam-hq is an extra"
    )
    fit.add_argument("--segmenter-weights", type=Path, metavar="FILE", help="your SAM-HQ checkpoint")
    fit.add_argument("--preset", choices=PRESETS, default="auto")
    fit.add_argument(
        "--holdout", type=int, default=0, metavar="N", help="keep every N-th frame out of the fit"
    )
    fit.add_argument(
        "--refined-frames",
        type=int,
        default=0,
        metavar="N",
        help="score so many held-out frames once more after test-time pose refinement, seconds each",
    )
    fit.add_argument("--seed", type=int, default=0)
    fit.add_argument("--device", choices=DEVICES, default="auto")
    fit.add_argument(
        "--precision", choices=PRECISIONS, default=FitOptions.precision, help="of matrix products on a GPU"
    )
    fit.add_argument("--fov", type=float, metavar="DEGREES", help="field of view of the longer image side")
    fit.add_argument("--max-frames", type=int, default=FitOptions.max_frames, metavar="N")
    fit.add_argument("--resume", action="store_true", help="go on with the killed fit in RUN")
    fit.add_argument(
        "--from-stage",
        choices=tuple(FIT_STAGES),
        help="with --resume: do this stage and the later ones again",
    )
    fit.add_argument(
        "--max-seconds",
        type=float,
        default=FitOptions.max_seconds,
        metavar="S",
        help="refuse a longer video",
    )
    fit.add_argument("--json", action="store_true", help="progress as JSON lines on standard output")
    _add_components(fit)
    fit.set_defaults(run=_fit)

    render = commands.add_parser("render", help="render an avatar: its frames, or any pose and camera")
    render.add_argument("run_dir", type=Path, metavar="RUN")
    render.add_argument("--frames", metavar="all|holdout|12,40")
    render.add_argument(
        "--pose", metavar="SPEC", help="rest, fist, point, pinch, spread, frame:12 or 48 numbers"
    )
    render.add_argument(
        "--camera",
        default="orbit:0,0",
        metavar="SPEC",
        help="source, orbit:YAW,PITCH[,METRES] or a JSON file",
    )
    render.add_argument("--size", default="512x512", metavar="WxH")
    render.add_argument(
        "--channel", default="rgb", metavar="rgb|alpha|depth|normal|distortion|surfels", help="what to show"
    )
    render.add_argument("--device", choices=DEVICES, default="cpu", help="where it is rendered")
    render.add_argument(
        "--out",
        type=Path,
        required=True,
        help="a .png, .webp or .jpg picture, or the channel's numbers as .npy; with --frames a directory",
    )
    render.set_defaults(run=_render)

    animate = commands.add_parser("animate", help="a moving hand: poses in turn, or a turn around one")
    animate.add_argument("run_dir", type=Path, metavar="RUN")
    animate.add_argument(
        "--motion",
        type=Path,
        required=True,
        metavar="FILE",
        help='JSON: kind ("poses", "turntable"), poses, between, loop, seconds, camera, width, height, fps, '
        'format ("mp4", "webp"); every one may be left out',
    )
    animate.add_argument("--out", type=Path, required=True, help="directory for motion.mp4 or motion.webp")
    animate.add_argument("--device", choices=DEVICES, default="auto", help="where it is rendered")
    animate.add_argument("--json", action="store_true", help="progress as JSON lines on standard output")
    animate.set_defaults(run=_animate)

    export = commands.add_parser("export", help="write the avatar's surfels for other tools")
    export.add_argument("run_dir", type=Path, metavar="RUN")
    export.add_argument("--format", choices=("ply", "ply3d"), required=True)
    export.add_argument("--pose", default="rest", metavar="SPEC")
    export.add_argument("--out", type=Path, required=True)
    export.set_defaults(run=_export)

    evaluate = commands.add_parser("eval", help="score a run's held-out frames, or a whole data set")
    add_eval_arguments(evaluate)
    evaluate.set_defaults(run=_eval)

    page = commands.add_parser("report", help="write one HTML page about a fit")
    page.add_argument("run_dir", type=Path, metavar="RUN")
    page.add_argument("--out", type=Path, metavar="FILE", help="instead of RUN/report.html")
    page.set_defaults(run=_page)

    bench = commands.add_parser(
        "bench", help="measure speed on this machine, speed against accuracy, or stability"
    )
    bench.add_argument("what", choices=BENCHMARKS)
    bench.add_argument("rest", nargs=argparse.REMAINDER)
    bench.set_defaults(run=_bench)
    return parser


def _add_components(fit: argparse.ArgumentParser) -> None:
    group = fit.add_argument_group("parts of the method")
    for name, what in COMPONENT_SWITCHES.items():
        group.add_argument(f"--no-{name.replace('_', '-')}", dest=name, action="store_false", help=what)
    group.add_argument(
        "--exposure",
        action=argparse.BooleanOptionalAction,
        help="a gain per frame and colour channel, always or never (without the flag: where frames disagree)",
    )
    group.add_argument("--binding", choices=BINDINGS, default=Components.binding, help="the binding loss")
    group.add_argument("--levels", type=int, metavar="N", help="Loop levels, 0 to 2")


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code."""
    try:
        arguments = build_parser().parse_args(argv)
    except SystemExit as stop:  # argparse prints its own usage line
        return int(stop.code or 0)
    json_lines = bool(getattr(arguments, "json", False))
    signal.signal(signal.SIGTERM, _interrupt)
    try:
        arguments.run(arguments)
    except EngineError as error:
        _report_error(error, json_lines)
        if error.code == OUT_OF_MEMORY:
            return EXIT_OUT_OF_MEMORY
        return 2 if isinstance(error, BadArgumentError) else 3
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130
    except Exception as error:
        full = memory_error(error)
        if full is not None:
            _report_error(full, json_lines)
            return EXIT_OUT_OF_MEMORY
        traceback.print_exc()
        internal = EngineError(
            "engine.internal",
            f"{type(error).__name__}: {error}",
            "This is a fault of the program: please report it with the lines above.",
        )
        _report_error(internal, json_lines)
        return 4
    return 0


def _interrupt(_signal: int, _frame: FrameType | None) -> None:
    raise KeyboardInterrupt


def _report_error(error: EngineError, json_lines: bool) -> None:
    if json_lines:
        _emit(type="error", code=error.code, message=error.message, advice=error.advice)
    print(f"error: {error.code}: {error.message} {error.advice}", file=sys.stderr)


def _emit(**fields: object) -> None:
    print(json.dumps(fields), flush=True)


def _fit(arguments: argparse.Namespace) -> None:
    options = FitOptions(
        template=arguments.template,
        tracks=arguments.tracks,
        masks=arguments.masks,
        segmenter=arguments.segmenter,
        segmenter_weights=arguments.segmenter_weights,
        side=arguments.side,
        preset=arguments.preset,
        holdout=arguments.holdout,
        refined_frames=arguments.refined_frames,
        seed=arguments.seed,
        device=arguments.device,
        precision=arguments.precision,
        fov=arguments.fov,
        max_frames=arguments.max_frames,
        resume=arguments.resume,
        from_stage=arguments.from_stage,
        components=Components(
            **{name: getattr(arguments, name) for name in COMPONENT_SWITCHES},
            exposure="auto" if arguments.exposure is None else arguments.exposure,
            binding=arguments.binding,
            levels=arguments.levels,
        ),
        max_seconds=arguments.max_seconds,
    )
    # Heavy imports only once the arguments are good.
    from mass_engine.pipeline import fit_hands_to_directory, fit_to_directory

    fit = fit_hands_to_directory if options.side == "both" else fit_to_directory

    if arguments.json:

        def report(step: Progress) -> None:
            left = None if step.time_left is None else round(step.time_left, 1)
            _emit(
                type="progress",
                stage=step.stage,
                fraction=round(step.fraction, 4),
                time_left=left,
                message=step.message,
            )

        def warn(code: str, message: str, advice: str) -> None:
            _emit(type="warning", code=code, message=message, advice=advice)

        fit(arguments.video, arguments.out, options, report, warn)
        _emit(type="done", report=str(arguments.out / "report.json"))
        return

    from mass_engine.terminal import TerminalProgress

    with TerminalProgress() as bar:
        result = fit(arguments.video, arguments.out, options, bar.report, bar.warn)
    print(result.summary())
    print(f"wrote {arguments.out}")


def _render(arguments: argparse.Namespace) -> None:
    from mass_engine.rendering import render_frames, render_to_file

    if (arguments.frames is None) == (arguments.pose is None):
        raise BadArgumentError(
            "render.what", "Say what to render.", "Give either --frames or --pose, not both."
        )
    if arguments.frames is not None:
        count = render_frames(
            arguments.run_dir, arguments.frames, arguments.out, arguments.channel, arguments.device
        )
        print(f"wrote {count} frames to {arguments.out}")
    else:
        render_to_file(
            arguments.run_dir,
            arguments.pose,
            arguments.camera,
            arguments.size,
            arguments.out,
            arguments.channel,
            arguments.device,
        )
        print(f"wrote {arguments.out}")


def _animate(arguments: argparse.Namespace) -> None:
    from mass_engine.motion import animate, read_motion

    def report(fraction: float) -> None:
        if arguments.json:
            _emit(type="progress", stage="render", fraction=round(fraction, 4), time_left=None, message="")

    motion = read_motion(arguments.motion)
    file = animate(arguments.run_dir, motion, arguments.out, report, arguments.device)
    if arguments.json:
        _emit(type="done", report=str(file))
    else:
        print(f"wrote {file}")


def _export(arguments: argparse.Namespace) -> None:
    from mass_engine.avatar import Avatar
    from mass_engine.export.ply import write_ply

    avatar = Avatar.load(arguments.run_dir)
    write_ply(avatar.cloud(arguments.pose), arguments.out, "3dgs" if arguments.format == "ply3d" else "2dgs")
    print(f"wrote {arguments.out}")


def _eval(arguments: argparse.Namespace) -> None:
    from mass_engine.evaluation.command import evaluate

    evaluate(arguments)


def _page(arguments: argparse.Namespace) -> None:
    from mass_engine.evaluation.report_page import write_report

    print(f"wrote {write_report(arguments.run_dir, arguments.out)}")


def _bench(arguments: argparse.Namespace) -> None:
    import_module(f"mass_engine.evaluation.{BENCHMARKS[arguments.what]}").run(arguments.rest)


if __name__ == "__main__":
    sys.exit(main())
