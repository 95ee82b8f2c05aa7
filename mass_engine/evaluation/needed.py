"""``mass-engine bench needed``: held-out error against model size, clip by clip, with where ``auto`` stopped.

Sizes are Loop levels 0 to 2 with one surfel a face, with the corners filled where the clip has a use for it
(faces of one colour, unseen or too small keep one), and with all corners filled. None has a deformation, all
have the harmonics that ``auto`` chose, and all go on from one registration.
"""

from __future__ import annotations

import argparse
import os
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import torch

from mass_engine.evaluation import metrics
from mass_engine.evaluation.bench_clips import clips_of
from mass_engine.evaluation.charts import PALETTE, Chart, Series, draw
from mass_engine.evaluation.command import tell
from mass_engine.evaluation.heldout import number
from mass_engine.evaluation.registrations import Registrations
from mass_engine.evaluation.results_file import read_rows, write_results, write_text
from mass_engine.evaluation.scores import Comparison, mean_scores, score_view
from mass_engine.evaluation.variants import DEFAULT
from mass_engine.fitting.schedule import Schedule, schedule_for
from mass_engine.fitting.trainer import FitResult
from mass_engine.preprocess import Clip
from mass_engine.threads import one_thread

#: (error, label of its axis).
ERRORS = (
    ("rms", "error a pixel of the hand, of 255"),
    ("one_minus_ms_ssim", "1 - MS-SSIM of the hand on black"),
)


@dataclass(frozen=True)
class Size:
    """One model size on one clip. ``rms``: root of the squared colour error over all pixels that are not
    ignored, divided by the hand's pixels, in 8-bit values: what sticks out costs as much as a hole."""

    clip: str
    name: str
    surfels: int
    seconds: float
    rms: float
    one_minus_ms_ssim: float | None
    psnr_in_mask: float | None
    psnr_hand_on_black: float | None
    auto: bool = False


def sizes(harmonics: int, quick: bool) -> dict[str, Schedule]:
    """Schedules from few surfels to many."""
    base = replace(
        schedule_for("draft" if quick else DEFAULT), harmonics=harmonics, detached=False, deforming=()
    )
    every, needed = replace(base, adaptive=False), replace(base, adaptive=True)
    found = {
        "L0 D0": replace(every, levels=0, depth=0),
        "L0 D1 as needed": replace(needed, levels=0, depth=1),
        "L0 D1": replace(every, levels=0, depth=1),
        "L1 D1 as needed": replace(needed, levels=1, depth=1),
        "L1 D1": replace(every, levels=1, depth=1),
        "L2 D1 as needed": replace(needed, levels=2, depth=1),
        "L2 D1": replace(every, levels=2, depth=1),
    }
    return dict(list(found.items())[:3:2]) if quick else found


def measure(
    clip: Clip, name: str, registrations: Registrations, quick: bool, known: Sequence[Size]
) -> Iterator[Size]:
    """``auto``, then every size; what is ``known`` comes first and is not measured again."""
    yield from known
    done = {size.name for size in known}
    preset = "draft" if quick else DEFAULT
    tell(f"{name}: {preset}")
    result, seconds = registrations.fit(schedule_for(preset))
    if preset not in done:
        yield _size(clip, name, preset, result, seconds, auto=True)
    harmonics = int(result.state.notes["capacity"]["harmonics"])
    for label, schedule in sizes(harmonics, quick).items():
        if label not in done:
            tell(f"{name}: {label}")
            yield _size(clip, name, label, *registrations.fit(schedule))


def _size(clip: Clip, name: str, label: str, result: FitResult, seconds: float, auto: bool = False) -> Size:
    avatar = result.avatar
    held = [view for view in clip.views if view.heldout]
    with one_thread():
        poses = [avatar.frames.pose_of(view.index) for view in held]
        gains = [avatar.frames.gain_of(view.index) for view in held]
        rows = [score_view(avatar, *frame) for frame in zip(held, poses, gains, strict=True)]
        squares = [_squared(Comparison.of(avatar, *frame)) for frame in zip(held, poses, gains, strict=True)]
    means = mean_scores(rows)
    ssim = means["ms_ssim_hand_on_black"]
    return Size(
        name,
        label,
        avatar.skin.count,
        seconds,
        255 * float(torch.tensor(squares).mean().sqrt()),
        None if ssim is None else 1 - ssim,
        means["psnr_in_mask"],
        means["psnr_hand_on_black"],
        auto,
    )


