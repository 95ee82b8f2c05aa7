"""A program with the engine's command line that does what the "video" tells it to.

The video file ends with ``PLAN:`` and a JSON object: ``mode`` (see main), ``gate`` (a file to wait for before
the end), ``log`` (a file that gets one line at the start and one at the end of each run) and ``seconds`` of
idleness before the end.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

FILES = {"avatar.safetensors": b"avatar", "report.json": b'{"psnr": 30.0}', "surfels.ply": b"ply\n" * 1000}


def say(**event: Any) -> None:
    print(json.dumps(event), flush=True)


def note(plan: dict[str, Any], word: str, run: Path) -> None:
    with Path(plan["log"]).open("a") as log:
        log.write(f"{word} {os.getpid()} {run.name}\n")


def wait_for_gate(plan: dict[str, Any]) -> None:
    while "gate" in plan and not Path(plan["gate"]).exists():
        time.sleep(0.01)


def work_in_steps(plan: dict[str, Any], run: Path, resume: bool) -> None:
    """Ten steps with a checkpoint after each, as an engine does it; halfway it waits for the gate."""
    state = run / "checkpoint" / "state.json"
    first = json.loads(state.read_text())["next"] if resume else 0
    state.parent.mkdir(exist_ok=True)
    for step in range(first, 10):
        note(plan, f"step:{step}", run)
        written = state.with_suffix(".new")
        written.write_text(json.dumps({"next": step + 1}))
        written.replace(state)
        if step == 4:
            note(plan, "halfway", run)
            wait_for_gate(plan)
        if step >= 6 and plan.get("crash_late"):
            os.kill(os.getpid(), signal.SIGKILL)


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("command", choices=["fit"])
    parser.add_argument("video", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--json", action="store_true", required=True)
    parser.add_argument("--resume", action="store_true")
    for flag in (
        "--preset",
        "--side",
        "--seed",
        "--fov",
        "--max-frames",
        "--holdout",
        "--device",
        "--max-seconds",
    ):
        parser.add_argument(flag)
    options = parser.parse_args()
    plan: dict[str, Any] = json.loads(options.video.read_bytes().rpartition(b"PLAN:")[2])
    run: Path = options.out
    note(plan, "resume" if options.resume else "begin", run)
    note(plan, "start", run)
    say(type="progress", stage="track", fraction=0.25, time_left=3.0, message="frame 1 of 4")
    match plan["mode"]:
        case "crash":
            os.kill(os.getpid(), signal.SIGSEGV)
        case "internal":
            print("Traceback: something broke", file=sys.stderr)
            return 4
        case "reject":
            say(type="error", code="video.no_hand", message="No hand was found.", advice="Film a hand.")
            return 3
        case "arguments":
            say(type="error", code="options.seed", message="The seed is bad.", advice="Use another.")
            return 2
        case "no_device":
            say(type="error", code="device.unavailable", message="There is no GPU.", advice="Use the CPU.")
            return 2
        case "device_memory":  # enough of it only for some presets and so many frames
            setting = f"{options.preset}/{options.max_frames}"
            note(plan, f"setting:{setting}", run)
            (run / "checkpoint").mkdir(exist_ok=True)
            (run / "checkpoint" / "state.json").write_text("{}")
            say(type="warning", code="video.dark", message="The clip is dark.", advice="Use more light.")
            if setting not in plan["suffices"]:
                say(type="error", code="device.out_of_memory", message="Full.", advice="Use less.")
                return 5
        case "empty":
            return 0
        case "steps":
            work_in_steps(plan, run, options.resume)
            plan.pop("gate", None)
        case "canary":
            canary: str = plan["canary"]
            (run / "checkpoint").mkdir(exist_ok=True)
            (run / "checkpoint" / "state.json").write_text(json.dumps({"next": 1, "canary": canary}))
            (run / "tracks.json").write_text(json.dumps(canary))
            say(type="warning", code="w", message=canary, advice="")
            say(type="progress", stage="fit", fraction=0.5, time_left=1.0, message=canary)
        case "kill":
            os.kill(os.getpid(), signal.SIGKILL)
        case "memory":
            (run / "surfels.ply").write_bytes(bytes(1 << 40))
        case "fill":
            with (run / "surfels.ply").open("wb") as file:
                while True:
                    file.write(bytes(1 << 20))
        case "stubborn":
            signal.signal(signal.SIGTERM, signal.SIG_IGN)
            note(plan, "deaf", run)
        case "child":  # leaves a process behind that holds its output open
            child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
            note(plan, f"child:{child.pid}", run)
        case "environment":
            (run / "tracks.json").write_text(json.dumps({"env": dict(os.environ), "argv": sys.argv[1:]}))
        case "noise":
            sys.stdout.buffer.write(b"\xff\xfe not json\n[1, 2]\n" + b"x" * 200_000 + b"\n")
            say(type="progress", stage=7, fraction="much", time_left=float("nan"), message=None)
            say(type="progress", stage="fit", fraction=1e9, time_left=-1, message="m" * 5000)
    wait_for_gate(plan)
    time.sleep(plan.get("seconds", 0.0))
    for name, content in FILES.items():
        (run / name).write_bytes(content)
    note(plan, "end", run)
    say(type="done", report=str(run / "report.json"))
    return 0


if __name__ == "__main__":
    sys.exit(main())
