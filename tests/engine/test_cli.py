"""The command line: exit codes, error lines, progress as JSON."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from mass_engine.cli import main


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "mass_engine", *arguments],
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )


@pytest.mark.parametrize(
    "arguments",
    [
        ["fit", "x.mp4"],
        ["fit", "x.mp4", "--out", "o", "--preset", "best"],
        ["fit", "x.mp4", "--out", "o", "--holdout", "1"],
        ["fit", "x.mp4", "--out", "o", "--fov", "400"],
        ["fit", "x.mp4", "--out", "o", "--max-frames", "0"],
        ["fit", "x.mp4", "--out", "o", "--levels", "3"],
        ["fit", "x.mp4", "--out", "o", "--binding", "glue"],
        ["fit", "x.mp4", "--out", "o", "--template", "mano:none.pkl"],
        ["fit", "x.mp4", "--out", "o", "--device", "cuda"],
        ["render", "run", "--out", "x.png"],
        ["nonsense"],
        [],
    ],
)
def test_bad_arguments_exit_with_2(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(arguments) == 2
    assert capsys.readouterr().err


def test_unusable_input_exits_with_3_and_says_why(tmp_path: Path) -> None:
    text = tmp_path / "notes.mp4"
    text.write_text("not a video at all")
    done = run("fit", str(text), "--out", str(tmp_path / "run"), "--json")
    assert done.returncode == 3
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    assert lines[-1]["type"] == "error"
    assert lines[-1]["code"] == "video.unsupported_container"
    assert lines[-1]["advice"]
    assert "video.unsupported_container" in done.stderr


def test_fit_reports_monotonic_progress_as_json_lines(demo_clip: Path, tmp_path: Path) -> None:
    done = run(
        "fit",
        str(demo_clip),
        "--out",
        str(tmp_path / "run"),
        "--preset",
        "draft",
        "--max-frames",
        "12",
        "--json",
    )
    assert done.returncode == 0, done.stderr
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    fractions = [line["fraction"] for line in lines if line["type"] == "progress"]
    assert fractions == sorted(fractions)
    stages = list(dict.fromkeys(line["stage"] for line in lines if line["type"] == "progress"))
    assert stages == ["read", "track", "segment", "align", "convert", "fit", "evaluate", "save"]
    assert lines[-1] == {"type": "done", "report": str(tmp_path / "run" / "report.json")}
    report = json.loads((tmp_path / "run" / "report.json").read_text())
    assert len(report["frames"]["fitted"]) == 12
    assert report["scored_frames"]["kind"] == "training"


def test_importing_the_package_loads_nothing_heavy() -> None:
    code = "import sys, mass_engine; print(sorted({'torch', 'cv2', 'numpy'} & set(sys.modules)))"
    assert subprocess.check_output([sys.executable, "-c", code], text=True).strip() == "[]"


def test_a_killed_fit_goes_on_with_resume(demo_clip: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    command = ["fit", str(demo_clip), "--out", str(out), "--preset", "draft", "--max-frames", "8", "--json"]
    with subprocess.Popen(
        [sys.executable, "-m", "mass_engine", *command], stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        for line in process.stdout:
            if json.loads(line).get("message", "").startswith("conversion"):
                process.kill()
                break
    assert list((out / "checkpoint").glob("*.safetensors"))
    assert not (out / "report.json").exists()
    done = run(*command, "--resume")
    assert done.returncode == 0, done.stderr
    report = json.loads((out / "report.json").read_text())
    assert report["fit"]["resumed_after"] == "stage 1, outline"
    assert not (out / "checkpoint").exists(), "a finished run needs none"


def test_switches_reach_the_fit(demo_clip: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    done = run(
        *(
            "fit",
            str(demo_clip),
            "--out",
            str(out),
            "--preset",
            "draft",
            "--max-frames",
            "6",
            "--levels",
            "0",
        ),
        *("--no-refine-pose", "--no-shading", "--binding", "paper", "--exposure"),
    )
    assert done.returncode == 0, done.stderr
    report = json.loads((out / "report.json").read_text())
    parts = report["options"]["components"]
    assert parts["levels"] == 0
    assert parts["binding"] == "paper"
    assert parts["exposure"] == "on"
    assert not parts["refine_pose"]
    assert parts["densify"]
    assert report["fit"]["capacity"]["levels"] == 0
    assert not any(name.startswith("stage 1") for name in report["fit"]["steps"])
