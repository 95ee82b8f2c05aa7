"""Leases: how a worker gets a job, what it may write while the token is its own, and what becomes of a job
whose worker went silent. How a state changes is table.py's business."""

from __future__ import annotations

import time
import uuid
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from sqlalchemy import Engine, and_, func, or_, select, update

from service.jobs import journal
from service.jobs.model import Job, JobKind, JobState
from service.jobs.table import JobTable, held, unheld

LOST_ADVICE = "Submit the video again; if it fails the same way, try a shorter or smaller clip."


@dataclass(frozen=True)
class Claim:
    """The right to work on a job until the lease ends. ``video`` is relative to the data directory.

    ``restarted_from`` and ``from_stage``: begin at that stage with that job's checkpoints, if it left any.
    """

    job_id: str
    token: str
    attempt: int
    options: dict[str, Any]
    video: str
    restarted_from: str | None = None
    from_stage: str | None = None
    traceparent: str | None = None
    queue: str = "cpu"
    kind: str = JobKind.FIT

    @property
    def artifact(self) -> str:
        """The directory name reserved for this attempt's output."""
        return f"{self.attempt}-{self.token}"


class Heartbeat(StrEnum):
    """What the worker should do next."""

    OK = "ok"  # go on, the lease is renewed
    CANCEL = "cancel"  # stop the engine, then finish_cancel; the lease is renewed
    LOST = "lost"  # somebody else has the job, or it is gone: stop and write nothing


class LeasedJobs(JobTable):
    """What workers may do with jobs; every method is one short transaction of its own."""

    def __init__(
        self, engine: Engine, *, max_attempts: int = 3, clock: Callable[[], float] = time.time
    ) -> None:
        super().__init__(engine, clock)
        self._max_attempts = max_attempts

    def claim(self, job_id: str, token: str | None = None, lease_seconds: float = 60.0) -> Claim | None:
        """Take a queued job, or one whose lease has run out. Of any number of callers exactly one gets it.

        None: somebody has it, it is over, cancelled or unknown, or its attempts are used up. Progress starts
        again at zero with each attempt.
        """
        now = self._clock()
        token = token or uuid.uuid4().hex
        expired = and_(Job.state == JobState.RUNNING, Job.lease_until < now)
        begin: dict[str, Any] = {
            **unheld(now),
            "token": token,
            "lease_until": now + lease_seconds,
            "claimed_at": now,
            "attempt": Job.attempt + 1,
            "started_at": func.coalesce(Job.started_at, now),
            "stage": None,
            "stage_since": None,
            "fraction": 0.0,
            "message": "",
            "warnings": [],
        }
        free = or_(Job.state == JobState.QUEUED, expired)
        taken = self._move(
            JobState.RUNNING, Job.id == job_id, Job.attempt < self._max_attempts, free, **begin
        )
        if not taken:
            return None
        job = taken[0]
        return Claim(
            job_id,
            token,
            job.attempt,
            job.options,
            job.video,
            job.restarted_from,
            job.from_stage,
            job.traceparent,
            job.queue,
            job.kind,
        )

    def heartbeat(self, job_id: str, token: str, lease_seconds: float = 60.0) -> Heartbeat:
        """Renew the lease and learn whether to go on."""
        statement = (
            update(Job)
            .where(Job.id == job_id, *held(token))
            .values(lease_until=self._clock() + lease_seconds)
            .returning(Job.state)
            .execution_options(synchronize_session=False)
        )
        with self._session.begin() as session:
            state = session.scalar(statement)
        if state is None:
            return Heartbeat.LOST
        return Heartbeat.CANCEL if state == JobState.CANCELLING else Heartbeat.OK

    def report_progress(
        self,
        job_id: str,
        token: str,
        stage: str,
        fraction: float,
        time_left: float | None = None,
        message: str = "",
    ) -> bool:
        """Write progress; a report behind the one already there changes nothing but is no error."""
        fraction = min(max(fraction, 0.0), 1.0)
        newer = self._progress(
            Job.id == job_id,
            *held(token),
            Job.fraction <= fraction,
            stage=stage,
            fraction=fraction,
            time_left=time_left,
            message=message,
        )
        return newer or self._holds(job_id, token)

    def log(self, job_id: str, token: str, lines: Sequence[str]) -> bool:
        """Keep lines that the engine said, for the job's owner to read. False when fenced out."""
        with self._session.begin() as session:
            job = session.scalar(select(Job).where(Job.id == job_id, *held(token)).with_for_update())
            if job is None:
                return False
            journal.write_lines(session, job, lines, self._clock())
        return True

    def report_warnings(self, job_id: str, token: str, warnings: list[dict[str, str]]) -> bool:
        """All that the engine has warned of so far. False when fenced out."""
        return self._update(Job.id == job_id, *held(token), warnings=warnings)

    def succeed(self, job_id: str, token: str, artifact: str) -> bool:
        """Publish ``artifact`` (a directory name, already on disk). False when fenced out or cancelled."""
        done = {"artifact": artifact, "fraction": 1.0}
        return bool(self._finish(JobState.SUCCEEDED, Job.id == job_id, *held(token), **done))

    def fail(self, job_id: str, token: str, code: str, message: str, advice: str) -> bool:
        """End the job with an error for its owner; one being cancelled ends as cancelled. False when
        fenced out."""
        error = {"error_code": code, "error_message": message, "error_advice": advice}
        failed = self._finish(JobState.FAILED, Job.id == job_id, *held(token), **error)
        return bool(failed) or self.finish_cancel(job_id, token)

    def finish_cancel(self, job_id: str, token: str) -> bool:
        """The engine has stopped because the job was cancelled. False when fenced out."""
        return bool(self._finish(JobState.CANCELLED, Job.id == job_id, *held(token)))

    def release(self, job_id: str, token: str, *, refund: bool = True) -> bool:
        """Give the job back to the queue. False when fenced out.

        ``refund``: an orderly stop (a deploy) costs no attempt; a crashed engine does, and fails the job
        with ``worker.lost`` when it was the last one. A job being cancelled ends as cancelled instead.
        """
        mine = (Job.id == job_id, *held(token))
        if not refund and self._lost(Job.attempt >= self._max_attempts, *mine):
            return True
        attempt = Job.attempt - 1 if refund else Job.attempt
        return bool(self._requeue(*mine, attempt=attempt)) or self.finish_cancel(job_id, token)

    def requeue_expired_leases(self, max_attempts: int | None = None) -> list[str]:
        """Take back jobs whose worker went silent; returns those queued again.

        Those being cancelled end as cancelled, those out of attempts as failed with ``worker.lost``.
        """
        silent = Job.lease_until < self._clock()
        self._finish(JobState.CANCELLED, Job.state == JobState.CANCELLING, silent)
        limit = self._max_attempts if max_attempts is None else max_attempts
        self._lost(Job.attempt >= limit, Job.state == JobState.RUNNING, silent)
        return [job.id for job in self._requeue(Job.state == JobState.RUNNING, silent)]

    def _lost(self, *where: Any) -> bool:
        said = "The worker stopped on every attempt to work on this video."
        error = {"error_code": "worker.lost", "error_message": said, "error_advice": LOST_ADVICE}
        return bool(self._finish(JobState.FAILED, Job.state == JobState.RUNNING, *where, **error))

    def _requeue(self, *where: Any, **values: Any) -> list[Job]:
        now = self._clock()
        again = {"publish_due_at": now, "publish_attempts": 0}
        return self._move(
            JobState.QUEUED, Job.state == JobState.RUNNING, *where, **unheld(now), **again, **values
        )
