"""``mass serve`` and the ``mass`` command as real processes: the whole service, but for the engine."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from service.client import JobInfo, MassClient, ServiceError
from service.processes import launch
from tests.worker.fake_engine import FILES
from tests.worker.harness import DEADLINE, FAKE_ENGINE, REPOSITORY, alive, wait_for

#: The first bytes of an MP4 file, which is all the API looks at.
MP4 = b"\x00\x00\x00\x18ftypmp42\x00\x00\x00\x00mp42isom"
MASS = [sys.executable, "-m", "service.cli"]


class Served:
    """A running ``mass serve`` on a free port, and what can be asked of it."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.data = root / "data"
        self.notebook = root / "notes"
        self.notebook.mkdir(exist_ok=True)
        self.output = root / f"serve-{len([*root.glob('serve-*')])}.log"
        clean = {name: value for name, value in os.environ.items() if not name.startswith("MASS_")}
        self.environment = {
            **clean,
            "MASS_ENGINE_COMMAND": json.dumps([sys.executable, str(FAKE_ENGINE)]),
            "MASS_ENGINE_PATHS": json.dumps([str(self.notebook)]),
            "MASS_MIN_FREE_BYTES": "0",
            "MASS_LEASE_SECONDS": "4",
            "MASS_HEARTBEAT_SECONDS": "0.5",
            "MASS_RECONCILE_SECONDS": "0.5",
            "MASS_REPUBLISH_MIN_SECONDS": "1",
        }
        with self.output.open("wb") as output:
            self.process = launch(
                [*MASS, "serve", "--port", "0", "--data-dir", str(self.data)],
                cwd=REPOSITORY,
                env=self.environment,
                stdout=output,
                stderr=subprocess.STDOUT,
            )
        line = wait_for("it says that it is ready", self._ready_line, 2 * DEADLINE)
        self.url = line.group(1)
        self.family = {p.pid for p in psutil.Process(self.process.pid).children(recursive=True)}

    def _ready_line(self) -> re.Match[str] | None:
        text = self.output.read_text(errors="replace")
        assert self.process.poll() is None, text
        return re.search(r"MASS is ready on (http://127\.0\.0\.1:\d+) ", text)

    def child(self, words: str) -> int:
        """The pid of the direct child whose command line contains ``words``, once there is one."""

        def find() -> int | None:
            for process in psutil.Process(self.process.pid).children():
                try:
                    if words in " ".join(process.cmdline()):
                        return int(process.pid)
                except psutil.Error:
                    continue
            return None

        return wait_for(f"there is a {words!r} process", find)

    def video(self, mode: str = "succeed", gated: bool = False) -> Path:
        plan = {"mode": mode, "log": str(self.notebook / "engine.log")}
        if gated:
            plan["gate"] = str(self.notebook / "gate")
        path = self.root / "video.mp4"
        path.write_bytes(MP4 + b"PLAN:" + json.dumps(plan).encode())
        return path

    def starts(self) -> list[int]:
        log = self.notebook / "engine.log"
        lines = [line.split() for line in log.read_text().splitlines()] if log.exists() else []
        return [int(pid) for word, pid, _ in lines if word == "start"]

    def mass(self, *words: str) -> subprocess.CompletedProcess[str]:
        """Run the ``mass`` command against this service."""
        return subprocess.run(
            [*MASS, *words],
            cwd=REPOSITORY,
            env={**self.environment, "MASS_URL": self.url},
            capture_output=True,
            text=True,
            timeout=2 * DEADLINE,
        )

    def everyone(self) -> set[int]:
        """Every process that ever belonged to it, as far as seen."""
        self.family |= {p.pid for p in psutil.Process(self.process.pid).children(recursive=True)}
        return self.family

    def close(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()


@pytest.fixture
def root() -> Iterator[Path]:
    folder = Path(tempfile.mkdtemp(prefix="mass-e2e-", dir="/tmp"))
    yield folder
    shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture
def served(root: Path) -> Iterator[Served]:
    service = Served(root)
    yield service
    service.close()


def test_a_video_goes_in_and_its_files_come_out_then_sigterm_leaves_nothing_running(served: Served) -> None:
    seen: list[JobInfo] = []
    sent: list[tuple[int, int]] = []
    with MassClient(served.url) as client:
        video = served.video()
        job = client.submit(video, {"seed": 3}, lambda done, total: sent.append((done, total)))
        assert sent[-1] == (video.stat().st_size, video.stat().st_size)
        job = client.wait(job.id, seen.append, poll_seconds=0.05)
        assert (job.state, job.fraction, job.attempt) == ("succeeded", 1.0, 1)
        assert seen[-1] == job
        assets = client.assets(job.id)
        assert {asset.name for asset in assets} == set(FILES)
        for asset in assets:
            path = client.download(job.id, asset, served.root / "out")
            assert path.read_bytes() == FILES[asset.name]
        assert [found.id for found in client.jobs()] == [job.id]
        client.delete(job.id)
        with pytest.raises(ServiceError) as refusal:
            client.job(job.id)
        assert (refusal.value.status, refusal.value.code) == (404, "job.not_found")
    assert [*served.data.rglob(f"*{job.id}*")] == []
    everyone = served.everyone()
    assert len(everyone) >= 3
    served.process.terminate()
    assert served.process.wait(DEADLINE) == 0
    assert [pid for pid in everyone if alive(pid)] == []


def test_each_part_is_started_again_when_it_is_killed(served: Served) -> None:
    with MassClient(served.url) as client:
        job = client.submit(served.video(gated=True))
        wait_for("the engine has started", served.starts)
        for words in ("-m worker", "service.cli api", "broker.sock"):
            pid = served.child(words)
            os.kill(pid, signal.SIGKILL)
            wait_for(f"{words} runs again", lambda words=words, pid=pid: served.child(words) != pid)  # type: ignore[misc]
        (served.notebook / "gate").touch()
        job = client.wait(job.id, poll_seconds=0.1)
        assert (job.state, job.attempt) == ("succeeded", 2)
        assert len(served.starts()) == 2
        # The queue works again as well, without the reconciler's help or with it.
        job = client.wait(client.submit(served.video()).id, poll_seconds=0.1)
        assert (job.state, job.attempt) == ("succeeded", 1)


def test_kill_9_of_the_supervisor_ends_all_and_the_next_one_finishes_the_job(root: Path) -> None:
    first = Served(root)
    second = None
    try:
        with MassClient(first.url) as client:
            job = client.submit(first.video(gated=True))
        wait_for("the engine has started", first.starts)
        everyone = first.everyone()
        first.close()
        wait_for("all of its processes are gone", lambda: not [pid for pid in everyone if alive(pid)])
        (root / "notes" / "gate").touch()
        second = Served(root)
        with MassClient(second.url) as client:
            assert client.wait(job.id, poll_seconds=0.1).state == "succeeded"
        assert len(first.starts()) == 2
    finally:
        first.close()
        if second is not None:
            second.close()


def test_the_command_line_from_submit_to_delete(served: Served) -> None:
    submitted = served.mass("submit", str(served.video()), "--option", "preset=draft", "--wait")
    assert submitted.returncode == 0, submitted.stderr
    job_id = submitted.stdout.strip()
    assert "succeeded 100%" in submitted.stderr
    assert f"{job_id}  succeeded" in served.mass("status", job_id).stdout
    assert served.mass("list").stdout.count("\n") == 1
    out = served.root / "files"
    assert served.mass("download", job_id, "surfels.ply", "--out", str(out)).returncode == 0
    assert [path.name for path in out.iterdir()] == ["surfels.ply"]
    missing = served.mass("download", job_id, "secret.txt", "--out", str(out))
    assert (missing.returncode, "avatar.safetensors" in missing.stderr) == (1, True)
    failed = served.mass("submit", str(served.video("reject")), "-w")
    assert failed.returncode == 3
    assert "No hand was found. [video.no_hand]\n      Film a hand." in failed.stderr
    refused = served.mass("submit", str(served.video()), "-o", "side=middle")
    assert (refused.returncode, "[options.invalid]" in refused.stderr) == (1, True)
    assert served.mass("delete", job_id).returncode == 0
    assert "[job.not_found]" in served.mass("status", job_id).stderr

    # A second service on the same data, or on the same port, says what is wrong and touches nothing.
    second = served.mass("serve", "--port", "0", "--data-dir", str(served.data))
    assert (second.returncode, f"process {served.process.pid}" in second.stderr) == (1, True)
    port = served.url.rpartition(":")[2]
    second = served.mass("serve", "--port", port, "--data-dir", str(served.root / "other"))
    assert (second.returncode, f"Port {port} on 127.0.0.1 is in use." in second.stderr) == (1, True)


def test_commands_without_a_service_say_so() -> None:
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))  # bound, not listening: connections are refused
        url = f"http://127.0.0.1:{unused.getsockname()[1]}"
        done = subprocess.run(
            [*MASS, "list", "--url", url], cwd=REPOSITORY, capture_output=True, text=True, timeout=DEADLINE
        )
    assert (done.returncode, "[client.unreachable]" in done.stderr) == (1, True)
    assert "mass serve" in done.stderr
