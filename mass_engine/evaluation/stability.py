"""``mass-engine bench stability``: what is lost when the clip is worse than it should be, ours and baselines.

Each axis makes one thing worse in steps, on the prepared clip; held-out pictures and masks stay clean, so a
loss is the fit's. A run fails when it raises, gives numbers that are not finite, or loses more than 3 dB
against the same method on the clip as it is. Where the exposure drifts, a held-out frame is one of the
drifting clip's: a render gets the gain that the fit found between its neighbours, and is compared after the
frame's true one is taken out again. Ours and the baselines go on from one registration of each changed clip,
under the same gains. One seed of every axis comes first, then the next, and the worst level of every axis
before the others; tables and charts are written after every condition, and --resume goes on.
"""

from __future__ import annotations

import argparse
import math
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch

from mass_engine.avatar import SourceFrames
from mass_engine.errors import BadArgumentError, EngineError
from mass_engine.evaluation import metrics
from mass_engine.evaluation.arguments import add_refined_frames
from mass_engine.evaluation.baselines import BASELINES, BaselineName, Registered, fit_baseline, register
from mass_engine.evaluation.bench_clips import clips_of
from mass_engine.evaluation.command import tell
from mass_engine.evaluation.heldout import RefinedScores, score_refined, with_refined
from mass_engine.evaluation.outlines import iou
from mass_engine.evaluation.perturb import Level, axes
from mass_engine.evaluation.registrations import Registrations
from mass_engine.evaluation.results_file import read_rows, write_results, write_text
from mass_engine.evaluation.scores import Comparison, Exposed, Frame, Renderable, Scores, mean_scores, placed
from mass_engine.evaluation.stability_report import OURS, UNCHANGED, Trial, charts, markdown
from mass_engine.fitting.schedule import Schedule, schedule_for
from mass_engine.preprocess import Clip
from mass_engine.threads import one_thread

_FAILURES = (EngineError, RuntimeError, ValueError, ArithmeticError)


@dataclass(frozen=True)
class Condition:
    """One clip, one level of one axis, one seed."""

    clip: str
    axis: str
    level: Level
    seed: int


@dataclass(frozen=True)
class Effort:
    """How every method is run: our ``schedule``, how often the ``baselines`` see every frame (1: 13 times),
    and how many held-out frames are ``refined`` for a second figure."""

    schedule: Schedule
    baselines: float
    refined: int


def conditions(
    clips: Sequence[str], wanted: dict[str, list[Level]], seeds: Sequence[int]
) -> Iterator[Condition]:
    """Everything, seed by seed; the clip as it is (the first level of each axis) once a seed, first; then the
    last level of every axis, then the one before it, so that a run cut short has all axes."""
    for seed in seeds:
        for clip in clips:
            yield Condition(clip, UNCHANGED, next(iter(wanted.values()))[0], seed)
            for back in range(1, max(map(len, wanted.values()))):
                for axis, levels in wanted.items():
                    if back < len(levels):
                        yield Condition(clip, axis, levels[-back], seed)


def trials(clip: Clip, place: Condition, methods: Sequence[str], effort: Effort) -> Iterator[Trial]:
    """Every method under one condition; an error of a fit is a result."""
    level = place.level
    clip = level.change(clip, np.random.default_rng([place.seed, *place.axis.encode()]))
    with tempfile.TemporaryDirectory() as folder:
        registrations = Registrations(clip, place.seed + level.reseed, Path(folder))
        hands: list[Registered] = []

        def ours() -> tuple[Renderable, SourceFrames]:
            avatar = registrations.fit(effort.schedule)[0].avatar
            return avatar, avatar.frames

        def baseline(name: BaselineName) -> tuple[Renderable, SourceFrames]:
            if not hands:
                hands.append(register(registrations, effort.schedule))
            return fit_baseline(name, hands[0], registrations.seed, effort.baselines), hands[0].frames

        makers: dict[str, Callable[[], tuple[Renderable, SourceFrames]]] = {
            OURS: ours,
            **{name: lambda name=name: baseline(name) for name in BASELINES},  # type: ignore[misc]
        }
        for method in methods:
            yield _trial(clip, place, method, makers[method], effort.refined)


def _trial(
    clip: Clip,
    place: Condition,
    method: str,
    make: Callable[[], tuple[Renderable, SourceFrames]],
    refined: int,
) -> Trial:
    key = (place.clip, place.axis, place.level.value, place.level.name, method, place.seed)
    started = time.perf_counter()
    try:
        found = make()
        spent = round(time.perf_counter() - started, 1)
        return Trial(*key, *score(*found, clip, place.level, refined), spent)
    except _FAILURES as error:
        spent = round(time.perf_counter() - started, 1)
        why = f"{type(error).__name__}: {error}"[:200]
        return Trial(*key, None, None, None, seconds=spent, error=why)


def score(
    subject: Renderable, frames: SourceFrames, clip: Clip, level: Level, refined: int
) -> tuple[float | None, float | None, float | None, RefinedScores]:
    """Mean PSNR in the mask, on black and silhouette IoU of held-out frames, and the second figure.

    ``subject`` is rendered in the poses and under the gains of ``frames``, without those of ``level``, which
    the clean pictures do not have. Raises ArithmeticError where a score is not finite.
    """
    true = torch.from_numpy(level.gains(len(clip.views))).float()
    held = [row for row, view in enumerate(clip.views) if view.heldout]
    found = placed(subject, frames, [clip.views[row] for row in held])
    shown: list[Frame] = [
        (Exposed(at, 1 / true[row]), view, pose) for row, (at, view, pose) in zip(held, found, strict=True)
    ]
    with one_thread():
        rows = [_scores(frame) for frame in shown]
        if not all(math.isfinite(row["psnr"]) for row in rows):
            raise ArithmeticError("a held-out frame has no finite score")
        again = score_refined(shown, refined)
    means = mean_scores(rows)
    return means["psnr"], means["psnr_on_black"], means["iou"], again


