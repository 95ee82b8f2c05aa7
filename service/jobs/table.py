"""The one place where a job changes state.

Each change is one atomic ``UPDATE ... WHERE`` that names the states it may leave (from the table in
model.py) and, for a worker, the fencing token of its claim; its journal entry is written with it. Whoever
lost the job changes nothing and is told so.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from sqlalchemy import ColumnElement, Engine, func, or_, select, update
from sqlalchemy.orm import Session, sessionmaker

from service.jobs import figures, journal
from service.jobs.model import FINAL_STATES, HELD_STATES, Job, JobState, sources
from service.webhooks import outbox

#: Progress is entered in the journal when it has grown by this much.
_PROGRESS_STEP = 0.005


class JobTable:
    """Guarded changes of rows. Every method is one short transaction."""

    def __init__(self, engine: Engine, clock: Callable[[], float]) -> None:
        self.engine = engine
        self._session = sessionmaker(engine, expire_on_commit=False)
        self._clock = clock

    def _insert(self, session: Session, job: Job) -> None:
        """Add a row in a state where a job may begin, with the first entry of its journal."""
        assert job.state in (JobState.QUEUED, JobState.AWAITING_UPLOAD)
        job.event_seq = 1
        session.add(job)
        session.flush()
        journal.record(session, job, "state", job.created_at)
        outbox.enqueue(session, job, job.created_at)

    def _move(self, target: JobState, *where: ColumnElement[bool], **values: Any) -> list[Job]:
        """The only statement that writes a state: it leaves none but those the table allows.

        Returns the rows that moved, as they are now.
        """
        statement = (
            update(Job)
            .where(Job.state.in_(sources(target)), *where)
            .values(state=target, event_seq=Job.event_seq + 1, **values)
            .returning(Job)
            .execution_options(synchronize_session=False)
        )
        with self._session.begin() as session:
            moved = [*session.scalars(statement)]
            for job in moved:
                now = self._clock()
                journal.record(session, job, "state", now)
                outbox.enqueue(session, job, now)
                if job.state not in HELD_STATES:
                    figures.book_stage(session, job.stage, job.stage_since, now)
                    job.stage_since = None
                if job.state == JobState.FAILED:
                    figures.book_failure(session, job.error_code or "unknown")
        return moved

    def _finish(self, target: JobState, *where: ColumnElement[bool], **values: Any) -> list[Job]:
        """Move to a final state."""
        assert target in FINAL_STATES
        now = self._clock()
        return self._move(target, *where, finished_at=now, **unheld(now), **values)

    def _progress(self, *where: ColumnElement[bool], **values: Any) -> bool:
        """Change a row's progress, and enter it in the journal when it is news."""
        statement = (
            update(Job)
            .where(*where)
            .values(**values)
            .returning(Job)
            .execution_options(synchronize_session=False)
        )
        now = self._clock()
        with self._session.begin() as session:
            job = session.scalar(statement)
            if job is None:
                return False
            last = session.get(journal.JobEvent, (job.id, job.event_seq))
            said = {} if last is None else last.data
            grown = job.fraction - said.get("fraction", 0.0) >= _PROGRESS_STEP
            other = said.get("stage") != job.stage
            if other:
                figures.book_stage(session, said.get("stage"), job.stage_since, now)
                job.stage_since = now
            if grown or other:
                job.event_seq += 1
                journal.record(session, job, "progress", now)
        return True

    def _update(self, *where: ColumnElement[bool], **values: Any) -> bool:
        """Change other columns of one row."""
        assert "state" not in values
        statement = update(Job).where(*where).values(**values).execution_options(synchronize_session=False)
        with self._session.begin() as session:
            return rows(session.execute(statement)) == 1

    def _holds(self, job_id: str, token: str) -> bool:
        with self._session() as session:
            return session.scalar(select(Job.id).where(Job.id == job_id, *held(token))) is not None

    def _free(self) -> ColumnElement[bool]:
        """No worker can still write to the job's files."""
        return or_(Job.state.not_in(HELD_STATES), Job.lease_until < self._clock())


def held(token: str) -> tuple[ColumnElement[bool], ...]:
    """The fence: a worker has the job, and under this claim."""
    return Job.state.in_(HELD_STATES), Job.token == token


def unheld(now: float) -> dict[str, Any]:
    """What a row is left with when its worker has let go: the time spent is booked."""
    spent = Job.busy_seconds + func.coalesce(now - Job.claimed_at, 0.0)
    return {
        "token": None,
        "lease_until": None,
        "time_left": None,
        "claimed_at": None,
        "busy_seconds": spent,
    }


def rows(result: Any) -> int:
    """How many rows a statement changed."""
    return int(result.rowcount)
