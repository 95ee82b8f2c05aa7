"""API keys: made once, shown once, kept as hashes."""

from __future__ import annotations

import hashlib
import hmac
import re
import secrets
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from enum import StrEnum

from sqlalchemy import JSON, Engine, String, select, update
from sqlalchemy.orm import Mapped, mapped_column, sessionmaker

from service.jobs.model import LOCAL, Base

_KEY = re.compile(r"mass_([0-9a-f]{16})_([A-Za-z0-9_-]{43})")
_OWNER = re.compile(r"[A-Za-z0-9][A-Za-z0-9._@-]{0,63}")


class Scope(StrEnum):
    """What a key may do. ``read``: look and download; ``write``: also submit, change and delete; ``admin``:
    also everybody's jobs and the service's figures."""

    READ = "read"
    WRITE = "write"
    ADMIN = "admin"


#: What each scope brings with it.
_INCLUDES = {
    Scope.READ: {Scope.READ},
    Scope.WRITE: {Scope.READ, Scope.WRITE},
    Scope.ADMIN: {Scope.READ, Scope.WRITE, Scope.ADMIN},
}


class ApiKey(Base):
    """One key. ``hash`` is the SHA-256 of its secret half, which has 256 random bits: no salt is needed."""

    __tablename__ = "api_keys"

    id: Mapped[str] = mapped_column(String(16), primary_key=True)
    owner: Mapped[str] = mapped_column(String(64))
    scopes: Mapped[list[str]] = mapped_column(JSON)
    hash: Mapped[str] = mapped_column(String(64))
    created_at: Mapped[float]
    expires_at: Mapped[float | None] = mapped_column(default=None)
    revoked_at: Mapped[float | None] = mapped_column(default=None)


@dataclass(frozen=True)
class Caller:
    """Who sent a request. ``owner``: whose the things they make are. ``limited``: quotas apply."""

    owner: str
    scopes: frozenset[Scope]
    limited: bool = True

    @property
    def sees(self) -> str | None:
        """The owner whose things they see; None for everybody's."""
        return None if Scope.ADMIN in self.scopes else self.owner


#: Whoever reaches a service that asks for no key.
ANYONE = Caller(LOCAL, frozenset(Scope), limited=False)


class KeyStore:
    """Thread-safe; every method is one short transaction."""

    def __init__(self, engine: Engine, clock: Callable[[], float] = time.time) -> None:
        self._session = sessionmaker(engine, expire_on_commit=False)
        self._clock = clock

    def create(self, owner: str, scopes: Iterable[Scope], days: float | None = None) -> str:
        """A new key, which cannot be had again. Raises ValueError for an unusable owner."""
        if _OWNER.fullmatch(owner) is None:
            raise ValueError("An owner is 1 to 64 letters, digits or ._@- and begins with a letter or digit.")
        now, key_id, secret = self._clock(), secrets.token_hex(8), secrets.token_urlsafe(32)
        names = sorted(set(scopes))
        expires_at = None if days is None else now + days * 86400
        with self._session.begin() as session:
            session.add(
                ApiKey(
                    id=key_id,
                    owner=owner,
                    scopes=names,
                    hash=_hash(secret),
                    created_at=now,
                    expires_at=expires_at,
                )
            )
        return f"mass_{key_id}_{secret}"

    def check(self, key: str) -> Caller | None:
        """Whose key it is; None when it is none, expired or revoked. Takes as long either way."""
        match = _KEY.fullmatch(key)
        key_id, secret = match.groups() if match else ("", "")
        with self._session() as session:
            row = session.get(ApiKey, key_id)
        same = hmac.compare_digest(_hash(secret), row.hash if row else "0" * 64)
        if row is None or not same or row.revoked_at is not None:
            return None
        if row.expires_at is not None and row.expires_at <= self._clock():
            return None
        scopes = frozenset[Scope]().union(*(_INCLUDES[Scope(name)] for name in row.scopes))
        return Caller(row.owner, scopes)

    def list(self) -> list[ApiKey]:
        """All keys, oldest first."""
        with self._session() as session:
            return [*session.scalars(select(ApiKey).order_by(ApiKey.created_at))]

    def revoke(self, key_id: str) -> bool:
        """End a key at once. False when there is none to end."""
        statement = update(ApiKey).where(ApiKey.id == key_id, ApiKey.revoked_at.is_(None))
        with self._session.begin() as session:
            result = session.execute(statement.values(revoked_at=self._clock()))
            return bool(result.rowcount == 1)  # type: ignore[attr-defined]


def _hash(secret: str) -> str:
    return hashlib.sha256(secret.encode()).hexdigest()
