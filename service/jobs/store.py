"""The job table and every way to change it.

Each change of state is one atomic ``UPDATE ... WHERE`` that names the states it may leave (from the table
in model.py) and, for a worker, the fencing token of its claim. Whoever lost the job changes nothing and is
told so.
"""

from __future__ import annotations

import time
import uuid
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from sqlalchemy import ColumnElement, Engine, and_, create_engine, delete, event, func, or_, select, update
from sqlalchemy.orm import sessionmaker

from service.jobs.model import FINAL_STATES, Base, Job, JobState, new_job_id, sources
from service.settings import Settings

LOST_ADVICE = "Submit the video again; if it fails the same way, try a shorter or smaller clip."
#: The reconciler leaves a new row this long to whoever created it.
_PUBLISH_GRACE = 2.0


@dataclass(frozen=True)
class Claim:
    """The right to work on a job until the lease ends. ``video`` is relative to the data directory."""

    job_id: str
    token: str
    attempt: int
    options: dict[str, Any]
    video: str
    queue: str = "cpu"

    @property
    def artifact(self) -> str:
        """The directory name reserved for this attempt's output."""
        return f"{self.attempt}-{self.token}"


class Heartbeat(StrEnum):
    """What the worker should do next."""

    OK = "ok"  # go on, the lease is renewed
    CANCEL = "cancel"  # stop the engine, then finish_cancel; the lease is renewed
    LOST = "lost"  # somebody else has the job, or it is gone: stop and write nothing


class Cancel(StrEnum):
    """What a request to cancel did."""

    CANCELLED = "cancelled"  # it was queued and is over
    REQUESTED = "requested"  # it is running; the worker has been told
    FINISHED = "finished"  # it was over already
    UNKNOWN = "unknown"


