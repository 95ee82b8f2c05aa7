"""A service without its API: a real broker, the real store, and worker processes to start and kill."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import psutil
import redis

from service.embedded import EmbeddedBroker
from service.jobs.model import Job, new_job_id
from service.jobs.store import create_store
from service.processes import launch
from service.pulse import is_fresh, pulse_path
from service.queue import create_queue
from service.settings import Settings
from service.storage import create_storage

FAKE_ENGINE = Path(__file__).with_name("fake_engine.py")
REPOSITORY = Path(__file__).resolve().parents[2]
#: Enough for a loaded two-core machine; reaching it is a failure, never a measurement.
DEADLINE = 40.0

T = TypeVar("T")


def wait_for(what: str, condition: Callable[[], T | None], deadline: float = DEADLINE) -> T:
    """Poll until ``condition`` is true and return its value; fail with ``what`` at the deadline."""
    end = time.monotonic() + deadline
    while True:
        value = condition()
        if value:
            return value
        assert time.monotonic() < end, f"timed out waiting until {what}"
        time.sleep(0.02)


def alive(pid: int) -> bool:
    """Whether the process runs (one that waits to be reaped does not)."""
    try:
        return bool(psutil.Process(pid).status() != psutil.STATUS_ZOMBIE)
    except psutil.NoSuchProcess:
        return False


class Worker:
    """A ``python -m worker`` process."""

    def __init__(self, settings: Settings, environment: dict[str, str], log: Path) -> None:
        self._settings = settings
        self._log = log
        with log.open("wb") as output:
            self.process = launch(
                [sys.executable, "-m", "worker"],
                cwd=REPOSITORY,
                env=environment,
                stdout=output,
                stderr=subprocess.STDOUT,
            )

    @property
    def log(self) -> str:
        return self._log.read_text(errors="replace")

    def ready(self) -> Worker:
        """Wait until it takes jobs."""

        def check() -> bool:
            assert self.process.poll() is None, self.log
            return is_fresh(pulse_path(self._settings.data_dir, self.process.pid))

        wait_for("the worker is ready", check)
        return self

    def signal(self, number: signal.Signals) -> None:
        self.process.send_signal(number)

    def kill(self) -> None:
        """kill -9 of the worker alone; what becomes of its engine is the kernel's business."""
        self.process.kill()
        self.process.wait(DEADLINE)

    def end(self) -> int:
        """SIGTERM, as a deploy does; returns the exit code."""
        if self.process.poll() is None:
            self.process.terminate()
        return self.process.wait(DEADLINE)


