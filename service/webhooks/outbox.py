"""Webhooks as rows: who wants to be told what, and every message until it has been delivered or given up.

A message is written in the transaction that changes the job, so it cannot be lost, and sent by whoever
takes it next, so no receiver can hold up a job.
"""

from __future__ import annotations

import base64
import json
import secrets
import time
import uuid
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime

from sqlalchemy import JSON, Engine, Index, String, Text, delete, func, select, update
from sqlalchemy.orm import Mapped, Session, mapped_column, sessionmaker

from service.jobs import journal
from service.jobs.model import Base, Job

#: What can be listened to: a job has entered this state.
EVENTS = ("job.queued", "job.running", "job.succeeded", "job.failed", "job.cancelled", "job.expired")
PING = "ping"
#: Pauses after each failed attempt, seconds; after the last one the message is given up.
PAUSES = (5.0, 60.0, 300.0, 1800.0, 7200.0, 18000.0, 36000.0)
#: Whoever took a message has so long to send it before another may.
TAKEN_SECONDS = 60.0
MAX_ENDPOINTS = 10
_KEPT_SECONDS = 7 * 86400.0


class Endpoint(Base):
    """A receiver. ``secret`` signs what is sent to it."""

    __tablename__ = "webhook_endpoints"

    id: Mapped[str] = mapped_column(String(36), primary_key=True)
    owner: Mapped[str] = mapped_column(String(64), index=True)
    url: Mapped[str] = mapped_column(Text)
    events: Mapped[list[str]] = mapped_column(JSON)
    secret: Mapped[str] = mapped_column(String(100))
    created_at: Mapped[float]
    #: Set when the receiver said that it is gone for good.
    disabled_at: Mapped[float | None] = mapped_column(default=None)


class Message(Base):
    """One message to one receiver; ``id`` is the same for every attempt."""

    __tablename__ = "webhook_messages"
    __table_args__ = (
        Index("ix_webhook_due", "finished_at", "due_at"),
        Index("ix_webhook_endpoint", "endpoint_id", "created_at"),
    )

    id: Mapped[str] = mapped_column(String(40), primary_key=True)
    endpoint_id: Mapped[str] = mapped_column(String(36))
    event: Mapped[str] = mapped_column(String(30))
    body: Mapped[str] = mapped_column(Text)
    created_at: Mapped[float]
    due_at: Mapped[float]
    attempts: Mapped[int] = mapped_column(default=0)
    #: Delivered or given up, and what the last attempt came to: a status, or words.
    finished_at: Mapped[float | None] = mapped_column(default=None)
    delivered: Mapped[bool] = mapped_column(default=False)
    outcome: Mapped[str] = mapped_column(String(200), default="")


@dataclass(frozen=True)
class Delivery:
    """A message taken for sending."""

    message_id: str
    attempt: int
    body: str
    url: str
    secret: str
    endpoint_id: str


class TooManyEndpointsError(Exception):
    """An owner has as many receivers as allowed."""


def enqueue(session: Session, job: Job, now: float) -> None:
    """Write the messages of a job's change, in the transaction of the change."""
    event = f"job.{job.state}"
    if event not in EVENTS or job.deleted_at is not None:
        return
    wanted = select(Endpoint).where(Endpoint.owner == job.owner, Endpoint.disabled_at.is_(None))
    for endpoint in session.scalars(wanted):
        if event in endpoint.events:
            data = {"id": job.id, "kind": job.kind, "parent": job.parent, **journal.snapshot(job)}
            session.add(_message(endpoint.id, event, data, now))


