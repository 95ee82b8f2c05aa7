"""Two hundred short jobs while workers, engines, the broker and its content are killed at random."""

from __future__ import annotations

import os
import random
import signal
import sqlite3
import time
from contextlib import suppress

import psutil

from service.jobs.model import FINAL_STATES, JobState
from tests.worker.fake_engine import FILES
from tests.worker.harness import Bench, Worker, wait_for

SEED = 20261123
JOBS = 200
WORKERS = 3
#: Of the moments looked at, about five in a hundred bring a death.
RISK = 0.05
DEADLINE = 420.0


class Havoc:
    """Kills something now and then; what, is decided by the seed alone."""

    def __init__(self, bench: Bench, seed: int) -> None:
        self._bench = bench
        self._random = random.Random(seed)
        self.dead: dict[str, int] = {"worker": 0, "engine": 0, "broker": 0, "flush": 0, "deploy": 0}
        self.workers: list[Worker] = [bench.worker() for _ in range(WORKERS)]
        for worker in self.workers:
            worker.ready()

    def turn(self) -> None:
        """One moment: perhaps a death; whatever is dead is started again, as its supervisor would."""
        if self._random.random() < RISK:
            what = self._random.choices([*self.dead], weights=[5, 8, 2, 1, 2])[0]
            self.dead[what] += 1
            self._do(what)
        self._bench.broker.check()
        self.workers = [w if w.process.poll() is None else self._bench.worker() for w in self.workers]

    def _do(self, what: str) -> None:
        worker = self._random.choice(self.workers)
        match what:
            case "worker":
                worker.kill()
            case "deploy":
                worker.end()
            case "broker":
                self._bench.kill_broker()
            case "flush":
                with self._bench.broker_client() as client:
                    client.flushall()
            case "engine":
                with suppress(ProcessLookupError):
                    for pid in self._engines()[:1]:
                        os.kill(pid, signal.SIGKILL)

    def _engines(self) -> list[int]:
        found = []
        for worker in self.workers:
            with suppress(psutil.Error):
                found += [child.pid for child in psutil.Process(worker.process.pid).children()]
        self._random.shuffle(found)
        return found


def test_of_200_jobs_under_random_kills_none_is_lost_and_none_published_twice() -> None:
    bench = Bench(max_attempts=100, lease_seconds=3.0)
    try:
        database = sqlite3.connect(bench.settings.data_dir / "mass.sqlite3", timeout=30.0)
        # The database itself counts every publication, whoever makes it: a change to succeeded, or of what
        # a job that has succeeded shows.
        database.executescript(
            """CREATE TABLE published (id TEXT, token TEXT);
               CREATE TRIGGER count_published AFTER UPDATE ON jobs
               WHEN NEW.state = 'succeeded'
                AND (OLD.state <> 'succeeded' OR OLD.artifact IS NOT NEW.artifact)
               BEGIN INSERT INTO published VALUES (NEW.id, OLD.token); END;"""
        )
        database.commit()
        jobs = [bench.job(seconds=0.25) for _ in range(JOBS)]
        for job_id in jobs:
            bench.publish(job_id)
        havoc = Havoc(bench, SEED)
        end = time.monotonic() + DEADLINE
        left = set(jobs)
        while left:
            assert time.monotonic() < end, f"{len(left)} jobs left, {havoc.dead}\n{bench.logs()[-4000:]}"
            left = {job_id for job_id in left if bench.row(job_id).state not in FINAL_STATES}
            havoc.turn()
            time.sleep(0.05)
        published = database.execute("SELECT id FROM published").fetchall()
        database.close()
        states = [bench.row(job_id).state for job_id in jobs]
        assert states.count(JobState.SUCCEEDED) == JOBS
        assert sorted(job_id for (job_id,) in published) == sorted(jobs)
        for job_id in jobs:
            job = bench.row(job_id)
            assert job.artifact is not None
            folder = bench.settings.data_dir / "jobs" / job_id
            wait_for(
                "one result is left",
                lambda f=folder, a=job.artifact: [p.name for p in f.iterdir()] == [a],  # type: ignore[misc]
            )
            found = {a.name: a.bytes for a in bench.storage.assets(job_id, job.artifact)}
            assert found == {name: len(content) for name, content in FILES.items()}
        assert sum(havoc.dead.values()) >= 10, havoc.dead
        again = sum(bench.row(job_id).attempt > 1 for job_id in jobs)
        assert again >= 5
        print(f"{JOBS} jobs, {again} of them interrupted, deaths: {havoc.dead}")
    finally:
        bench.close()
