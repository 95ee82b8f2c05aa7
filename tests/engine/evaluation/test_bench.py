"""The drivers' tables, fronts and charts, without their long runs."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from types import ModuleType

import cv2
import pytest

from mass_engine import raster
from mass_engine.cli import main
from mass_engine.errors import BadArgumentError, EngineError
from mass_engine.evaluation import bench_raster, needed, pareto, stability, stability_report
from mass_engine.evaluation.charts import Chart, draw, draw_bars
from mass_engine.evaluation.heldout import REFINED, RefinedScores, with_refined
from mass_engine.evaluation.needed import Size, sizes
from mass_engine.evaluation.pareto import Point, front
from mass_engine.evaluation.perturb import axes
from mass_engine.evaluation.results_file import read_rows, write_results
from mass_engine.evaluation.stability import conditions
from mass_engine.evaluation.stability_report import UNCHANGED, Trial, summarised
from mass_engine.evaluation.variants import variants


def test_the_front_is_what_nothing_beats() -> None:
    points = [(1.0, 20.0), (2.0, 25.0), (3.0, 24.0), (4.0, 30.0), (2.0, 22.0)]
    assert front(points, most=False) == [0, 1, 3]
    assert front(points, most=True) == [3]
    assert front([], most=True) == []


def test_the_grid_changes_one_thing_at_a_time() -> None:
    grid = variants(quick=False)
    assert set(grid["preset"]) == {"draft", "auto", "full"}
    base = grid["preset"]["auto"]
    assert [one.harmonics for one in grid["harmonics, every surfel"].values()] == [0, 3, 8, 15]
    for schedule in grid["harmonics, every surfel"].values():
        assert (schedule.levels, schedule.appearance) == (base.levels, base.appearance)
    assert max(step.side for step in grid["resolution"]["160 px"].appearance) == 160
    assert len(variants(quick=True)["preset"]) == 1


def point(name: str, group: str, seconds: float, psnr: float, clip: str = "a", error: str = "") -> Point:
    metrics: dict[str, float | None] = {"psnr_in_mask": psnr, "ms_ssim_hand_on_black": 0.9}
    return Point(clip, group, name, seconds, 50.0, 1000, 10, metrics, error=error)


def test_pareto_tables_and_charts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    points = [
        point("auto", "preset", 10.0, 28.0),
        point("auto", "preset", 20.0, 26.0, "b"),
        point("mesh", "baseline", 5.0, 25.0),
        point("mesh", "baseline", 0.0, 0.0, "b", "RuntimeError: no"),
    ]
    table = pareto.markdown(points, ["a", "b"], "the command")
    assert "| preset | auto | 15.0 | 50 | 1 | 10 | 27.000 |" in table
    assert "| baseline | mesh |" not in table  # not on every clip
    assert "failed: b, mesh: RuntimeError: no" in table
    panels = recorded(monkeypatch, pareto)
    assert len(pareto.charts(points, tmp_path)) == 6  # two metrics are known, each against three costs
    assert [panel.title[-1] for panel in panels[:2]] == ["a", "b"]  # a front for each clip
    assert [list(panel.series[0].y) for panel in panels[:2]] == [[25.0, 28.0], [26.0]]
    assert all(any(one.marker == "*" for one in panel.series) for panel in panels)
    written = draw(panels[:2], tmp_path / "x", stacked=True)
    assert [path.name for path in written] == ["x.svg", "x.png"]
    assert all(path.stat().st_size > 1000 for path in written)
    first = written[0].read_bytes()
    draw(panels[:2], tmp_path / "x", stacked=True)
    assert written[0].read_bytes() == first  # equal figures are equal files


def recorded(monkeypatch: pytest.MonkeyPatch, module: ModuleType) -> list[Chart]:
    """Every chart that ``module`` would draw."""
    panels: list[Chart] = []

    def noted(charts: Sequence[Chart], path: Path, stacked: bool = False) -> list[Path]:
        panels.extend(charts)
        return [path]

    monkeypatch.setattr(module, "draw", noted)
    return panels


def trial(level: str, seed: int, psnr: float | None, value: float = 1.0, on_black: float = 30.0) -> Trial:
    axis = UNCHANGED if level == UNCHANGED else "blur, px"
    black = None if psnr is None else on_black
    return Trial(
        "a", axis, value, level, "ours", seed, psnr, black, 0.9, error="" if psnr else "RuntimeError: no"
    )


def test_stability_counts_failures(tmp_path: Path) -> None:
    found = [
        trial(UNCHANGED, 0, 28.0, 0.0),
        trial(UNCHANGED, 1, 27.0, 0.0),
        trial("2", 0, 26.0, 2.0),
        trial("2", 1, 23.0, 2.0),
        trial("3", 0, 28.0, 3.0, on_black=26.5),  # nothing lost in the mask, but around it
        trial("4", 0, None, 4.0),
    ]
    rows = {row["level"]: row for row in summarised(found)}
    assert rows[UNCHANGED]["failure_rate"] == 0
    assert rows["2"]["psnr"] == 24.5
    assert rows["2"]["psnr_worst"] == 23.0
    assert rows["2"]["failure_rate"] == 0.5
    assert rows["3"]["failure_rate"] == 1.0
    assert rows["4"]["psnr"] is None
    assert rows["4"]["failure_rate"] == 1.0
    table = stability_report.markdown(found, "the command", ["what was run"])
    assert "| 2 | 2 | 24.50 (23.00 to 26.00) / 30.00, 50% fail |" in table
    assert "| 4 | 1 | failed |" in table
    assert "- what was run" in table
    assert len(stability_report.charts(found, tmp_path)) == 2
    assert len(stability_report.charts(found[:2], tmp_path)) == 2  # only the clip as it is: still a figure


def test_stability_over_clips_and_seeds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    panels = recorded(monkeypatch, stability_report)
    again = RefinedScores([7], {"psnr_hand_on_black": 31.0}, {"psnr_hand_on_black": 30.0})
    found = [
        replace(
            trial(level, seed, psnr, value), clip=clip, method=method, after_test_time_pose_refinement=again
        )
        for clip in ("a", "b")
        for method in ("ours", "mesh")
        for seed in (0, 1)
        for level, psnr, value in (("2", 28.0 - 4 * seed, 2.0), ("1", 28.0, 1.0), (UNCHANGED, 28.0, 0.0))
    ]
    table = stability_report.markdown(found, "the command", [])
    assert "| 2 | 4 | 26.00 (24.00 to 28.00) / 30.00, 50% fail | 26.00 (" in table
    assert table.index(f"| {UNCHANGED} |") < table.index("| 1 |") < table.index("| 2 |")  # whatever ran first
    assert "| 1 | 4 | 30.00 to 31.00 | 30.00 to 31.00 |" in table
    stability_report.charts(found, tmp_path)
    assert [list(panel.ticks) for panel in panels] == 3 * [[UNCHANGED, "1", "2"]]
    mean, worst = panels[0].series[:2]
    assert (list(mean.y), list(worst.y)) == ([28.0, 28.0, 26.0], [28.0, 28.0, 24.0])
    assert [list(one.y) for one in panels[2].series] == 2 * [[0.0, 0.0, 50.0]]


def test_one_seed_of_every_axis_comes_before_the_next() -> None:
    wanted = axes()
    plan = list(conditions(["a", "b"], wanted, range(2)))
    assert [place.seed for place in plan] == sorted(place.seed for place in plan)
    unchanged = [place for place in plan if place.axis == UNCHANGED]
    assert [(place.seed, place.clip) for place in unchanged] == [(0, "a"), (0, "b"), (1, "a"), (1, "b")]
    one = [place for place in plan if (place.seed, place.clip) == (0, "b")]
    assert one[0].axis == UNCHANGED
    assert [place.axis for place in one[1 : len(wanted) + 1]] == list(wanted)
    assert [place.level for place in one[1 : len(wanted) + 1]] == [levels[-1] for levels in wanted.values()]
    assert sum(len(levels) - 1 for levels in wanted.values()) == len(one) - 1
    assert len({(place.axis, place.level.name) for place in one}) == len(one)
    seeds = {place.level.reseed for place in one if place.axis == "random seed"}
    assert len(seeds) == 3
    assert 0 not in seeds


def test_axes_and_levels_are_chosen() -> None:
    wanted = stability.wanted_axes(["start noise", "blur"], ["0.2", "0.3"], quick=False)
    assert [level.name for level in wanted["start noise, rad"]] == [UNCHANGED, "0.2", "0.3"]
    assert [level.name for level in wanted["blur, px"]] == [UNCHANGED]
    places = list(conditions(["a"], stability.wanted_axes([UNCHANGED], [], quick=False), range(3)))
    assert [(place.axis, place.seed) for place in places] == [(UNCHANGED, seed) for seed in range(3)]
    with pytest.raises(BadArgumentError) as caught:
        stability.wanted_axes(["blur"], ["9"], quick=False)
    assert caught.value.code == "bench.level"
    for bench in ("pareto", "needed", "stability", "fit"):
        assert main(["bench", bench, "--refined-frames", "-1"]) == 2


def test_results_are_taken_up_again_with_the_same_settings_only(tmp_path: Path) -> None:
    file = tmp_path / "x.json"
    assert read_rows(file, True, {"side": 320}) == []
    write_results(file, "the command", {"side": 320}, [{"a": 1}])
    assert read_rows(file, True, {"side": 320}) == [{"a": 1}]
    assert read_rows(file, False, {"side": 320}) == []
    with pytest.raises(BadArgumentError, match="other side"):
        read_rows(file, True, {"side": 640})
    file.write_text("{}")
    with pytest.raises(BadArgumentError) as caught:
        read_rows(file, True, {"side": 320})
    assert caught.value.code == "bench.resume"


def test_the_needed_model(tmp_path: Path) -> None:
    grid = sizes(3, quick=False)
    assert len(grid) >= 6
    assert all(one.harmonics == 3 and not one.detached and not one.deforming for one in grid.values())
    found = [
        Size("a", "L1 D1", 39_000, 60.0, 9.0, 0.02, 29.0, 30.0),
        Size("a", "L0 D0", 2_400, 50.0, 14.0, None, 25.0, 26.0),
        Size("a", "auto", 20_000, 70.0, 9.1, 0.021, 29.0, 30.0, auto=True),
    ]
    again = RefinedScores([7], {"psnr_hand_on_black": 31.0}, {"psnr_hand_on_black": 30.0})
    found[0] = replace(found[0], after_test_time_pose_refinement=again)
    assert [
        Size(**with_refined(row)) for row in json.loads(json.dumps([asdict(one) for one in found]))
    ] == found
    table = needed.markdown(found, "the command")
    assert table.index("| L0 D0 | 2,400 |") < table.index("| **auto** (stopped here) | 20,000 |")
    assert "| L1 D1 | 39,000 | 60.0 | 9.00 | 0.0200 | 29.00 | 30.00 | 30.00 to 31.00 |" in table
    assert [path.name for path in needed.charts(found, tmp_path)] == ["needed.svg", "needed.png"]


def test_bars_and_wrong_axes(tmp_path: Path) -> None:
    written = draw_bars(
        "by clip", "dB", {"a": {"ours": 28.0, "mesh": 25.0}, "b": {"ours": 27.0}}, tmp_path / "x"
    )
    assert [path.name for path in written] == ["x.svg", "x.png"]
    many = {f"clip {place}": {"ours": 28.0, "mesh": 25.0} for place in range(30)}
    picture = cv2.imread(str(draw_bars("by clip", "dB", many, tmp_path / "y")[1]))
    assert picture is not None
    assert picture.shape[1] < 1200 < picture.shape[0]  # still as wide as a page
    assert main(["bench", "stability", "--axis", "nothing"]) == 2


def test_charts_say_what_is_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    from mass_engine.errors import EngineError

    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(EngineError) as caught:
        draw_bars("by clip", "dB", {"a": {"ours": 1.0}}, tmp_path / "x")
    assert caught.value.code == "charts.missing"


def test_the_best_of_every_clip(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def made(name: str, clip: str, psnr: float, kind: str = "heldout", refined: float | None = None) -> Path:
        run = tmp_path / name
        run.mkdir()
        report = {
            "video": {"name": f"{clip}.mp4"},
            "options": {},
            "frames": {},
            "metrics": {"psnr_hand_on_black": psnr},
            "scored_frames": {"kind": kind},
        }
        (run / "report.json").write_text(json.dumps(report))
        if refined is not None:
            second = {REFINED: {"metrics": {"psnr_hand_on_black": refined}}}
            (run / "evaluation.json").write_text(json.dumps({"metrics": report["metrics"], **second}))
        return run

    runs = [
        made("1", "laptop", 28.0),
        made("2", "laptop", 30.5, refined=33.0),
        made("3", "waffle", 29.0),
        made("4", "waffle", 99.0, "training"),  # not held out: no figure
        made("5", "video", 27.0),
        made("6", "pictures", 26.0),
        made("7", "laptop", 29.0, refined=40.0),  # not the best run: its second figure is not taken
    ]
    out = tmp_path / "out"
    assert main(["bench", "clips", *map(str, runs), "--out", str(out)]) == 0
    assert f"| laptop | 30.500 | 33.000 | {runs[1]} |" in capsys.readouterr().out
    values = json.loads((out / "clips.json").read_text())["clips"]
    assert values["waffle"]["figures"] == {"held out": 29.0}
    assert values["5"]["figures"] == {"held out": 27.0}
    assert values["6"]["figures"] == {"held out": 26.0}
    assert (out / "clips.png").stat().st_size > 1000
    assert main(["bench", "clips", str(runs[0]), "--metric", "nothing", "--out", str(out)]) == 2
    assert main(["bench", "clips", str(runs[3]), "--out", str(out)]) == 2
    (runs[0] / "evaluation.json").write_text("{")
    assert main(["bench", "clips", str(runs[0]), "--out", str(out)]) == 2


def test_a_benchmark_on_a_gpu_says_what_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    # As if it had not been built.
    monkeypatch.setitem(sys.modules, "mass_engine.raster._cuda_kernels", None)
    monkeypatch.delattr(raster, "_cuda_kernels", raising=False)
    with pytest.raises(EngineError, match=r"device\.unavailable.*make cuda"):
        bench_raster.run(["--device", "cuda"])
