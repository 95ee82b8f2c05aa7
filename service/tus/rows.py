"""Uploads that may be interrupted: their rows. The offset in the row is the truth, the file follows it."""

from __future__ import annotations

import time
import uuid
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from sqlalchemy import BigInteger, Engine, Index, String, delete, func, select, update
from sqlalchemy.orm import Mapped, mapped_column, sessionmaker

from service.access import quotas
from service.access.quotas import Quota
from service.jobs.model import Base, new_job_id
from service.settings import Settings

#: How long a request holds an upload without a sign of life, seconds.
LOCK_SECONDS = 90.0


class Upload(Base):
    """One upload. A job made of it takes its id, so an id names one directory of files all its life."""

    __tablename__ = "uploads"
    __table_args__ = (Index("ix_uploads_owner", "owner"), Index("ix_uploads_expiry", "expires_at"))

    id: Mapped[str] = mapped_column(String(36), primary_key=True)
    owner: Mapped[str] = mapped_column(String(64))
    length: Mapped[int] = mapped_column(BigInteger)
    offset: Mapped[int] = mapped_column("received", BigInteger, default=0)
    created_at: Mapped[float]
    expires_at: Mapped[float]
    #: The request that writes now, and until when it is believed to live.
    token: Mapped[str | None] = mapped_column(String(32), default=None)
    locked_until: Mapped[float] = mapped_column(default=0.0)
    #: The file is durable under its final name.
    complete: Mapped[bool] = mapped_column(default=False)


@dataclass(frozen=True)
class Lock:
    """The right to append to an upload from ``offset`` on."""

    upload_id: str
    token: str
    offset: int
    length: int


class TooManyUploadsError(Exception):
    """An owner has as many unfinished uploads as allowed."""


class UploadStore:
    """Thread-safe; every method is one short transaction."""

    def __init__(
        self, engine: Engine, seconds: float, most: int = 0, clock: Callable[[], float] = time.time
    ) -> None:
        """``seconds``: kept after the last byte; ``most``: unfinished ones per owner."""
        self._session = sessionmaker(engine, expire_on_commit=False)
        self._seconds, self._most, self._clock = seconds, most, clock

    def create(self, owner: str, length: int, quota: Quota) -> Upload:
        """A new, empty upload. Raises QuotaError, TooManyUploadsError."""
        now = self._clock()
        upload = Upload(
            id=new_job_id(now), owner=owner, length=length, offset=0, created_at=now,
            expires_at=now + self._seconds,
        )  # fmt: skip
        with self._session.begin() as session:
            quotas.serialise(session, owner)
            session.add(upload)
            session.flush()
            unfinished = select(func.count()).where(Upload.owner == owner, Upload.complete.is_(False))
            if self._most and (session.scalar(unfinished) or 0) > self._most:
                raise TooManyUploadsError
            have = quotas.usage(session, owner, now)
            pending = select(func.coalesce(func.sum(Upload.length), 0)).where(Upload.owner == owner)
            size = have.bytes + int(session.scalar(pending) or 0)
            quotas.check(quotas.Usage(0, size, have.minutes), quota)
        return upload

    def get(self, upload_id: str, owner: str | None = None) -> Upload | None:
        """The upload; None when it is unknown, has expired, or is not ``owner``'s."""
        with self._session() as session:
            upload = session.get(Upload, upload_id)
        if upload is None or upload.expires_at < self._clock() or owner not in (None, upload.owner):
            return None
        return upload

    def lock(self, upload_id: str) -> Lock | None:
        """Take the right to write; None while another request has it."""
        now, token = self._clock(), uuid.uuid4().hex
        statement = (
            update(Upload)
            .where(Upload.id == upload_id, Upload.locked_until < now, Upload.complete.is_(False))
            .values(token=token, locked_until=now + LOCK_SECONDS)
            .returning(Upload.offset, Upload.length)
            .execution_options(synchronize_session=False)
        )
        with self._session.begin() as session:
            row = session.execute(statement).one_or_none()
        return None if row is None else Lock(upload_id, token, row[0], row[1])

    def commit(self, lock: Lock, offset: int) -> bool:
        """So many bytes are safe; keeps the lock. False when it was lost: write no more."""
        now = self._clock()
        values = {"offset": offset, "locked_until": now + LOCK_SECONDS, "expires_at": now + self._seconds}
        return self._write(lock, values)

    def finish(self, lock: Lock) -> bool:
        """The file has its final name."""
        return self._write(lock, {"complete": True})

    def unlock(self, lock: Lock) -> None:
        """Let the next request write."""
        self._write(lock, {"token": None, "locked_until": 0.0})

    def remove(self, upload_id: str) -> bool:
        """Forget the upload; whoever writes to it finds its lock gone."""
        with self._session.begin() as session:
            removed = session.execute(delete(Upload).where(Upload.id == upload_id))
            return bool(removed.rowcount == 1)  # type: ignore[attr-defined]

    def overdue(self, limit: int = 100) -> list[str]:
        """Uploads that have expired and that nobody writes to."""
        now = self._clock()
        query = select(Upload.id).where(Upload.expires_at < now, Upload.locked_until < now).limit(limit)
        with self._session() as session:
            return [*session.scalars(query)]

    def known(self, ids: set[str]) -> set[str]:
        """Which of these ids are uploads."""
        with self._session() as session:
            return {*session.scalars(select(Upload.id).where(Upload.id.in_(ids)))}

    def finished(self, limit: int = 100) -> list[Upload]:
        """Complete uploads, which a job may be waiting for."""
        with self._session() as session:
            return [*session.scalars(select(Upload).where(Upload.complete).limit(limit))]

    def _write(self, lock: Lock, values: Mapping[str, object]) -> bool:
        statement = (
            update(Upload).where(Upload.id == lock.upload_id, Upload.token == lock.token).values(dict(values))
        ).execution_options(synchronize_session=False)
        with self._session.begin() as session:
            return bool(session.execute(statement).rowcount == 1)  # type: ignore[attr-defined]


def create_uploads(settings: Settings, engine: Engine) -> UploadStore:
    """The uploads of ``settings``."""
    return UploadStore(engine, settings.upload_seconds, settings.max_open_uploads)