class JobStore:
    """Synchronous and thread-safe: every method is one short transaction of its own."""

    def __init__(
        self,
        engine: Engine,
        *,
        max_attempts: int = 3,
        republish: tuple[float, float] = (60.0, 600.0),
        clock: Callable[[], float] = time.time,
    ) -> None:
        self._engine = engine
        self._session = sessionmaker(engine, expire_on_commit=False)
        self._max_attempts = max_attempts
        self._republish = republish
        self._clock = clock

    def close(self) -> None:
        """Close the pooled connections."""
        self._engine.dispose()

    def ping(self) -> None:
        """Raise when the database does not answer."""
        with self._engine.connect() as connection:
            connection.execute(select(1))

    # Users

    def create(
        self,
        options: Mapping[str, Any],
        video: str,
        *,
        job_id: str | None = None,
        video_bytes: int | None = None,
        queue: str = "cpu",
    ) -> Job:
        """Insert a queued job. ``video`` is the upload's path relative to the data directory."""
        now = self._clock()
        job = Job(
            id=job_id or new_job_id(now),
            state=JobState.QUEUED,
            options=dict(options),
            queue=queue,
            video=video,
            video_bytes=video_bytes,
            created_at=now,
            publish_due_at=now + _PUBLISH_GRACE,
        )
        with self._session.begin() as session:
            session.add(job)
        return job

    def get(self, job_id: str) -> Job | None:
        """The job as it is now, detached; None when it is unknown or deleted."""
        with self._session() as session:
            return session.scalar(select(Job).where(Job.id == job_id, Job.deleted_at.is_(None)))

    def page(self, limit: int = 50, cursor: str | None = None) -> tuple[list[Job], str | None]:
        """Newest first; ``cursor`` is what the page before returned, None when that was the last."""
        query = select(Job).where(Job.deleted_at.is_(None)).order_by(Job.id.desc()).limit(limit + 1)
        if cursor is not None:
            query = query.where(Job.id < cursor)
        with self._session() as session:
            rows = [*session.scalars(query)]
        return rows[:limit], rows[limit - 1].id if len(rows) > limit else None

    def known(self, job_ids: set[str]) -> set[str]:
        """Which of these ids have a row, deleted ones not yet purged included."""
        with self._session() as session:
            return {*session.scalars(select(Job.id).where(Job.id.in_(job_ids)))}

    def request_cancel(self, job_id: str) -> Cancel:
        """End a queued job at once, or ask the worker of a running one to stop. Safe to repeat."""
        unfinished = Job.state.not_in(FINAL_STATES)
        if not self._update(Job.id == job_id, unfinished, Job.deleted_at.is_(None), cancel_requested=True):
            return Cancel.UNKNOWN if self.get(job_id) is None else Cancel.FINISHED
        # From here on no claim and no requeue can succeed, so a queued job stays queued until this line.
        ended = self._finish(job_id, JobState.CANCELLED, Job.state == JobState.QUEUED)
        return Cancel.CANCELLED if ended else Cancel.REQUESTED

    def delete(self, job_id: str) -> bool:
        """Hide the job for good and stop its worker. False when it is unknown or deleted already.

        The bytes and the row go with :meth:`purge`, once no worker can write any more.
        """
        now = self._clock()
        gone = self._update(Job.id == job_id, Job.deleted_at.is_(None), deleted_at=now, cancel_requested=True)
        if gone:
            self._finish(job_id, JobState.CANCELLED, Job.state == JobState.QUEUED)
        return gone

    def due_for_purge(self, limit: int = 100) -> list[str]:
        """Deleted jobs that no worker holds: remove their files, then :meth:`purge`."""
        query = select(Job.id).where(Job.deleted_at.is_not(None), self._unheld()).limit(limit)
        with self._session() as session:
            return [*session.scalars(query)]

    def purge(self, job_id: str) -> bool:
        """Remove the row of a deleted job that no worker holds. Its files must be gone before."""
        statement = delete(Job).where(Job.id == job_id, Job.deleted_at.is_not(None), self._unheld())
        with self._session.begin() as session:
            return _rows(session.execute(statement)) == 1

    # Workers

    def claim(self, job_id: str, token: str | None = None, lease_seconds: float = 60.0) -> Claim | None:
        """Take a queued job, or one whose lease has run out. Of any number of callers exactly one gets it.

        None: somebody has it, it is over, cancelled or unknown, or its attempts are used up. Progress starts
        again at zero with each attempt.
        """
        now = self._clock()
        token = token or uuid.uuid4().hex
        expired = and_(Job.state == JobState.RUNNING, Job.lease_until < now)
        statement = (
            self._transition(
                JobState.RUNNING,
                Job.id == job_id,
                Job.cancel_requested.is_(False),
                Job.attempt < self._max_attempts,
                or_(Job.state == JobState.QUEUED, expired),
                token=token,
                lease_until=now + lease_seconds,
                attempt=Job.attempt + 1,
                started_at=func.coalesce(Job.started_at, now),
                stage=None,
                fraction=0.0,
                time_left=None,
                message="",
            )
        ).returning(Job.attempt, Job.options, Job.video, Job.queue)
        with self._session.begin() as session:
            row = session.execute(statement).one_or_none()
        if row is None:
            return None
        return Claim(job_id, token, row.attempt, row.options, row.video, row.queue)

    def heartbeat(self, job_id: str, token: str, lease_seconds: float = 60.0) -> Heartbeat:
        """Renew the lease and learn whether to go on."""
        statement = (
            update(Job)
            .where(Job.id == job_id, *_held(token))
            .values(lease_until=self._clock() + lease_seconds)
            .returning(Job.cancel_requested)
            .execution_options(synchronize_session=False)
        )
        with self._session.begin() as session:
            cancel = session.scalar(statement)
        if cancel is None:
            return Heartbeat.LOST
        return Heartbeat.CANCEL if cancel else Heartbeat.OK

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
        newer = self._update(
            Job.id == job_id,
            *_held(token),
            Job.fraction <= fraction,
            stage=stage,
            fraction=fraction,
            time_left=time_left,
            message=message,
        )
        return newer or self._holds(job_id, token)

    def succeed(self, job_id: str, token: str, artifact: str) -> bool:
        """Publish ``artifact`` (a directory name, already on disk). False when fenced out or cancelled."""
        return self._finish(
            job_id,
            JobState.SUCCEEDED,
            *_held(token),
            Job.cancel_requested.is_(False),
            artifact=artifact,
            fraction=1.0,
        )

    def fail(self, job_id: str, token: str, code: str, message: str, advice: str) -> bool:
        """End the job with an error for its owner. False when fenced out."""
        error = {"error_code": code, "error_message": message, "error_advice": advice}
        return self._finish(job_id, JobState.FAILED, *_held(token), **error)

    def finish_cancel(self, job_id: str, token: str) -> bool:
        """The engine has stopped because the job was cancelled. False when fenced out."""
        return self._finish(job_id, JobState.CANCELLED, *_held(token), Job.cancel_requested.is_(True))

    def release(self, job_id: str, token: str, *, refund: bool = True) -> bool:
        """Give the job back to the queue. False when fenced out.

        ``refund``: an orderly stop (a deploy) costs no attempt; a crashed engine does, and fails the job
        with ``worker.lost`` when it was the last one. A cancelled job ends as cancelled instead.
        """
        if not refund and self._lost(Job.id == job_id, *_held(token)):
            return True
        attempt = Job.attempt - 1 if refund else Job.attempt
        if self._requeue(Job.id == job_id, *_held(token), attempt=attempt):
            return True
        return self.finish_cancel(job_id, token)

    # Reconciler

    def due_for_publish(self, limit: int = 100) -> list[str]:
        """Queued jobs whose wake-up message has to be sent (again), longest overdue first."""
        query = (
            select(Job.id)
            .where(Job.state == JobState.QUEUED, Job.cancel_requested.is_(False))
            .where(Job.publish_due_at <= self._clock())
            .order_by(Job.publish_due_at)
            .limit(limit)
        )
        with self._session() as session:
            return [*session.scalars(query)]

    def mark_published(self, job_id: str, *, if_due: bool = False) -> bool:
        """The message went out; it is due again after a wait that doubles each time, up to the maximum.

        ``if_due``: only if it is due now, so that of several reconcilers one sends it.
        """
        job = self.get(job_id)
        if job is None:
            return False
        now = self._clock()
        first, longest = self._republish
        wait = min(first * 2.0 ** min(job.publish_attempts, 30), longest)
        return self._update(
            Job.id == job_id,
            Job.publish_attempts == job.publish_attempts,
            *((Job.publish_due_at <= now,) if if_due else ()),
            last_published_at=now,
            publish_attempts=job.publish_attempts + 1,
            publish_due_at=now + wait,
        )

    def mark_unpublished(self, job_id: str) -> bool:
        """The message marked last did not go out after all: it is due at once."""
        back = {"publish_attempts": Job.publish_attempts - 1, "publish_due_at": self._clock()}
        return self._update(Job.id == job_id, Job.publish_attempts > 0, **back)

    def requeue_expired_leases(self, max_attempts: int | None = None) -> list[str]:
        """Take back jobs whose worker went silent; returns those queued again.

        Cancelled ones end as cancelled, those out of attempts as failed with ``worker.lost``.
        """
        expired = (Job.state == JobState.RUNNING, Job.lease_until < self._clock())
        cancelled = self._transition(
            JobState.CANCELLED, *expired, Job.cancel_requested.is_(True), **self._ended()
        )
        with self._session.begin() as session:
            session.execute(cancelled)
        self._lost(*expired, max_attempts=max_attempts)
        return self._requeue(*expired)

    # How

    def _transition(self, target: JobState, *where: ColumnElement[bool], **values: Any) -> Any:
        """The only statement that writes a state: it leaves none but those the table allows."""
        statement = update(Job).where(Job.state.in_(sources(target)), *where).values(state=target, **values)
        return statement.execution_options(synchronize_session=False)

    def _ended(self) -> dict[str, Any]:
        return {"finished_at": self._clock(), "token": None, "lease_until": None, "time_left": None}

    def _finish(self, job_id: str, target: JobState, *where: ColumnElement[bool], **values: Any) -> bool:
        assert target in FINAL_STATES
        statement = self._transition(target, Job.id == job_id, *where, **self._ended(), **values)
        with self._session.begin() as session:
            return _rows(session.execute(statement)) == 1

    def _lost(self, *where: ColumnElement[bool], max_attempts: int | None = None) -> bool:
        limit = self._max_attempts if max_attempts is None else max_attempts
        statement = self._transition(
            JobState.FAILED,
            Job.attempt >= limit,
            *where,
            error_code="worker.lost",
            error_message=f"The worker stopped {limit} times while working on this video.",
            error_advice=LOST_ADVICE,
            **self._ended(),
        )
        with self._session.begin() as session:
            return _rows(session.execute(statement)) > 0

    def _requeue(self, *where: ColumnElement[bool], **values: Any) -> list[str]:
        back = {"token": None, "lease_until": None, "time_left": None, "publish_due_at": self._clock()}
        going = Job.cancel_requested.is_(False)
        statement = self._transition(JobState.QUEUED, going, *where, **back, publish_attempts=0, **values)
        with self._session.begin() as session:
            return [*session.scalars(statement.returning(Job.id))]

    def _update(self, *where: ColumnElement[bool], **values: Any) -> bool:
        statement = update(Job).where(*where).values(**values).execution_options(synchronize_session=False)
        with self._session.begin() as session:
            return _rows(session.execute(statement)) == 1

    def _holds(self, job_id: str, token: str) -> bool:
        with self._session() as session:
            return session.scalar(select(Job.id).where(Job.id == job_id, *_held(token))) is not None

    def _unheld(self) -> ColumnElement[bool]:
        return or_(Job.state != JobState.RUNNING, Job.lease_until < self._clock())