class Bench:
    """The machinery of one test, in a short private directory (a unix socket's path is limited)."""

    def __init__(self, **overrides: Any) -> None:
        self.root = Path(tempfile.mkdtemp(prefix="mass-test-", dir="/tmp"))
        #: The only folder here that engines may write besides their run directories.
        self.notebook = self.root / "notes"
        self.notebook.mkdir()
        values: dict[str, Any] = {
            "data_dir": self.root / "data",
            "engine_command": [sys.executable, str(FAKE_ENGINE)],
            "lease_seconds": 4.0,
            "heartbeat_seconds": 0.5,
            "reconcile_seconds": 0.5,
            "republish_min_seconds": 1.0,
            "min_free_bytes": 0,
            "engine_paths": [self.notebook],
            **overrides,
        }
        self.broker = EmbeddedBroker(values["data_dir"])
        self.broker.start()
        self.settings = Settings(redis_url=self.broker.url, **values)
        self.store = create_store(self.settings)
        self.storage = create_storage(self.settings)
        self.queue = create_queue(self.settings)
        self.workers: list[Worker] = []

    def close(self) -> None:
        for worker in self.workers:
            if worker.process.poll() is None:
                worker.signal(signal.SIGCONT)
                worker.kill()
        self.queue.close()
        self.store.close()
        self.broker.stop()
        shutil.rmtree(self.root, ignore_errors=True)

    def environment(self) -> dict[str, str]:
        """The settings as the environment of a child, with a secret the engine must not see."""
        environment = {name: value for name, value in os.environ.items() if not name.startswith("MASS_")}
        for name in self.settings.model_fields_set:
            value = getattr(self.settings, name)
            text = json.dumps(value, default=str) if isinstance(value, list) else str(value)
            environment[f"MASS_{name.upper()}"] = text
        return {**environment, "CANARY_SECRET": "c4n4ry"}

    def worker(self, **environment: str) -> Worker:
        """Start one more worker process; not waited for."""
        log = self.root / f"worker-{len(self.workers)}.log"
        self.workers.append(Worker(self.settings, {**self.environment(), **environment}, log))
        return self.workers[-1]

    def kill_broker(self) -> None:
        """kill -9 of the broker; ``broker.check()`` starts it again over the same files."""
        assert self.broker.process is not None
        self.broker.process.kill()
        self.broker.process.wait(DEADLINE)

    def broker_client(self) -> redis.Redis:
        return redis.Redis(unix_socket_path=str(self.broker.socket))

    # Jobs

    def job(
        self,
        mode: str = "succeed",
        gated: bool = False,
        options: dict[str, Any] | None = None,
        queue: str = "cpu",
        restarted_from: str | None = None,
        **more: Any,
    ) -> str:
        """A queued row with its video, not published. ``gated``: the engine waits for :meth:`open_gate`."""
        job_id = new_job_id()
        plan = {"mode": mode, "log": str(self.notebook / f"{job_id}.log"), **more}
        if gated:
            plan["gate"] = str(self.notebook / f"{job_id}.gate")
        self.storage.begin_upload(job_id).write_bytes(b"PLAN:" + json.dumps(plan).encode())
        video = self.storage.finish_upload(job_id)
        self.store.create(options or {}, video, job_id=job_id, queue=queue, restarted_from=restarted_from)
        return job_id

    def submit_file(self, video: Path) -> str:
        """Submit a real video file."""
        job_id = new_job_id()
        shutil.copy(video, self.storage.begin_upload(job_id))
        self.store.create({}, self.storage.finish_upload(job_id), job_id=job_id)
        assert self.publish(job_id)
        return job_id

    def publish(self, job_id: str) -> bool:
        """What the API does after creating the row."""
        return self.queue.publish(job_id, self.row(job_id).queue) and self.store.mark_published(job_id)

    def submit(self, mode: str = "succeed", gated: bool = False, **more: Any) -> str:
        job_id = self.job(mode, gated, **more)
        assert self.publish(job_id)
        return job_id

    def open_gate(self, job_id: str) -> None:
        (self.notebook / f"{job_id}.gate").touch()

    def notes(self, job_id: str, word: str) -> list[tuple[int, str]]:
        """(pid, attempt directory) of each time the engine wrote ``word`` about the job."""
        log = self.notebook / f"{job_id}.log"
        lines = [line.split() for line in log.read_text().splitlines()] if log.exists() else []
        return [(int(pid), run) for what, pid, run in lines if what == word]

    def starts(self, job_id: str) -> list[int]:
        """The pids of the engines started for the job."""
        return [pid for pid, _ in self.notes(job_id, "start")]

    def row(self, job_id: str) -> Job:
        job = self.store.get(job_id)
        assert job is not None
        return job

    def when(
        self, job_id: str, what: str, condition: Callable[[Job], bool], deadline: float = DEADLINE
    ) -> Job:
        """Wait until the row meets ``condition``; a job that ends without meeting it fails at once."""

        def check() -> Job | None:
            job = self.row(job_id)
            if condition(job):
                return job
            assert job.finished_at is None, f"{job.state} {job.error_code} {job.error_message}"
            return None

        try:
            return wait_for(f"job {job_id} {what}", check, deadline)
        except AssertionError as error:
            raise AssertionError(f"{error}\n{self.logs()}") from None

    def until(self, job_id: str, state: str, deadline: float = DEADLINE) -> Job:
        """Wait for a state."""
        return self.when(job_id, f"is {state}", lambda job: job.state == state, deadline)

    def words(self, job_id: str) -> list[str]:
        """All that its engines wrote, in order."""
        log = self.notebook / f"{job_id}.log"
        return [line.split()[0] for line in log.read_text().splitlines()] if log.exists() else []

    def engine(self, job_id: str, number: int = 1) -> int:
        """Wait for the ``number``-th start of the job's engine; returns its pid."""
        return wait_for(f"engine {number} started", lambda: self.starts(job_id)[number - 1 : number])[0]

    def logs(self) -> str:
        return "\n".join(f"--- worker {i}\n{worker.log}" for i, worker in enumerate(self.workers))
