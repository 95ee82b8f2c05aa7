"""What a service says, as the client's types: jobs, files, events, refusals."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import httpx

from service.errors import ServiceError

FINAL = frozenset({"succeeded", "failed", "cancelled", "expired"})


@dataclass(frozen=True)
class JobError:
    """Why a job failed."""

    code: str
    message: str
    advice: str


@dataclass(frozen=True)
class JobInfo:
    """A job as the service described it; ``fraction`` from 0 to 1, ``time_left`` in seconds or unknown."""

    id: str
    state: str
    stage: str | None
    fraction: float
    time_left: float | None
    message: str
    attempt: int
    error: JobError | None
    created_at: str

    @property
    def finished(self) -> bool:
        """Whether the state is final."""
        return self.state in FINAL


@dataclass(frozen=True)
class AssetInfo:
    """A file of a finished job."""

    name: str
    bytes: int
    sha256: str


@dataclass(frozen=True)
class EventInfo:
    """One event of a job; ``id`` counts from 1 without gaps."""

    id: int
    kind: str
    data: dict[str, Any]


def parse_events(lines: Iterator[str]) -> Iterator[EventInfo]:
    """Server-sent events, as far as this service uses the format."""
    fields: dict[str, str] = {}
    for line in lines:
        name, _, value = line.partition(":")
        if line:
            fields[name] = value.removeprefix(" ")
            continue
        if "data" in fields and fields.get("id", "").isdecimal():
            yield EventInfo(int(fields["id"]), fields.get("event", "message"), json.loads(fields["data"]))
        fields = {}


def refusal(response: httpx.Response) -> ServiceError:
    """The error that an answer is, whoever wrote it."""
    try:
        body = response.json()
    except ValueError:
        body = {}
    if not isinstance(body, dict):
        body = {}
    message = body.get("detail") or body.get("title") or f"The service answered {response.status_code}."
    faults = [f"{error.get('field')}: {error.get('message')}" for error in body.get("errors") or []]
    return ServiceError(
        response.status_code,
        body.get("code", f"http.{response.status_code}"),
        "; ".join([message, *faults]),
        body.get("advice", ""),
    )


def parse_job(body: Mapping[str, Any]) -> JobInfo:
    """A job from its JSON."""
    error = body.get("error")
    return JobInfo(
        id=body["id"],
        state=body["state"],
        stage=body["stage"],
        fraction=body["fraction"],
        time_left=body["time_left"],
        message=body["message"],
        attempt=body["attempt"],
        error=None if error is None else JobError(error["code"], error["message"], error["advice"]),
        created_at=body["created_at"],
    )
