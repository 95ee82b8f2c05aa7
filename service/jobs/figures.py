"""Sums over the job table: what monitoring asks for."""

from __future__ import annotations

from dataclasses import dataclass, field

from sqlalchemy import Engine, String, func, select, update
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Mapped, Session, mapped_column

from service.jobs.model import Base, Job, JobState
from service.tus.rows import Upload
from service.webhooks.outbox import Message


class StageTime(Base):
    """How often a stage of the engine was gone through, and how long that took in all, seconds."""

    __tablename__ = "stage_times"

    stage: Mapped[str] = mapped_column(String(40), primary_key=True)
    runs: Mapped[int] = mapped_column(default=0)
    seconds: Mapped[float] = mapped_column(default=0.0)


class FailureCount(Base):
    """How many jobs have failed with a code; deleting them takes nothing away."""

    __tablename__ = "failure_counts"

    code: Mapped[str] = mapped_column(String(80), primary_key=True)
    jobs: Mapped[int] = mapped_column(default=0)


@dataclass(frozen=True)
class Figures:
    """One reading. ``stages``: runs and seconds."""

    jobs: dict[str, int] = field(default_factory=dict)
    queue_age: float = 0.0
    failures: dict[str, int] = field(default_factory=dict)
    stages: dict[str, tuple[int, float]] = field(default_factory=dict)
    uploads: int = 0
    webhooks: int = 0


def book_stage(session: Session, stage: str | None, since: float | None, now: float) -> None:
    """A job's stage is over: add its time."""
    if stage is None or since is None:
        return
    seconds = max(now - since, 0.0)
    more = {"runs": StageTime.runs + 1, "seconds": StageTime.seconds + seconds}
    if not _changed(session, update(StageTime).where(StageTime.stage == stage).values(**more)):
        try:
            with session.begin_nested():
                session.add(StageTime(stage=stage, runs=1, seconds=seconds))
        except IntegrityError:
            _changed(session, update(StageTime).where(StageTime.stage == stage).values(**more))


def book_failure(session: Session, code: str) -> None:
    """One more job has failed with this code."""
    one_more = update(FailureCount).where(FailureCount.code == code).values(jobs=FailureCount.jobs + 1)
    if not _changed(session, one_more):
        try:
            with session.begin_nested():
                session.add(FailureCount(code=code, jobs=1))
        except IntegrityError:
            _changed(session, one_more)


def read_figures(engine: Engine, now: float) -> Figures:
    """What the tables say."""
    present = Job.deleted_at.is_(None)
    with Session(engine) as session:
        counts = session.execute(select(Job.state, func.count()).where(present).group_by(Job.state))
        jobs = {str(state): 0 for state in JobState} | {str(state): count for state, count in counts}
        oldest = session.scalar(select(func.min(Job.created_at)).where(present, Job.state == JobState.QUEUED))
        return Figures(
            jobs=jobs,
            queue_age=max(now - oldest, 0.0) if oldest is not None else 0.0,
            failures={row.code: row.jobs for row in session.scalars(select(FailureCount))},
            stages={row.stage: (row.runs, row.seconds) for row in session.scalars(select(StageTime))},
            uploads=session.scalar(select(func.count()).where(Upload.complete.is_(False))) or 0,
            webhooks=session.scalar(select(func.count()).where(Message.finished_at.is_(None))) or 0,
        )


def _changed(session: Session, statement: object) -> bool:
    return bool(
        session.execute(statement, execution_options={"synchronize_session": False}).rowcount  # type: ignore[call-overload]
    )
