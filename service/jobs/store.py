"""What users and the reconciler may do with jobs; what workers may is in leases.py."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Mapping
from enum import StrEnum
from typing import Any

from sqlalchemy import Engine, delete, select

from service.access import quotas
from service.access.quotas import Quota, Usage
from service.database import clock_of, open_database
from service.jobs import idempotency, journal
from service.jobs.idempotency import Reservation
from service.jobs.leases import LeasedJobs
from service.jobs.model import LOCAL, Job, JobKind, JobState, new_job_id
from service.jobs.table import rows
from service.settings import Settings

_ALL = 1_000_000
#: The reconciler leaves a new row this long to whoever created it.
_PUBLISH_GRACE = 2.0


class Cancel(StrEnum):
    """What a request to cancel did."""

    CANCELLED = "cancelled"  # it had not begun, or was cancelled before: it is over
    REQUESTED = "requested"  # it is running; the worker has been told
    FINISHED = "finished"  # it was over already, in another way
    UNKNOWN = "unknown"


class JobStore(LeasedJobs):
    """Synchronous and thread-safe: every method is one short transaction of its own."""

    def __init__(
        self,
        engine: Engine,
        *,
        max_attempts: int = 3,
        republish: tuple[float, float] = (60.0, 600.0),
        clock: Callable[[], float] = time.time,
    ) -> None:
        super().__init__(engine, max_attempts=max_attempts, clock=clock)
        self._republish = republish

    def close(self) -> None:
        """Close the pooled connections."""
        self.engine.dispose()

    def ping(self) -> None:
        """Raise when the database does not answer."""
        with self.engine.connect() as connection:
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
        owner: str = LOCAL,
        kind: JobKind = JobKind.FIT,
        parent: str | None = None,
        awaits_upload: bool = False,
        restarted_from: str | None = None,
        from_stage: str | None = None,
        traceparent: str | None = None,
        idempotency_key: tuple[Reservation, str] | None = None,
        quota: Quota | None = None,
    ) -> Job:
        """Insert a job: queued, or awaiting its upload.

        ``video`` is the upload's path relative to the data directory. ``idempotency_key``: the reservation
        of the request and its fingerprint; raises ReservationLostError, and inserts nothing, when another
        request was faster. ``quota``: raises QuotaError when the owner would have more than that.
        """
        now = self._clock()
        job = Job(
            id=job_id or new_job_id(now),
            owner=owner,
            kind=kind,
            parent=parent,
            state=JobState.AWAITING_UPLOAD if awaits_upload else JobState.QUEUED,
            options=dict(options),
            queue=queue,
            video=video,
            video_bytes=video_bytes,
            restarted_from=restarted_from,
            from_stage=from_stage,
            traceparent=traceparent,
            created_at=now,
            publish_due_at=now + _PUBLISH_GRACE,
        )
        with self._session.begin() as session:
            quotas.serialise(session, owner)
            self._insert(session, job)
            if idempotency_key is not None:
                reservation, fingerprint = idempotency_key
                idempotency.bind(session, reservation, fingerprint, job.id)
            if quota is not None:
                # After the insert, which makes this the only transaction that counts for this owner.
                quotas.check(quotas.usage(session, owner, now), quota)
        return job

    def check_quota(self, owner: str, quota: Quota, jobs: int = 0, size: int = 0) -> None:
        """Raise QuotaError when so much more would be too much."""
        with self._session() as session:
            have = quotas.usage(session, owner, self._clock())
        quotas.check(Usage(have.jobs + jobs, have.bytes + size, have.minutes), quota)

    def get(self, job_id: str, owner: str | None = None) -> Job | None:
        """The job as it is now, detached; None when it is unknown, deleted, or not ``owner``'s."""
        query = select(Job).where(Job.id == job_id, Job.deleted_at.is_(None))
        if owner is not None:
            query = query.where(Job.owner == owner)
        with self._session() as session:
            return session.scalar(query)

    def page(
        self,
        limit: int = 50,
        cursor: str | None = None,
        owner: str | None = None,
        states: Collection[JobState] = (),
        parent: str | None = None,
    ) -> tuple[list[Job], str | None]:
        """Newest first; ``cursor`` is what the page before returned, None when that was the last.

        Jobs of videos, or with ``parent`` the renders of that job.
        """
        which = Job.kind == JobKind.FIT if parent is None else Job.parent == parent
        query = select(Job).where(which, Job.deleted_at.is_(None)).order_by(Job.id.desc()).limit(limit + 1)
        if cursor is not None:
            query = query.where(Job.id < cursor)
        if owner is not None:
            query = query.where(Job.owner == owner)
        if states:
            query = query.where(Job.state.in_(states))
        with self._session() as session:
            found = [*session.scalars(query)]
        return found[:limit], found[limit - 1].id if len(found) > limit else None

    def known(self, job_ids: set[str]) -> set[str]:
        """Which of these ids have a row, deleted ones not yet purged included."""
        with self._session() as session:
            return {*session.scalars(select(Job.id).where(Job.id.in_(job_ids)))}

    def events(self, job_id: str, after: int = 0, limit: int = 500) -> list[journal.Entry]:
        """Entries of the job's journal with numbers above ``after``, oldest first."""
        with self._session() as session:
            return journal.events_after(session, job_id, after, limit)

    def logs(self, job_id: str, after: int = 0, limit: int = 500) -> list[journal.JobLog]:
        """Log lines with ids above ``after``, oldest first."""
        with self._session() as session:
            return journal.lines_after(session, job_id, after, limit)

    def upload_arrived(self, job_id: str, video_bytes: int) -> bool:
        """The awaited video is there and whole: queue the job. False when it no longer awaits one."""
        due = self._clock() + _PUBLISH_GRACE
        values = {"video_bytes": video_bytes, "publish_due_at": due}
        return bool(self._move(JobState.QUEUED, Job.id == job_id, *_awaiting(), **values))

    def upload_refused(self, job_id: str, code: str, message: str, advice: str) -> bool:
        """The awaited video cannot be used. False when the job no longer awaits one."""
        error = {"error_code": code, "error_message": message, "error_advice": advice}
        return bool(self._finish(JobState.FAILED, Job.id == job_id, *_awaiting(), **error))

    def request_cancel(self, job_id: str) -> Cancel:
        """End at once a job that has not begun, or ask the worker of a running one to stop. Repeatable."""
        mine = (Job.id == job_id, Job.deleted_at.is_(None))
        waiting = Job.state.in_((JobState.QUEUED, JobState.AWAITING_UPLOAD))
        while True:
            if self._finish(JobState.CANCELLED, *mine, waiting):
                return Cancel.CANCELLED
            if self._move(JobState.CANCELLING, *mine):
                return Cancel.REQUESTED
            job = self.get(job_id)
            if job is None:
                return Cancel.UNKNOWN
            match job.state:
                case JobState.CANCELLING:
                    return Cancel.REQUESTED
                case JobState.CANCELLED:
                    return Cancel.CANCELLED
                case JobState.SUCCEEDED | JobState.FAILED | JobState.EXPIRED:
                    return Cancel.FINISHED
            # It moved between the two statements, say from running back to the queue: once more.

    def delete(self, job_id: str) -> bool:
        """Hide the job and its renders for good, stop their workers. False when it is unknown or deleted.

        The bytes and the row go with :meth:`purge`, once no worker can write any more.
        """
        if self.request_cancel(job_id) is Cancel.UNKNOWN:
            return False
        for render in self.page(limit=_ALL, parent=job_id)[0]:
            self.delete(render.id)
        return self._update(Job.id == job_id, Job.deleted_at.is_(None), deleted_at=self._clock())

    def due_for_purge(self, limit: int = 100) -> list[str]:
        """Deleted jobs that no worker holds: remove their files, then :meth:`purge`."""
        query = select(Job.id).where(Job.deleted_at.is_not(None), self._free()).limit(limit)
        with self._session() as session:
            return [*session.scalars(query)]

    def purge(self, job_id: str) -> bool:
        """Remove the row and the journal of a deleted job that no worker holds. Its files must be gone."""
        condition = (Job.id == job_id, Job.deleted_at.is_not(None), self._free())
        with self._session.begin() as session:
            if session.scalar(select(Job.id).where(*condition).with_for_update()) is None:
                return False
            journal.erase(session, job_id)
            return rows(session.execute(delete(Job).where(*condition))) == 1

    # Reconciler

    def due_for_publish(self, limit: int = 100) -> list[str]:
        """Queued jobs whose wake-up message has to be sent (again), longest overdue first."""
        query = (
            select(Job.id)
            .where(Job.state == JobState.QUEUED, Job.publish_due_at <= self._clock())
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

    def now(self) -> float:
        """The time that rows are stamped with, seconds since 1970."""
        return self._clock()

    def mark_dropped(self, job_id: str, *, video: bool) -> bool:
        """The job's video (or its checkpoint) has been removed."""
        column = "video_dropped_at" if video else "checkpoint_dropped_at"
        return self._update(Job.id == job_id, **{column: self._clock()})

    def expire_upload(self, job_id: str) -> bool:
        """The awaited video did not arrive in time. False when the job no longer awaits one."""
        return bool(self._finish(JobState.EXPIRED, Job.id == job_id, *_awaiting()))


def _awaiting() -> tuple[Any, ...]:
    return (Job.state == JobState.AWAITING_UPLOAD,)


def create_store(settings: Settings, clock: Callable[[], float] | None = None) -> JobStore:
    """Open (and on first use create, or migrate) the database of ``settings``. Raises DatabaseError."""
    engine = open_database(settings)
    republish = (settings.republish_min_seconds, settings.republish_max_seconds)
    return JobStore(
        engine, max_attempts=settings.max_attempts, republish=republish, clock=clock or clock_of(engine)
    )
