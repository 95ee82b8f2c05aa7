"""What a job is: its states, the transitions allowed between them, and its row."""

from __future__ import annotations

import os
import re
import time
import uuid
from enum import StrEnum
from typing import Any

from sqlalchemy import JSON, BigInteger, Enum, Index, String, Text
from sqlalchemy.orm import DeclarativeBase, Mapped, mapped_column


class JobKind(StrEnum):
    """What a job makes: an avatar of a video, or a motion of an avatar."""

    FIT = "fit"
    RENDER = "render"


class JobState(StrEnum):
    """Where a job stands."""

    AWAITING_UPLOAD = "awaiting_upload"
    QUEUED = "queued"
    RUNNING = "running"
    CANCELLING = "cancelling"
    SUCCEEDED = "succeeded"
    FAILED = "failed"
    CANCELLED = "cancelled"
    EXPIRED = "expired"


_S = JobState

#: The one table of allowed moves. ``running -> running`` is a second worker taking over an expired lease;
#: ``running -> queued`` a job given back or taken back from a silent worker. A job being cancelled ends as
#: cancelled whatever its worker still has to say. Only a job whose video never came expires.
TRANSITIONS: dict[JobState, frozenset[JobState]] = {
    _S.AWAITING_UPLOAD: frozenset({_S.QUEUED, _S.CANCELLED, _S.FAILED, _S.EXPIRED}),
    _S.QUEUED: frozenset({_S.RUNNING, _S.CANCELLED}),
    _S.RUNNING: frozenset({_S.RUNNING, _S.QUEUED, _S.CANCELLING, _S.SUCCEEDED, _S.FAILED}),
    _S.CANCELLING: frozenset({_S.CANCELLED}),
    _S.SUCCEEDED: frozenset(),
    _S.FAILED: frozenset(),
    _S.CANCELLED: frozenset(),
    _S.EXPIRED: frozenset(),
}

FINAL_STATES: frozenset[JobState] = frozenset(state for state, after in TRANSITIONS.items() if not after)
#: The states in which a worker has (or had) the job.
HELD_STATES: frozenset[JobState] = frozenset({_S.RUNNING, _S.CANCELLING})


def sources(target: JobState) -> frozenset[JobState]:
    """The states from which ``target`` may be entered."""
    return frozenset(state for state, after in TRANSITIONS.items() if target in after)


_JOB_ID = re.compile(r"[0-9a-f]{8}-[0-9a-f]{4}-7[0-9a-f]{3}-[89ab][0-9a-f]{3}-[0-9a-f]{12}")


def new_job_id(now: float | None = None) -> str:
    """A UUID of version 7: ids sort by creation time and carry 74 random bits nobody can guess."""
    milliseconds = int((time.time() if now is None else now) * 1000) & (1 << 48) - 1
    bits = milliseconds << 80 | int.from_bytes(os.urandom(10), "big")
    bits = bits & ~(0xF << 76) | 7 << 76
    bits = bits & ~(0x3 << 62) | 2 << 62
    return str(uuid.UUID(int=bits))


def is_job_id(text: str) -> bool:
    """Whether ``text`` has exactly the form of an id made here (nothing else ever reaches a path)."""
    return _JOB_ID.fullmatch(text) is not None


#: The owner of everything where no key is asked for.
LOCAL = "local"


class Base(DeclarativeBase):
    """The declarative base of every table."""


#: Stored as plain text, so that a new state needs no change of the database.
_STATE = Enum(
    JobState, native_enum=False, length=20, values_callable=lambda states: [state.value for state in states]
)