def _held(token: str) -> tuple[ColumnElement[bool], ...]:
    """The fence: still running, and under this claim."""
    return Job.state == JobState.RUNNING, Job.token == token


def _rows(result: Any) -> int:
    return int(result.rowcount)


def create_store(settings: Settings, clock: Callable[[], float] = time.time) -> JobStore:
    """Open (and on first use create) the database of ``settings``."""
    url = settings.database
    if url.startswith("sqlite"):
        settings.data_dir.mkdir(parents=True, exist_ok=True)
        engine = create_engine(url, connect_args={"timeout": 30.0})
        event.listen(engine, "connect", _prepare_sqlite)
    else:
        engine = create_engine(url, pool_pre_ping=True)
    Base.metadata.create_all(engine)
    republish = (settings.republish_min_seconds, settings.republish_max_seconds)
    return JobStore(engine, max_attempts=settings.max_attempts, republish=republish, clock=clock)


def _prepare_sqlite(connection: Any, _record: Any) -> None:
    cursor = connection.cursor()
    # synchronous=FULL: a job answered with 202 must survive a power cut; writes are few.
    for pragma in ("journal_mode=WAL", "synchronous=FULL", "foreign_keys=ON", "busy_timeout=30000"):
        cursor.execute(f"PRAGMA {pragma}")
    cursor.close()
