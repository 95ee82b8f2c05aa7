"""What happened to each job, in order: the events that watchers replay, and the log lines of its engine.

Entries are written in the transaction that changes the row, so neither can exist without the other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import JSON, ForeignKey, Index, String, Text, delete, func, select
from sqlalchemy.orm import Mapped, Session, mapped_column

from service.jobs.model import Base, Job, JobState

#: Log lines kept of one job, and the length of one.
MAX_LINES = 5000
MAX_LINE = 1000


class JobEvent(Base):
    """One change of a job. ``seq`` counts from 1 per job without gaps; ``data`` is :func:`snapshot`."""

    __tablename__ = "job_events"

    job_id: Mapped[str] = mapped_column(String(36), ForeignKey("jobs.id"), primary_key=True)
    seq: Mapped[int] = mapped_column(primary_key=True)
    at: Mapped[float]
    kind: Mapped[str] = mapped_column(String(20))
    data: Mapped[dict[str, Any]] = mapped_column(JSON)


class JobLog(Base):
    """One line that the service or the engine said about a job."""

    __tablename__ = "job_logs"
    __table_args__ = (Index("ix_job_logs_job", "job_id", "id"),)

    id: Mapped[int] = mapped_column(primary_key=True, autoincrement=True)
    job_id: Mapped[str] = mapped_column(String(36), ForeignKey("jobs.id"))
    at: Mapped[float]
    attempt: Mapped[int]
    text: Mapped[str] = mapped_column(Text)


@dataclass(frozen=True)
class Entry:
    """One event, detached."""

    seq: int
    at: float
    kind: str
    data: dict[str, Any]


def snapshot(job: Job) -> dict[str, Any]:
    """What an event says about its job."""
    said: dict[str, Any] = {
        "state": str(job.state),
        "stage": job.stage,
        "attempt": job.attempt,
        "fraction": job.fraction,
        "time_left": job.time_left,
        "message": job.message,
    }
    if job.state == JobState.FAILED:
        said["error"] = {"code": job.error_code, "message": job.error_message, "advice": job.error_advice}
    return said


def record(session: Session, job: Job, kind: str, at: float) -> None:
    """Add the event numbered ``job.event_seq``."""
    session.add(JobEvent(job_id=job.id, seq=job.event_seq, at=at, kind=kind, data=snapshot(job)))


def events_after(session: Session, job_id: str, after: int, limit: int) -> list[Entry]:
    """Events with numbers above ``after``, oldest first."""
    query = (
        select(JobEvent)
        .where(JobEvent.job_id == job_id, JobEvent.seq > after)
        .order_by(JobEvent.seq)
        .limit(limit)
    )
    return [Entry(event.seq, event.at, event.kind, event.data) for event in session.scalars(query)]


def write_lines(session: Session, job: Job, lines: Sequence[str], at: float) -> None:
    """Add log lines, cut to length; beyond :data:`MAX_LINES` of one job they are dropped."""
    have = session.scalar(select(func.count()).where(JobLog.job_id == job.id)) or 0
    for line in lines[: max(MAX_LINES - have, 0)]:
        # Control characters would act on the terminal of whoever reads the log.
        text = "".join(filter(str.isprintable, line))[:MAX_LINE]
        session.add(JobLog(job_id=job.id, at=at, attempt=job.attempt, text=text))


def lines_after(session: Session, job_id: str, after: int, limit: int) -> list[JobLog]:
    """Log lines with ids above ``after``, oldest first."""
    query = select(JobLog).where(JobLog.job_id == job_id, JobLog.id > after).order_by(JobLog.id).limit(limit)
    return [*session.scalars(query)]


def erase(session: Session, job_id: str) -> None:
    """Remove all entries of a job that is being removed."""
    for table in (JobEvent, JobLog):
        session.execute(delete(table).where(table.job_id == job_id))
