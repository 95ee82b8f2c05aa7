"""What a job is doing: events, log lines, and a look at the hand while it is being fitted."""

from __future__ import annotations

import hashlib
from collections.abc import AsyncIterator
from datetime import UTC, datetime
from typing import Annotated, Any

from fastapi import APIRouter, Header, Query, Request, Response
from fastapi.concurrency import run_in_threadpool
from fastapi.sse import EventSourceResponse
from pydantic import BaseModel, Field

from service.access.gate import CallerDep
from service.jobs.model import FINAL_STATES
from service.jobs.schemas import ErrorView
from service.problems import Kind, ProblemError, declared
from service.routes.jobs import JobId
from service.services import ServicesDep, not_modified
from service.watching import follow

router = APIRouter(prefix="/jobs", tags=["progress"])

_ANY = 2**53


class JobEventData(BaseModel):
    """The `data` of an event. Within one attempt `fraction` never falls."""

    seq: int = Field(description="The event's id: counts from 1 per job, without gaps.")
    at: float = Field(description="Seconds since 1970.")
    state: str
    stage: str | None
    attempt: int
    fraction: float
    time_left: float | None
    message: str
    error: ErrorView | None = None


class LogLine(BaseModel):
    """One line the engine said."""

    id: int
    at: datetime
    attempt: int
    text: str


class LogPage(BaseModel):
    """Some lines, oldest first."""

    lines: list[LogLine]
    next: int = Field(description="Pass as `after` for what comes later, also when there was nothing new.")


_STREAM: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "Events `state` and `progress`; `data` is JSON (`JobEventData`). The stream ends with "
        "the job; an EventSource that comes back after that is told 204 and stays away.",
        "content": {
            "text/event-stream": {
                "schema": {
                    "type": "object",
                    "required": ["data"],
                    "properties": {
                        "event": {"type": "string", "enum": ["state", "progress"]},
                        "id": {"type": "string"},
                        "data": {
                            "type": "string",
                            "contentMediaType": "application/json",
                            "contentSchema": {"$ref": "#/components/schemas/JobEventData"},
                        },
                    },
                },
                "example": 'event: progress\nid: 7\ndata: {"seq": 7, "state": "running", "stage": "fit", '
                '"attempt": 1, "fraction": 0.41, "time_left": 95.0, "message": "", "at": 1780000000.0}\n\n',
            }
        },
    },
    204: {"description": "Nothing can follow the event named: the job is over."},
}


@router.get(
    "/{job_id}/events",
    response_class=Response,
    responses={**_STREAM, **declared(Kind.JOB_NOT_FOUND, Kind.REQUEST_INVALID, Kind.STREAMS)},
)
async def watch_job(
    job_id: JobId,
    services: ServicesDep,
    caller: CallerDep,
    last_event_id: Annotated[
        str | None, Header(max_length=20, description="The last event seen; the stream goes on after it.")
    ] = None,
    after: Annotated[int, Query(ge=0, le=_ANY, description="The same, where a header cannot be sent.")] = 0,
) -> Response:
    """Follow the job as server-sent events, from its first event or from the one named."""
    job = await run_in_threadpool(services.job, job_id, caller)
    if last_event_id is not None:
        if not last_event_id.isascii() or not last_event_id.isdecimal():
            error = {"field": "header.last-event-id", "message": "Not the id of an event."}
            raise ProblemError(Kind.REQUEST_INVALID, errors=[error])
        after = max(after, int(last_event_id))
    if job.state in FINAL_STATES and after >= job.event_seq:
        return Response(status_code=204)
    if not services.streams.room(job.owner):
        raise ProblemError(Kind.STREAMS, headers={"Retry-After": "30"})

    async def stream() -> AsyncIterator[bytes]:
        with services.streams.held(job.owner):
            async for event in follow(services.store, job_id, after):
                yield event

    return EventSourceResponse(stream(), headers={"Cache-Control": "no-cache", "X-Accel-Buffering": "no"})


@router.get("/{job_id}/logs", responses=declared(Kind.JOB_NOT_FOUND, Kind.REQUEST_INVALID))
def get_logs(
    job_id: JobId,
    services: ServicesDep,
    caller: CallerDep,
    after: Annotated[int, Query(ge=0, le=_ANY, description="`next` of the page before.")] = 0,
    limit: Annotated[int, Query(ge=1, le=1000)] = 200,
) -> LogPage:
    """What the engine said, oldest first."""
    services.job(job_id, caller)
    lines = [
        LogLine(id=line.id, at=datetime.fromtimestamp(line.at, UTC), attempt=line.attempt, text=line.text)
        for line in services.store.logs(job_id, after, limit)
    ]
    return LogPage(lines=lines, next=lines[-1].id if lines else after)


@router.get(
    "/{job_id}/preview",
    response_class=Response,
    responses={
        200: {
            "description": "The picture.",
            "content": {
                f"image/{name}": {"schema": {"type": "string", "contentMediaType": f"image/{name}"}}
                for name in ("jpeg", "png")
            },
        },
        304: {"description": "Unchanged since the ETag sent."},
        **declared(Kind.JOB_NOT_FOUND, Kind.PREVIEW_NONE),
    },
)
def get_preview(job_id: JobId, request: Request, services: ServicesDep, caller: CallerDep) -> Response:
    """The hand as it is now: the latest look while the engine fits it, the rest pose once it has finished."""
    job = services.job(job_id, caller)
    if job.artifact is not None:
        found = services.storage.preview(job_id, job.artifact)
    elif job.token is not None:
        found = services.storage.preview(job_id, f"{job.attempt}-{job.token}")
    else:
        found = None
    if found is None:
        raise ProblemError(Kind.PREVIEW_NONE, f"The job is {job.state}.", headers={"Retry-After": "5"})
    picture, media_type = found
    headers = {"ETag": f'"{hashlib.sha256(picture).hexdigest()[:32]}"', "Cache-Control": "private, no-cache"}
    if not_modified(request, headers["ETag"]):
        return Response(status_code=304, headers=headers)
    return Response(picture, media_type=media_type, headers=headers)
