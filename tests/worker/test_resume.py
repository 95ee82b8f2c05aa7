"""An attempt that was cut short is gone on with, from the checkpoint of the engine and nowhere else."""

from __future__ import annotations

import os
import signal

from tests.worker.harness import Bench, alive, wait_for


def _steps(bench: Bench, job_id: str) -> list[int]:
    return [int(word.partition(":")[2]) for word in bench.words(job_id) if word.startswith("step:")]


def _begun(bench: Bench, job_id: str) -> list[str]:
    return [word for word in bench.words(job_id) if word in ("begin", "resume")]


def _halfway(bench: Bench, job_id: str, times: int = 1) -> None:
    wait_for("it is halfway", lambda: bench.words(job_id).count("halfway") == times)


def test_after_kill_9_of_the_worker_another_goes_on_from_the_checkpoint(bench: Bench) -> None:
    first = bench.worker().ready()
    job_id = bench.submit("steps", gated=True)
    _halfway(bench, job_id)
    bench.worker().ready()
    first.kill()
    bench.engine(job_id, 2)
    job = bench.until(job_id, "succeeded")
    assert job.attempt == 2
    assert _begun(bench, job_id) == ["begin", "resume"]
    assert _steps(bench, job_id) == [*range(10)]  # none twice, none left out
    assert [p.name for p in (bench.settings.data_dir / "jobs" / job_id).iterdir()] == [job.artifact]


def test_after_kill_9_of_the_engine_the_same_worker_goes_on_from_the_checkpoint(bench: Bench) -> None:
    bench.worker()
    job_id = bench.submit("steps", gated=True)
    _halfway(bench, job_id)
    os.kill(bench.engine(job_id), signal.SIGKILL)
    job = bench.until(job_id, "succeeded")
    assert job.attempt == 2
    assert _begun(bench, job_id) == ["begin", "resume"]
    assert _steps(bench, job_id) == [*range(10)]


def test_a_deploy_costs_neither_an_attempt_nor_a_step(bench: Bench) -> None:
    first = bench.worker().ready()
    job_id = bench.submit("steps", gated=True)
    _halfway(bench, job_id)
    assert first.end() == 0
    bench.worker()
    job = bench.until(job_id, "succeeded")
    assert job.attempt == 1
    assert _begun(bench, job_id) == ["begin", "resume"]
    assert _steps(bench, job_id) == [*range(10)]


def test_a_checkpoint_that_kills_the_engine_is_given_up(bench: Bench) -> None:
    bench.worker()
    job_id = bench.submit("steps", crash_late=True)
    job = bench.until(job_id, "failed")
    assert (job.error_code, job.attempt) == ("engine.crashed", 3)
    # The second try goes on and dies, so the third begins at the beginning.
    assert _begun(bench, job_id) == ["begin", "resume", "begin"]


def test_an_engine_whose_worker_is_stopped_cannot_write_into_the_next_attempt(bench: Bench) -> None:
    sleeper = bench.worker().ready()
    job_id = bench.submit("steps", gated=True)
    _halfway(bench, job_id)
    zombie = bench.engine(job_id)
    sleeper.signal(signal.SIGSTOP)
    bench.worker()
    job = bench.until(job_id, "succeeded")  # the checkpoint is past the gate
    assert _begun(bench, job_id) == ["begin", "resume"]
    assert _steps(bench, job_id) == [*range(10)]
    bench.open_gate(job_id)
    # Its directory was taken away: it fails at its next step, whatever that is.
    wait_for("the engine without a directory has ended", lambda: not alive(zombie))
    sleeper.signal(signal.SIGCONT)
    wait_for("the sleeper has seen that it lost", lambda: "attempt 1 lost" in sleeper.log)
    folder = bench.settings.data_dir / "jobs" / job_id
    wait_for("one directory is left", lambda: [p.name for p in folder.iterdir()] == [job.artifact])
    assert bench.row(job_id).artifact == job.artifact


def test_a_restarted_job_goes_on_from_what_the_first_one_left(bench: Bench) -> None:
    bench.worker()
    first = bench.submit("steps", gated=True)
    _halfway(bench, first)
    bench.store.request_cancel(first)
    bench.until(first, "cancelled")
    second = bench.job("steps", restarted_from=first)
    assert bench.storage.share_checkpoint(first, second)
    bench.publish(second)
    assert bench.until(second, "succeeded").attempt == 1
    assert (_begun(bench, second), _steps(bench, second)) == (["resume"], [*range(5, 10)])
