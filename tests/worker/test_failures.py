"""What happens to jobs when a worker, the broker or the queue's content goes away under them."""

from __future__ import annotations

import signal

from service.jobs.model import JobState
from tests.worker.fake_engine import FILES
from tests.worker.harness import Bench, alive, wait_for


def test_kill_9_of_a_worker_mid_job_lets_another_finish_it(bench: Bench) -> None:
    first = bench.worker().ready()
    job_id = bench.submit(gated=True)
    engine = bench.engine(job_id)
    second = bench.worker().ready()
    first.kill()
    wait_for("the kernel ended the engine of the dead worker", lambda: not alive(engine))
    other = bench.engine(job_id, 2)
    bench.open_gate(job_id)
    job = bench.until(job_id, "succeeded")
    assert job.attempt == 2
    assert bench.starts(job_id) == [engine, other]
    assert len(bench.notes(job_id, "end")) == 1
    # One set of files, that of the attempt that counts.
    assert [p.name for p in (bench.settings.data_dir / "jobs" / job_id).iterdir()] == [job.artifact]
    assert second.end() == 0


def test_a_job_that_takes_every_worker_with_it_ends_as_lost() -> None:
    bench = Bench(max_attempts=2)
    try:
        job_id = bench.submit(gated=True)
        for attempt in (1, 2):
            worker = bench.worker()
            bench.engine(job_id, attempt)
            worker.kill()
        bench.worker()
        job = bench.until(job_id, "failed")
        assert (job.error_code, job.attempt) == ("worker.lost", 2)
        assert len(bench.starts(job_id)) == 2
    finally:
        bench.close()


def test_a_stopped_worker_that_wakes_up_after_its_lease_writes_nothing(bench: Bench) -> None:
    sleeper = bench.worker().ready()
    job_id = bench.submit(gated=True)
    bench.engine(job_id)
    sleeper.signal(signal.SIGSTOP)  # its engine goes on
    bench.worker()
    bench.engine(job_id, 2)
    bench.open_gate(job_id)
    job = bench.until(job_id, "succeeded")
    assert job.attempt == 2
    sleeper.signal(signal.SIGCONT)
    wait_for("the sleeper has seen that it lost", lambda: "attempt 1 lost" in sleeper.log)
    assert bench.row(job_id).artifact == job.artifact
    assert job.artifact is not None
    assert len(bench.storage.assets(job_id, job.artifact)) == len(FILES)
    assert [p.name for p in (bench.settings.data_dir / "jobs" / job_id).iterdir()] == [job.artifact]
    assert sleeper.end() == 0


def test_sigterm_hands_the_job_to_the_next_worker_at_no_cost(bench: Bench) -> None:
    first = bench.worker().ready()
    job_id = bench.submit(gated=True)
    engine = bench.engine(job_id)
    second = bench.worker().ready()
    assert first.end() == 0
    assert not alive(engine)
    bench.engine(job_id, 2)
    bench.open_gate(job_id)
    job = bench.until(job_id, "succeeded")
    # Given back, not lost: the try that was cut short is not counted.
    assert (job.attempt, len(bench.starts(job_id))) == (1, 2)
    assert second.end() == 0
    pulses = [*(bench.settings.data_dir / "run").glob("*.alive")]
    assert pulses == []


def test_sigterm_of_the_only_worker_leaves_the_job_queued_for_the_next(bench: Bench) -> None:
    first = bench.worker().ready()
    job_id = bench.submit(gated=True)
    bench.engine(job_id)
    assert first.end() == 0
    job = bench.row(job_id)
    assert (job.state, job.attempt, job.token) == (JobState.QUEUED, 0, None)
    bench.worker()
    bench.engine(job_id, 2)
    bench.open_gate(job_id)
    bench.until(job_id, "succeeded")


def test_a_busy_worker_leaves_messages_for_others() -> None:
    bench = Bench(republish_min_seconds=600.0)  # no second message helps
    try:
        bench.worker().ready()
        long, short = bench.submit(gated=True), bench.submit()
        bench.engine(long)
        bench.worker().ready()
        bench.until(short, "succeeded")
        assert bench.row(long).state is JobState.RUNNING
        bench.open_gate(long)
        bench.until(long, "succeeded")
    finally:
        bench.close()


def test_a_queue_wiped_clean_is_refilled_from_the_table(bench: Bench) -> None:
    jobs = [bench.submit() for _ in range(3)]
    client = bench.broker_client()
    assert client.dbsize() > 0
    client.flushall()
    client.close()
    bench.worker()
    for job_id in jobs:
        bench.until(job_id, "succeeded")
        assert len(bench.starts(job_id)) == 1


def test_a_job_submitted_while_the_broker_is_down_runs_later(bench: Bench) -> None:
    worker = bench.worker().ready()
    bench.kill_broker()
    job_id = bench.job()
    assert not bench.publish(job_id)
    assert bench.row(job_id).state is JobState.QUEUED
    assert bench.broker.check()
    bench.until(job_id, "succeeded")
    assert len(bench.starts(job_id)) == 1
    assert worker.process.poll() is None


def test_kill_9_of_the_broker_does_not_disturb_a_running_job(bench: Bench) -> None:
    worker = bench.worker().ready()
    job_id, waiting = bench.submit(gated=True), bench.submit()
    engine = bench.engine(job_id)
    bench.kill_broker()
    bench.open_gate(job_id)
    bench.until(job_id, "succeeded")  # the row is written without a broker
    assert bench.broker.check()
    bench.until(waiting, "succeeded")
    assert bench.starts(job_id) == [engine]
    assert len(bench.starts(waiting)) == 1
    assert worker.end() == 0


def test_a_worker_started_without_a_broker_waits_for_it(bench: Bench) -> None:
    bench.kill_broker()
    job_id = bench.job()
    worker = bench.worker()
    wait_for("it looked for the broker", lambda: "Cannot connect" in worker.log)
    assert bench.broker.check()
    bench.until(job_id, "succeeded")


def test_the_time_limit_ends_an_engine_that_does_not() -> None:
    bench = Bench(job_timeout=8.0)
    try:
        bench.worker()
        job_id = bench.submit("stubborn", gated=True)
        engine = bench.engine(job_id)
        assert bench.until(job_id, "failed").error_code == "engine.timeout"
        assert not alive(engine)
    finally:
        bench.close()
