"""The rest of the failure matrix: the API, the queue's content, the disk and the database go away."""

from __future__ import annotations

import shutil
import signal
import sqlite3
import subprocess
import sys
import threading

import httpx

from service.jobs.model import JobState
from tests.worker.api_process import api
from tests.worker.harness import DEADLINE, REPOSITORY, Bench, wait_for


def _rows(bench: Bench) -> list[str]:
    jobs, _ = bench.store.page()
    return [job.id for job in jobs]


def test_kill_9_of_the_api_between_commit_and_message_loses_nothing(bench: Bench) -> None:
    bench.worker().ready()
    assert bench.broker.process is not None
    with api(bench) as running:
        # The broker accepts connections and answers nothing, so the API hangs in sending its message.
        bench.broker.process.send_signal(signal.SIGSTOP)

        def submit() -> None:
            with httpx.Client(base_url=running.url, timeout=60.0, trust_env=False) as http:
                try:
                    http.post("/jobs", files={"video": ("clip.mp4", running.video("lost"))})
                except httpx.TransportError:
                    return  # nobody answered: the client cannot know

        client = threading.Thread(target=submit)
        client.start()
        (job_id,) = wait_for("the row is committed", lambda: _rows(bench))
        running.kill()
        client.join(DEADLINE)
        assert bench.row(job_id).last_published_at is None
        bench.broker.process.send_signal(signal.SIGCONT)
        bench.until(job_id, "succeeded")
        assert running.starts("lost") == 1


def test_a_job_is_accepted_while_the_broker_is_away_and_runs_once_when_it_is_back(bench: Bench) -> None:
    with api(bench) as running:
        bench.worker().ready()
        bench.kill_broker()
        answer = running.submit("away")
        assert answer.status_code == 202
        job_id = answer.json()["id"]
        assert bench.broker.check()
        bench.until(job_id, "succeeded")
        assert running.starts("away") == 1


def test_an_accepted_job_outlives_the_api(bench: Bench) -> None:
    with api(bench) as running:
        job_id = running.submit("accepted").json()["id"]
        running.kill()
        bench.worker()
        bench.until(job_id, "succeeded")
        assert running.starts("accepted") == 1


def test_flushall_under_a_running_job_and_a_full_queue_loses_and_doubles_nothing(bench: Bench) -> None:
    bench.worker().ready()
    running = bench.submit(gated=True)
    waiting = [bench.submit() for _ in range(5)]
    bench.engine(running)
    client = bench.broker_client()
    client.flushall()
    client.close()
    bench.open_gate(running)
    for job_id in (running, *waiting):
        bench.until(job_id, "succeeded")
        assert len(bench.starts(job_id)) == 1


def test_a_broker_that_lost_its_files_is_refilled_from_the_table(bench: Bench) -> None:
    jobs = [bench.submit() for _ in range(3)]
    bench.kill_broker()
    shutil.rmtree(bench.settings.data_dir / "broker" / "appendonlydir")
    assert bench.broker.check()
    assert bench.broker_client().dbsize() == 0
    bench.worker()
    for job_id in jobs:
        bench.until(job_id, "succeeded")
        assert len(bench.starts(job_id)) == 1


def test_twenty_messages_to_two_workers_are_one_run(bench: Bench) -> None:
    for _ in range(2):
        bench.worker()
    for worker in bench.workers:
        worker.ready()
    job_id = bench.job(gated=True)
    for _ in range(20):
        assert bench.queue.publish(job_id)
    bench.engine(job_id)
    # Both queues are empty once the job behind the duplicates is done.
    after = bench.submit()
    bench.until(after, "succeeded")
    bench.open_gate(job_id)
    bench.until(job_id, "succeeded")
    last = bench.submit()
    bench.until(last, "succeeded")
    assert len(bench.starts(job_id)) == 1


def test_a_locked_database_is_waited_for(bench: Bench) -> None:
    bench.worker().ready()
    job_id = bench.submit(gated=True)
    bench.engine(job_id)
    lock = sqlite3.connect(bench.settings.data_dir / "mass.sqlite3", isolation_level=None)
    lock.execute("BEGIN EXCLUSIVE")
    bench.open_gate(job_id)
    wait_for("the engine has ended", lambda: bench.notes(job_id, "end"))
    lock.execute("ROLLBACK")
    lock.close()
    assert bench.until(job_id, "succeeded").attempt == 1
    assert len(bench.starts(job_id)) == 1


def test_a_full_disk_leaves_a_job_waiting_or_failed_and_nothing_half_done() -> None:
    # A file system of a few megabytes, in a mount namespace of its own, so that anyone may make it.
    done = subprocess.run(
        ["unshare", "--user", "--map-root-user", "--mount", sys.executable, "-m", "tests.worker.full_disk"],
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
        timeout=4 * DEADLINE,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.splitlines()[-1] == "a full disk: all as expected"


def test_a_worker_takes_only_from_its_queues() -> None:
    bench = Bench(worker_queues=["cpu"])
    try:
        bench.worker().ready()
        for_gpu = bench.submit(queue="gpu")
        bench.until(bench.submit(), "succeeded")
        assert bench.row(for_gpu).state is JobState.QUEUED
        bench.worker(MASS_WORKER_QUEUES='["gpu"]')
        bench.until(for_gpu, "succeeded")
        assert "attempt 1 starts" in bench.workers[1].log
    finally:
        bench.close()