def _squared(found: Comparison) -> float:
    """Mean squared error of a channel: summed over the picture, divided by the hand's pixels."""
    picture, truth = found.on_black(metrics.to_8bit(found.render))
    return float((picture - truth).square().mean(-1).sum() / found.hand.sum().clamp_min(1))


def markdown(found: Sequence[Size], command: str) -> str:
    """One table a clip, in order of size."""
    lines = [
        f"`{command}`: held-out frames; error a pixel of the hand, of 255; torch in one thread, "
        f"{os.cpu_count()} cores.",
        "",
    ]
    for clip in dict.fromkeys(size.clip for size in found):
        lines += [
            f"**{clip}**",
            "",
            "| model | surfels | s | error a pixel | 1 - MS-SSIM | psnr_in_mask | psnr_hand_on_black |",
            "|---|---|---|---|---|---|---|",
        ]
        for size in sorted((one for one in found if one.clip == clip), key=lambda one: one.surfels):
            label = f"**{size.name}** (stopped here)" if size.auto else size.name
            cells = [f"{size.surfels:,}", f"{size.seconds:.1f}", f"{size.rms:.2f}"]
            cells += [number(size.one_minus_ms_ssim, 4), number(size.psnr_in_mask, 2)]
            lines.append(f"| {label} | {' | '.join([*cells, number(size.psnr_hand_on_black, 2)])} |")
        lines.append("")
    return "\n".join(lines)


def charts(found: Sequence[Size], out: Path) -> list[Path]:
    """Both errors against surfels, a line a clip; ``auto`` is a star of the clip's colour."""
    panels = []
    names = list(dict.fromkeys(size.name for size in found if not size.auto))
    names.sort(key=lambda name: min(size.surfels for size in found if size.name == name))
    key = [f"{place + 1}  {name}" for place, name in enumerate(names)]
    for column, label in ERRORS:
        series = [Series("levels and depth", [], [], line=False, marker="", key=key)]
        for place, clip in enumerate(dict.fromkeys(size.clip for size in found)):
            own = [one for one in found if one.clip == clip and getattr(one, column) is not None]
            line = sorted((one for one in own if not one.auto), key=lambda one: one.surfels)
            color = PALETTE[place % len(PALETTE)]
            xs, ys = [one.surfels for one in line], [getattr(one, column) for one in line]
            labels = [str(names.index(one.name) + 1) for one in line]
            series.append(Series(clip, xs, ys, labels, color=color))
            star = [one for one in own if one.auto]
            series.append(
                Series(
                    f"{clip}: where {DEFAULT} stopped", [one.surfels for one in star],
                    [getattr(one, column) for one in star], line=False, marker="*", color=color,
                    emphasis=True,
                )
            )  # fmt: skip
        panels.append(Chart("Held-out error against model size", "surfels", label, series, log_x=True))
    return draw(panels, out / "needed")


def run(rest: Sequence[str]) -> None:
    """The command."""
    parser = argparse.ArgumentParser(prog="mass-engine bench needed", description=__doc__)
    add = parser.add_argument
    add("videos", type=Path, nargs="*", metavar="VIDEO")
    add("--out", type=Path, default=Path("bench-needed"))
    add("--quick", action="store_true", help="two sizes and the draft preset, only to see that it works")
    add("--seed", type=int, default=0)
    add("--max-frames", type=int, default=160, help="training frames")
    add("--heldout", type=int, default=24, help="held-out frames at most")
    add("--registrations", type=Path, metavar="DIR", help="keep them, for bench pareto too")
    add("--resume", action="store_true", help="go on with the results in --out")
    arguments = parser.parse_args(rest)
    out: Path = arguments.out
    out.mkdir(parents=True, exist_ok=True)
    settings = {name: getattr(arguments, name) for name in ("quick", "seed", "max_frames", "heldout")}
    file = out / "needed.json"
    found = [Size(**row) for row in read_rows(file, arguments.resume, settings)]
    command = " ".join(["mass-engine bench needed", *rest])
    with tempfile.TemporaryDirectory() as scratch:
        for name, clip in clips_of(
            arguments.videos, arguments.quick, 0, arguments.max_frames, out, arguments.heldout
        ):
            registrations = Registrations(
                clip, arguments.seed, (arguments.registrations or Path(scratch)) / name
            )
            known = [size for size in found if size.clip == name]
            found = [size for size in found if size.clip != name]
            for size in measure(clip, name, registrations, arguments.quick, known):
                found.append(size)
                write_results(file, command, settings, [asdict(one) for one in found])
    table = markdown(found, command)
    write_text(out / "needed.md", table)
    print(table)
    for path in charts(found, out):
        print(f"wrote {path}")