class Job(Base):
    """One reconstruction. The row is the truth; broker messages are only hints. Times: seconds since 1970."""

    __tablename__ = "jobs"
    __table_args__ = (
        Index("ix_jobs_state_lease", "state", "lease_until"),
        Index("ix_jobs_state_publish", "state", "publish_due_at"),
        Index("ix_jobs_owner", "owner", "id"),
        Index("ix_jobs_parent", "parent"),
    )

    id: Mapped[str] = mapped_column(String(36), primary_key=True)
    #: Whose job it is: the name of an API key's owner, or :data:`LOCAL` where the service is open.
    owner: Mapped[str] = mapped_column(String(64), default=LOCAL)
    kind: Mapped[str] = mapped_column(String(20), default=JobKind.FIT)
    #: Of a render: the job whose avatar moves.
    parent: Mapped[str | None] = mapped_column(String(36), default=None)
    state: Mapped[JobState] = mapped_column(_STATE, default=JobState.QUEUED)
    #: What the engine does now and how far the whole job is (0 to 1, never falling within one attempt).
    stage: Mapped[str | None] = mapped_column(String(40), default=None)
    stage_since: Mapped[float | None] = mapped_column(default=None)
    fraction: Mapped[float] = mapped_column(default=0.0)
    time_left: Mapped[float | None] = mapped_column(default=None)
    message: Mapped[str] = mapped_column(Text, default="")

    options: Mapped[dict[str, Any]] = mapped_column(JSON, default=dict)
    #: Which workers may take it: ``cpu`` or ``gpu``.
    queue: Mapped[str] = mapped_column(String(20), default="cpu", server_default="cpu")
    #: The uploaded video (of a render: the avatar), relative to the data directory; no name chosen by a
    #: client appears in it.
    video: Mapped[str] = mapped_column(String(200))
    video_bytes: Mapped[int | None] = mapped_column(BigInteger, default=None)

    #: What the engine found worth a word: ``code``, ``message`` and ``advice`` of each, of this attempt.
    warnings: Mapped[list[dict[str, str]]] = mapped_column(JSON, default=list)
    error_code: Mapped[str | None] = mapped_column(String(80), default=None)
    error_message: Mapped[str | None] = mapped_column(Text, default=None)
    error_advice: Mapped[str | None] = mapped_column(Text, default=None)

    #: The job this one repeats, and the stage to begin at where that job's checkpoints allow it.
    restarted_from: Mapped[str | None] = mapped_column(String(36), default=None)
    from_stage: Mapped[str | None] = mapped_column(String(40), default=None)
    #: W3C trace context of the request that made the job, for the worker to carry on.
    traceparent: Mapped[str | None] = mapped_column(String(55), default=None)

    #: The lease: who works on it (a fencing token, new for each claim), which try it is, until when.
    attempt: Mapped[int] = mapped_column(default=0)
    token: Mapped[str | None] = mapped_column(String(32), default=None)
    lease_until: Mapped[float | None] = mapped_column(default=None)
    claimed_at: Mapped[float | None] = mapped_column(default=None)
    #: Seconds that workers have spent on it, over all attempts that have ended.
    busy_seconds: Mapped[float] = mapped_column(default=0.0)
    #: Set by DELETE: the job is invisible from then on, its bytes go as soon as no worker holds it.
    deleted_at: Mapped[float | None] = mapped_column(default=None)

    created_at: Mapped[float]
    started_at: Mapped[float | None] = mapped_column(default=None)
    finished_at: Mapped[float | None] = mapped_column(default=None)

    #: When retention removed its video, and its checkpoint (service/jobs/retention.py).
    video_dropped_at: Mapped[float | None] = mapped_column(default=None)
    checkpoint_dropped_at: Mapped[float | None] = mapped_column(default=None)

    #: Outbox: when the wake-up message was last sent, how often, and when it is due again.
    last_published_at: Mapped[float | None] = mapped_column(default=None)
    publish_attempts: Mapped[int] = mapped_column(default=0)
    publish_due_at: Mapped[float] = mapped_column(default=0.0)

    #: Number of the newest entry of the job's journal (service/jobs/journal.py).
    event_seq: Mapped[int] = mapped_column(default=0)

    #: Name of the published artifact directory (``<attempt>-<token>``), set only on success.
    artifact: Mapped[str | None] = mapped_column(String(60), default=None)

    @property
    def cancel_requested(self) -> bool:
        """Whether its worker has been told to stop."""
        return self.state == JobState.CANCELLING
