"""Children that cannot outlive their parent, stay within their limits, and end as a group."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

from service.processes import Backoff, launch, stop_group

LIMITS = "import resource as r; print(r.getrlimit(r.RLIMIT_NOFILE), r.getrlimit(r.RLIMIT_CORE))"


def gone(pid: int) -> bool:
    try:
        return bool(psutil.Process(pid).status() == psutil.STATUS_ZOMBIE)
    except psutil.NoSuchProcess:
        return True


def wait_until_gone(pid: int) -> None:
    deadline = time.monotonic() + 20
    while not gone(pid):
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_a_child_gets_its_limits_its_environment_and_a_session_of_its_own() -> None:
    code = f"{LIMITS}; import os; print(os.getsid(0) == os.getpid(), sorted(os.environ))"
    child = launch(
        [sys.executable, "-c", code],
        env={"ONLY": "this"},
        stdout=subprocess.PIPE,
        limits={"nofile": 123, "core": 0},
    )
    output, _ = child.communicate(timeout=20)
    assert output.decode().splitlines()[0] == "(123, 123) (0, 0)"
    assert output.decode().splitlines()[1].startswith("True")
    assert "'ONLY'" in output.decode()
    assert "PATH" not in output.decode()


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux kernels send a signal when a parent dies")
def test_a_child_dies_with_a_parent_that_is_killed(tmp_path: Path) -> None:
    note = tmp_path / "pid"
    code = (
        "import sys, time, pathlib; from service.processes import launch\n"
        "program = 'import time; print(1, flush=True); time.sleep(600)'\n"
        "child = launch([sys.executable, '-c', program], stdout=-1)\n"
        "child.stdout.readline()\n"
        f"pathlib.Path({str(note)!r}).write_text(str(child.pid)); print('ready', flush=True); time.sleep(600)"
    )
    parent = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE)
    assert parent.stdout is not None
    with parent.stdout:
        assert parent.stdout.readline() == b"ready\n"
    child = int(note.read_text())
    assert not gone(child)
    parent.kill()
    parent.wait(20)
    wait_until_gone(child)


def test_a_program_that_does_not_exist_is_an_exit_code_and_a_line() -> None:
    child = launch(["/no/such/program"], stderr=subprocess.PIPE)
    _, error = child.communicate(timeout=20)
    assert child.returncode == 127
    assert error == b"cannot start /no/such/program: No such file or directory\n"


def test_stopping_asks_first_and_then_kills_the_whole_group() -> None:
    code = (
        "import json, signal, subprocess, sys, time\n"
        "signal.signal(signal.SIGTERM, signal.SIG_IGN)\n"
        "child = subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(600)'])\n"
        "print(json.dumps(child.pid), flush=True); time.sleep(600)"
    )
    process = launch([sys.executable, "-c", code], stdout=subprocess.PIPE)
    assert process.stdout is not None
    with process.stdout:
        child = json.loads(process.stdout.readline())
    assert stop_group(process, 0.1) == -signal.SIGKILL
    wait_until_gone(child)


def test_a_polite_child_is_not_killed() -> None:
    code = (
        "import signal, sys, time; signal.signal(15, lambda *_: sys.exit(7))\n"
        "print(1, flush=True); time.sleep(600)"
    )
    process = launch([sys.executable, "-c", code], stdout=subprocess.PIPE)
    assert process.stdout is not None
    with process.stdout:
        process.stdout.readline()
    assert stop_group(process, 20.0) == 7


def test_pauses_double_up_to_a_limit_and_a_long_run_resets_them() -> None:
    backoff = Backoff(first=1.0, last=5.0)
    assert [backoff.next(0.0) for _ in range(6)] == [0.0, 1.0, 2.0, 4.0, 5.0, 5.0]
    assert [backoff.next(11.0), backoff.next(0.0)] == [0.0, 1.0]
