"""How much one owner may have: unfinished jobs, bytes of video, minutes of work in a day."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

from sqlalchemy import case, func, select, text
from sqlalchemy.orm import Session

from service.jobs.model import FINAL_STATES, HELD_STATES, Job

DAY = 86400.0


@dataclass(frozen=True)
class Quota:
    """The limits; zero means none."""

    jobs: int = 0
    bytes: int = 0
    minutes: float = 0.0


@dataclass(frozen=True)
class Usage:
    """What an owner has now. ``minutes``: of work on jobs made in the last day."""

    jobs: int
    bytes: int
    minutes: float


class QuotaError(Exception):
    """An owner would have more than allowed. ``what``: jobs, bytes or minutes; ``wait``: seconds."""

    def __init__(self, what: str, detail: str, wait: int) -> None:
        super().__init__(detail)
        self.what, self.detail, self.wait = what, detail, wait


def usage(session: Session, owner: str, now: float) -> Usage:
    """What the owner has now."""
    running = case((Job.state.in_(HELD_STATES), now - func.coalesce(Job.claimed_at, now)), else_=0.0)
    recent = case((Job.created_at > now - DAY, Job.busy_seconds + running), else_=0.0)
    query = select(
        func.coalesce(func.sum(case((Job.state.not_in(FINAL_STATES), 1), else_=0)), 0),
        func.coalesce(
            func.sum(case((Job.deleted_at.is_(None), func.coalesce(Job.video_bytes, 0)), else_=0)), 0
        ),
        func.coalesce(func.sum(recent), 0.0),
    ).where(Job.owner == owner)
    jobs, size, seconds = session.execute(query).one()
    return Usage(int(jobs), int(size), float(seconds) / 60)


def serialise(session: Session, owner: str) -> None:
    """Let one transaction at a time count what this owner has (SQLite has one writer anyway)."""
    if session.get_bind().dialect.name == "postgresql":
        number = int.from_bytes(hashlib.sha256(owner.encode()).digest()[:8], "big", signed=True)
        session.execute(text("SELECT pg_advisory_xact_lock(:n)"), {"n": number})


def check(have: Usage, quota: Quota) -> None:
    """Raise QuotaError when ``have`` is more than ``quota``."""
    if quota.jobs and have.jobs > quota.jobs:
        raise QuotaError("jobs", f"{quota.jobs} unfinished jobs are allowed at once.", 60)
    if quota.bytes and have.bytes > quota.bytes:
        raise QuotaError("bytes", f"{quota.bytes} bytes of video are allowed.", 3600)
    if quota.minutes and have.minutes >= quota.minutes:
        raise QuotaError("minutes", f"{quota.minutes:g} minutes of work a day are allowed.", 3600)
