"""``Idempotency-Key``: the same request sent twice makes one job.

A key is first reserved, which turns away the same request while it is still arriving, and is then bound to
the job in the transaction that inserts the row. The reservation may be lost to a crash; the binding cannot.
"""

from __future__ import annotations

import re
import time
import uuid
from collections.abc import Callable
from dataclasses import dataclass

from sqlalchemy import Engine, String, delete, select, update
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Mapped, Session, mapped_column, sessionmaker

from service.jobs.model import Base

_KEY = re.compile(r'"?([\x21\x23-\x7e]{1,128})"?')
#: How long a key is remembered, and how long an unfinished request holds it, seconds.
REMEMBERED = 24 * 3600.0
RESERVED = 900.0


class IdempotencyRow(Base):
    """One key of one owner."""

    __tablename__ = "idempotency_keys"

    owner: Mapped[str] = mapped_column(String(64), primary_key=True)
    key: Mapped[str] = mapped_column(String(128), primary_key=True)
    token: Mapped[str] = mapped_column(String(32))
    reserved_until: Mapped[float]
    expires_at: Mapped[float]
    fingerprint: Mapped[str | None] = mapped_column(String(64), default=None)
    job_id: Mapped[str | None] = mapped_column(String(36), default=None)


@dataclass(frozen=True)
class Reservation:
    """The right to make the job of a key."""

    owner: str
    key: str
    token: str


@dataclass(frozen=True)
class Made:
    """The job a key made, and the SHA-256 of the request that made it."""

    job_id: str
    fingerprint: str


class ReservationLostError(Exception):
    """Another request made the job of this key while this one was arriving."""


def parse_key(header: str) -> str | None:
    """The key in the header's value, quoted or not; None when it is not 1 to 128 visible ASCII characters."""
    match = _KEY.fullmatch(header.strip())
    return None if match is None else match[1]


class IdempotencyKeys:
    """Thread-safe; every method is one short transaction."""

    def __init__(self, engine: Engine, clock: Callable[[], float] = time.time) -> None:
        self._session = sessionmaker(engine, expire_on_commit=False)
        self._clock = clock

    def reserve(self, owner: str, key: str) -> Reservation | Made | None:
        """Reserve the key, or say what it made; None while another request holds it."""
        now, token = self._clock(), uuid.uuid4().hex
        this = (IdempotencyRow.owner == owner, IdempotencyRow.key == key)
        fresh = {"token": token, "reserved_until": now + RESERVED, "expires_at": now + REMEMBERED}
        try:
            with self._session.begin() as session:
                session.execute(delete(IdempotencyRow).where(*this, IdempotencyRow.expires_at < now))
                session.add(IdempotencyRow(owner=owner, key=key, **fresh))
            return Reservation(owner, key, token)
        except IntegrityError:
            pass  # the key is known
        abandoned = (IdempotencyRow.job_id.is_(None), IdempotencyRow.reserved_until < now)
        with self._session.begin() as session:
            taken = session.execute(update(IdempotencyRow).where(*this, *abandoned).values(**fresh))
            if taken.rowcount == 1:  # type: ignore[attr-defined]
                return Reservation(owner, key, token)
            row = session.scalar(select(IdempotencyRow).where(*this))
        if row is None or row.job_id is None or row.fingerprint is None:
            return None
        return Made(row.job_id, row.fingerprint)

    def release(self, reservation: Reservation) -> None:
        """Forget a key whose request made no job."""
        with self._session.begin() as session:
            session.execute(
                delete(IdempotencyRow).where(
                    IdempotencyRow.owner == reservation.owner,
                    IdempotencyRow.key == reservation.key,
                    IdempotencyRow.token == reservation.token,
                    IdempotencyRow.job_id.is_(None),
                )
            )

    def sweep(self) -> None:
        """Forget the keys that have expired."""
        with self._session.begin() as session:
            session.execute(delete(IdempotencyRow).where(IdempotencyRow.expires_at < self._clock()))


def bind(session: Session, reservation: Reservation, fingerprint: str, job_id: str) -> None:
    """Tie the key to a job inserted in the same transaction. Raises ReservationLostError."""
    bound = session.execute(
        update(IdempotencyRow)
        .where(IdempotencyRow.owner == reservation.owner, IdempotencyRow.key == reservation.key)
        .where(IdempotencyRow.token == reservation.token, IdempotencyRow.job_id.is_(None))
        .values(job_id=job_id, fingerprint=fingerprint)
    )
    if bound.rowcount != 1:  # type: ignore[attr-defined]
        raise ReservationLostError
