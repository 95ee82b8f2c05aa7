"""Whether the service can do its work now: every part it needs, asked with little patience."""

from __future__ import annotations

from dataclasses import dataclass

import redis
from redis.backoff import NoBackoff
from redis.retry import Retry
from sqlalchemy.exc import SQLAlchemyError

from service.pulse import live_workers
from service.queue import broker_url
from service.services import Services
from service.settings import Settings

_SECONDS = 2.0


@dataclass(frozen=True)
class Check:
    """One part: its name, what is wrong with it (empty: nothing)."""

    name: str
    trouble: str


def check_all(services: Services) -> list[Check]:
    """Ask every part."""
    return [
        Check("database", _database(services)),
        Check("broker", _broker(services.settings)),
        Check("disk", "" if services.storage.has_room() else "less space is free than is to be left free"),
        Check("workers", "" if live_workers(services.settings.data_dir) else "no worker is alive"),
    ]


def _database(services: Services) -> str:
    try:
        services.store.ping()
    except SQLAlchemyError as error:
        return f"it does not answer ({type(error).__name__})"
    return ""


def _broker(settings: Settings) -> str:
    url = broker_url(settings)
    if not url.startswith(("redis", "unix", "valkey")):
        return ""  # a folder needs no asking
    client = redis.Redis.from_url(
        url.replace("redis+socket://", "unix://", 1),
        socket_timeout=_SECONDS,
        socket_connect_timeout=_SECONDS,
        retry=Retry(NoBackoff(), 0),
    )
    try:
        client.ping()
    except (redis.RedisError, OSError) as error:
        return f"it does not answer ({type(error).__name__})"
    finally:
        client.close()
    return ""