class Outbox:
    """Thread-safe; every method is one short transaction."""

    def __init__(self, engine: Engine, clock: Callable[[], float] = time.time) -> None:
        self._session = sessionmaker(engine, expire_on_commit=False)
        self._clock = clock

    def create(self, owner: str, url: str, events: Sequence[str]) -> Endpoint:
        """A new receiver. Raises TooManyEndpointsError."""
        secret = "whsec_" + base64.b64encode(secrets.token_bytes(32)).decode()
        endpoint = Endpoint(
            id=str(uuid.uuid4()),
            owner=owner,
            url=url,
            events=list(events),
            secret=secret,
            created_at=self._clock(),
        )
        with self._session.begin() as session:
            session.add(endpoint)
            session.flush()
            if (session.scalar(select(func.count()).where(Endpoint.owner == owner)) or 0) > MAX_ENDPOINTS:
                raise TooManyEndpointsError
        return endpoint

    def list(self, owner: str | None) -> list[Endpoint]:
        """The owner's receivers (None: everybody's), oldest first."""
        query = select(Endpoint).order_by(Endpoint.created_at)
        if owner is not None:
            query = query.where(Endpoint.owner == owner)
        with self._session() as session:
            return [*session.scalars(query)]

    def get(self, endpoint_id: str, owner: str | None) -> Endpoint | None:
        """The receiver; None when it is unknown or not ``owner``'s."""
        with self._session() as session:
            found = session.get(Endpoint, endpoint_id)
        return found if found is not None and owner in (None, found.owner) else None

    def delete(self, endpoint_id: str) -> None:
        """Forget a receiver and its messages."""
        with self._session.begin() as session:
            session.execute(delete(Message).where(Message.endpoint_id == endpoint_id))
            session.execute(delete(Endpoint).where(Endpoint.id == endpoint_id))

    def ping(self, endpoint_id: str) -> None:
        """A message to try the receiver with."""
        with self._session.begin() as session:
            session.add(_message(endpoint_id, PING, {}, self._clock()))

    def messages(self, endpoint_id: str, limit: int = 20) -> Sequence[Message]:
        """The latest messages to a receiver, newest first."""
        query = select(Message).where(Message.endpoint_id == endpoint_id)
        with self._session() as session:
            return session.scalars(query.order_by(Message.created_at.desc()).limit(limit)).all()

    def take(self) -> Delivery | None:
        """The message most overdue, for the caller to send; nobody else gets it for a while."""
        now = self._clock()
        due = (Message.finished_at.is_(None), Message.due_at <= now)
        with self._session() as session:
            candidate = session.scalar(select(Message).where(*due).order_by(Message.due_at).limit(1))
        if candidate is None:
            return None
        taken = (
            update(Message)
            .where(Message.id == candidate.id, Message.attempts == candidate.attempts, *due)
            .values(attempts=Message.attempts + 1, due_at=now + TAKEN_SECONDS)
        ).execution_options(synchronize_session=False)
        with self._session.begin() as session:
            if session.execute(taken).rowcount != 1:  # type: ignore[attr-defined]
                return None
            endpoint = session.get(Endpoint, candidate.endpoint_id)
            if endpoint is None or endpoint.disabled_at is not None:
                values = {"finished_at": now, "outcome": "the receiver is gone"}
                session.execute(update(Message).where(Message.id == candidate.id).values(values))
                return None
        attempt = candidate.attempts + 1
        return Delivery(
            candidate.id, attempt, candidate.body, endpoint.url, endpoint.secret, candidate.endpoint_id
        )

    def delivered(self, delivery: Delivery, outcome: str) -> None:
        """The receiver took it."""
        self._end(delivery, {"finished_at": self._clock(), "delivered": True, "outcome": outcome})

    def failed(self, delivery: Delivery, outcome: str, *, gone: bool = False) -> None:
        """The receiver did not: another time, or never again (``gone``, or the last attempt)."""
        now = self._clock()
        if gone:
            with self._session.begin() as session:
                session.execute(
                    update(Endpoint).where(Endpoint.id == delivery.endpoint_id).values(disabled_at=now)
                )
        if gone or delivery.attempt > len(PAUSES):
            self._end(delivery, {"finished_at": now, "outcome": outcome[:200]})
        else:
            # A little earlier or later each time: many messages that failed together do not come together.
            spread = 1.0 + 0.1 * secrets.randbelow(1000) / 1000
            self._end(
                delivery, {"due_at": now + PAUSES[delivery.attempt - 1] * spread, "outcome": outcome[:200]}
            )

    def sweep(self) -> None:
        """Forget messages that were finished a week ago."""
        with self._session.begin() as session:
            old = self._clock() - _KEPT_SECONDS
            session.execute(delete(Message).where(Message.finished_at < old))

    def _end(self, delivery: Delivery, values: dict[str, object]) -> None:
        with self._session.begin() as session:
            session.execute(
                update(Message)
                .where(Message.id == delivery.message_id, Message.attempts == delivery.attempt)
                .values(values)
            )


def _message(endpoint_id: str, event: str, data: dict[str, object], now: float) -> Message:
    moment = datetime.fromtimestamp(now, UTC).isoformat()
    body = json.dumps({"type": event, "timestamp": moment, "data": data}, separators=(",", ":"))
    return Message(
        id=f"msg_{uuid.uuid4().hex}",
        endpoint_id=endpoint_id,
        event=event,
        body=body,
        created_at=now,
        due_at=now,
        attempts=0,
    )