def _scores(frame: Frame) -> Scores:
    found = Comparison.of(*frame)
    render = metrics.to_8bit(found.render)
    return {
        "psnr": metrics.psnr(render, found.video, found.hand) if bool(found.hand.any()) else math.nan,
        "psnr_on_black": metrics.psnr(*found.on_black(render)),
        "iou": iou(found.alpha > 0.5, found.hand, found.valid),
    }


def run(rest: Sequence[str]) -> None:
    """The command."""
    arguments = _parser().parse_args(rest)
    wanted = wanted_axes(arguments.axis, arguments.level, arguments.quick)
    if arguments.seeds < 1 or arguments.effort <= 0:
        raise BadArgumentError("bench.invalid", "No seed, or no effort.", "Use --seeds 1 --effort 0.5, say.")
    methods = tuple(arguments.method) or (OURS, *BASELINES)
    out: Path = arguments.out
    out.mkdir(parents=True, exist_ok=True)
    command = " ".join(["mass-engine bench stability", *rest])
    names = ("quick", "preset", "max_frames", "heldout", "side", "effort", "refined_frames")
    settings = {name: getattr(arguments, name) for name in names}
    file = out / "stability.json"
    found = [Trial(**with_refined(row)) for row in read_rows(file, arguments.resume, settings)]
    clips = dict(
        clips_of(
            arguments.videos, arguments.quick, 0, arguments.max_frames, out, arguments.heldout, arguments.side
        )
    )
    preset = "draft" if arguments.quick else arguments.preset
    effort = Effort(schedule_for(preset), arguments.effort, arguments.refined_frames)
    notes = _notes(arguments, preset, clips)
    for place in conditions(list(clips), wanted, range(1 if arguments.quick else arguments.seeds)):
        key = (place.clip, place.axis, place.level.name, place.seed)
        done = {t.method for t in found if (t.clip, t.axis, t.level, t.seed) == key}
        left = [method for method in methods if method not in done]
        if not left:
            continue
        started = time.perf_counter()
        found += trials(clips[place.clip], place, left, effort)
        spent = time.perf_counter() - started
        tell(f"{place.clip}: {place.axis}, {place.level.name}, seed {place.seed}: {spent:.0f} s")
        write_results(file, command, settings, [asdict(trial) for trial in found])
        write_text(out / "stability.md", markdown(found, command, notes))
        if place.axis != UNCHANGED:
            charts(found, out, [place.axis])
    table = markdown(found, command, notes)
    write_text(out / "stability.md", table)
    print(table)
    for path in charts(found, out):
        print(f"wrote {path}")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="mass-engine bench stability", description=__doc__)
    add = parser.add_argument
    add("videos", type=Path, nargs="*", metavar="VIDEO")
    add("--out", type=Path, default=Path("bench-stability"))
    add("--quick", action="store_true", help="two axes, one level, only to see that it works")
    add("--axis", action="append", default=[], metavar="NAME", help="part of an axis's name")
    add("--level", action="append", default=[], metavar="NAME", help="only this level of the axes")
    add("--method", action="append", default=[], choices=(OURS, *BASELINES))
    add("--preset", default="auto", choices=("draft", "auto", "full"))
    add("--seeds", type=int, default=1)
    add("--max-frames", type=int, default=40, help="training frames")
    add("--heldout", type=int, default=12, help="held-out frames at most")
    add("--side", type=int, default=320, help="longer side of the crops, pixels")
    add("--effort", type=float, default=0.5, help="of the baselines; 1: every frame 13 times")
    add_refined_frames(parser, 2)
    add("--resume", action="store_true", help="go on with the results in --out")
    return parser


def wanted_axes(parts: Sequence[str], names: Sequence[str], quick: bool) -> dict[str, list[Level]]:
    """The axes that are asked for, each with the clip as it is and the levels that are."""
    known = axes()
    same = next(iter(known.values()))[0]
    known[UNCHANGED] = [same]
    if not parts:
        parts = [name for name in known if name != UNCHANGED]
    wanted = {name: levels for name, levels in known.items() if any(part in name for part in parts)}
    if not wanted:
        raise BadArgumentError("bench.axis", "No such axis.", f"Use part of: {', '.join(known)}.")
    strange = set(names) - {level.name for levels in wanted.values() for level in levels}
    if strange:
        offered = "; ".join(f"{name}: {', '.join(one.name for one in wanted[name][1:])}" for name in wanted)
        raise BadArgumentError("bench.level", f"No axis has level {min(strange)}.", f"Use {offered}.")
    if names:
        wanted = {
            axis: [levels[0], *(level for level in levels[1:] if level.name in names)]
            for axis, levels in wanted.items()
        }
    if quick:
        wanted = {name: levels[:1] + levels[1:][-1:] for name, levels in list(wanted.items())[:2]}
    return wanted


def _notes(arguments: argparse.Namespace, preset: str, clips: dict[str, Clip]) -> list[str]:
    frames = ", ".join(
        f"{name} ({sum(not v.heldout for v in clip.views)} training frames, "
        f"{sum(v.heldout for v in clip.views)} held out)"
        for name, clip in clips.items()
    )
    return [
        f"Clips: {frames}; crops of at most {arguments.side} pixels, in which pixels of an axis are counted.",
        f"Ours: preset {preset}. Baselines: the same registration, then {arguments.effort:g} times their "
        "usual steps (usual: every frame 13 times, the mesh once).",
    ]
