"""The lease, the reconciler and the supervisor's odd corners, with a clock and a database under control."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import pytest
from sqlalchemy.exc import OperationalError

from service.jobs.leases import Claim, Heartbeat
from service.jobs.model import JobState, new_job_id
from service.jobs.store import JobStore, create_store
from service.pulse import is_fresh, live_workers, pulse_path, sweep_pulses
from service.queue import JobQueue
from service.settings import Settings
from service.storage import Storage, create_storage
from worker.engine import UnknownOptionError, fit_command
from worker.reconciler import Reconciler
from worker.supervisor import Lease, Outcome, Supervisor


class Clock:
    def __init__(self) -> None:
        self.now = 1000.0

    def __call__(self) -> float:
        return self.now


class Flaky:
    """A store that can be made unreachable."""

    def __init__(self, store: JobStore) -> None:
        self._store = store
        self.away = False
        self.calls: list[str] = []

    def __getattr__(self, name: str) -> Any:
        self.calls.append(name)
        if self.away:
            raise OperationalError("select", {}, Exception("database is locked"))
        return getattr(self._store, name)


class Queue(JobQueue):
    """Remembers what was published; can be away."""

    def __init__(self) -> None:
        self.sent: list[str] = []
        self.tried = 0
        self.away = False

    def publish(self, job_id: str, queue: str | None = None) -> bool:
        self.tried += 1
        if not self.away:
            self.sent.append(job_id)
        return not self.away


class World:
    def __init__(self, folder: Path) -> None:
        self.settings = Settings(data_dir=folder, lease_seconds=60, heartbeat_seconds=10, min_free_bytes=0)
        self.clock = Clock()
        self.real = create_store(self.settings, clock=self.clock)
        self.flaky = Flaky(self.real)
        self.store = cast(JobStore, self.flaky)
        self.storage: Storage = create_storage(self.settings)
        self.queue = Queue()
        self.reconciler = Reconciler(self.settings, self.store, self.storage, self.queue)

    def job(self) -> str:
        job_id = new_job_id()
        self.storage.begin_upload(job_id).write_bytes(b"video")
        self.real.create({}, self.storage.finish_upload(job_id), job_id=job_id)
        return job_id

    def claim(self) -> tuple[Claim, Lease]:
        since = self.clock()
        claim = self.real.claim(self.job(), lease_seconds=60)
        assert claim is not None
        return claim, Lease(self.store, claim, self.settings, since, self.clock)

    def state(self, job_id: str) -> JobState:
        job = self.real.get(job_id)
        assert job is not None
        return job.state


@pytest.fixture
def world(tmp_path: Path) -> Iterator[World]:
    world = World(tmp_path)
    yield world
    world.real.close()


def test_a_lease_is_renewed_every_heartbeat_and_no_more(world: World) -> None:
    _, lease = world.claim()
    for _ in range(400):  # 100 s in quarter seconds
        world.clock.now += 0.25
        assert lease.check() is Heartbeat.OK
    assert world.flaky.calls.count("heartbeat") == 10
    assert 80 <= world.flaky.calls.count("get") <= 101


def test_a_cancellation_is_seen_within_a_second(world: World) -> None:
    claim, lease = world.claim()
    assert lease.check() is Heartbeat.OK
    world.real.request_cancel(claim.job_id)
    answers = []
    for _ in range(5):
        world.clock.now += 0.25
        answers.append(lease.check())
    assert Heartbeat.CANCEL in answers


def test_a_deleted_job_is_seen_as_cancelled(world: World) -> None:
    claim, lease = world.claim()
    world.real.delete(claim.job_id)
    world.clock.now += 1.0
    assert lease.check() is Heartbeat.CANCEL


def test_a_lease_taken_by_another_is_seen_as_lost(world: World) -> None:
    claim, lease = world.claim()
    world.clock.now += 61.0
    assert world.real.claim(claim.job_id) is not None
    assert lease.check() is Heartbeat.LOST


def test_a_database_that_is_away_is_waited_for_until_the_lease_has_run_out(world: World) -> None:
    _, lease = world.claim()
    world.flaky.away = True
    world.clock.now += 59.0
    assert lease.check() is Heartbeat.OK
    world.flaky.away = False
    world.clock.now += 1.0
    assert lease.check() is Heartbeat.OK  # renewed late, but nobody had taken it
    world.flaky.away = True
    world.clock.now += 60.0
    assert lease.check() is Heartbeat.LOST


def test_reconciling_publishes_what_is_due_once_per_pause(world: World) -> None:
    job_id = world.job()
    world.clock.now += 3.0
    for _ in range(5):
        world.reconciler.tick()
    assert world.queue.sent == [job_id]
    world.clock.now += 60.0
    world.reconciler.tick()
    world.clock.now += 60.0  # the second pause is twice as long
    world.reconciler.tick()
    assert world.queue.sent == [job_id, job_id]


def test_a_broker_that_is_away_is_tried_once_a_round_and_nothing_is_marked_sent(world: World) -> None:
    jobs = [world.job() for _ in range(3)]
    world.clock.now += 3.0
    world.queue.away = True
    world.reconciler.tick()
    assert (world.queue.tried, world.queue.sent) == (1, [])
    world.queue.away = False
    world.reconciler.tick()
    assert sorted(world.queue.sent) == sorted(jobs)


def test_of_two_reconcilers_with_the_same_list_one_sends(world: World) -> None:
    job_id = world.job()
    world.clock.now += 3.0
    other = Reconciler(world.settings, world.store, world.storage, world.queue)
    overdue = world.real.due_for_publish()
    world.reconciler.tick()
    world.flaky.due_for_publish = lambda: overdue  # type: ignore[attr-defined]  # read before the other sent
    other.tick()
    assert world.queue.sent == [job_id]


def test_a_silent_worker_loses_its_job(world: World) -> None:
    claim, _ = world.claim()
    world.clock.now += 59.0
    world.reconciler.tick()
    assert world.state(claim.job_id) is JobState.RUNNING
    world.clock.now += 2.0
    world.reconciler.tick()
    assert world.state(claim.job_id) is JobState.QUEUED
    assert world.queue.sent == [claim.job_id]


def test_a_round_that_fails_is_logged_and_the_next_one_works(
    world: World, caplog: pytest.LogCaptureFixture
) -> None:
    job_id = world.job()
    world.clock.now += 3.0
    world.flaky.away = True
    world.reconciler.tick()
    assert "reconciler: _publish failed" in caplog.text
    world.flaky.away = False
    world.reconciler.tick()
    assert world.queue.sent == [job_id]


def test_the_reconciler_stops_when_told(world: World) -> None:
    stopping = threading.Event()
    thread = threading.Thread(target=world.reconciler.run, args=(stopping,))
    thread.start()
    stopping.set()
    thread.join(20)
    assert not thread.is_alive()


def test_a_stopping_worker_passes_messages_on(world: World) -> None:
    stopping = threading.Event()
    stopping.set()
    supervisor = Supervisor(world.settings, world.store, world.storage, world.queue, stopping)
    job_id = world.job()
    assert supervisor.run(job_id) is Outcome.REFUSED
    assert world.queue.sent == [job_id]
    assert world.state(job_id) is JobState.QUEUED


def test_a_video_that_vanished_ends_the_job_after_its_attempts(world: World) -> None:
    settings = world.settings.model_copy(update={"engine_command": ["/no/such/engine"]})
    supervisor = Supervisor(settings, world.store, world.storage, world.queue, threading.Event())
    job_id = world.job()
    outcomes = [supervisor.run(job_id) for _ in range(4)]
    assert outcomes == [Outcome.RELEASED, Outcome.RELEASED, Outcome.FAILED, Outcome.SKIPPED]
    job = world.real.get(job_id)
    assert job is not None
    assert job.error_code == "engine.crashed"
    assert job.error_message == "The engine stopped unexpectedly (exit code 127). It was tried 3 times."
    assert world.queue.sent == [job_id, job_id]


def test_a_failure_of_the_worker_itself_gives_the_job_back(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> Path:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(world.storage, "attempt_dir", full)
    supervisor = Supervisor(world.settings, world.store, world.storage, world.queue, threading.Event())
    job_id = world.job()
    assert [supervisor.run(job_id) for _ in range(3)] == [Outcome.RELEASED, Outcome.RELEASED, Outcome.FAILED]
    job = world.real.get(job_id)
    assert job is not None
    assert job.error_code == "worker.failed"


def test_no_option_can_become_another_flag_or_the_video() -> None:
    command = fit_command(["engine"], Path("/v"), Path("/r"), {"side": "--out=/etc", "seed": 1, "fov": None})
    assert command == ["engine", "fit", "/v", "--out", "/r", "--json", "--side=--out=/etc", "--seed=1"]
    with pytest.raises(UnknownOptionError, match="'out'"):
        fit_command(["engine"], Path("/v"), Path("/r"), {"out": "/etc"})


def test_live_workers_are_those_with_a_recent_pulse(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    here, there = pulse_path(tmp_path, 7, "here"), pulse_path(tmp_path, 8, "there")
    assert live_workers(tmp_path) == []
    here.touch()
    there.touch()
    assert live_workers(tmp_path) == ["here-7", "there-8"]
    assert live_workers(tmp_path, host="here") == ["here-7"]
    assert live_workers(tmp_path, max_age=-1.0) == []
    sweep_pulses(tmp_path)
    os.utime(there, (0.0, 0.0))
    sweep_pulses(tmp_path)
    assert (here.exists(), there.exists()) == (True, False)
    assert is_fresh(here)
    assert not is_fresh(here, -1.0)
