"""Links that work without a key for a while: what a browser's img, a and EventSource need."""

from __future__ import annotations

import re
from datetime import UTC, datetime
from typing import Annotated
from urllib.parse import quote

from fastapi import APIRouter
from pydantic import BaseModel, ConfigDict, Field

from service.access.gate import CallerDep
from service.access.links import MAX_SECONDS
from service.problems import Kind, ProblemError, declared
from service.routes.jobs import JobId
from service.services import ServicesDep

router = APIRouter(prefix="/jobs", tags=["results"])

_TARGET = re.compile(
    r"(?:assets/[\w./-]{1,200}|renders/[\w-]{1,64}/file|render|preview|events|logs)", re.ASCII
)


class LinkRequest(BaseModel):
    """What to link to."""

    model_config = ConfigDict(extra="forbid")

    target: Annotated[
        str,
        Field(
            max_length=2500,
            description="A path below the job that GET answers, with its query.",
            examples=["assets/surfels.ply", "render?pose=fist&width=256&height=256", "events"],
        ),
    ]
    seconds: Annotated[int, Field(ge=1, le=MAX_SECONDS, description="How long it works.")] = 300


class Link(BaseModel):
    """A path with a signature."""

    href: str
    expires_at: datetime


@router.post("/{job_id}/links", responses=declared(Kind.JOB_NOT_FOUND, Kind.REQUEST_INVALID))
def create_link(job_id: JobId, body: LinkRequest, services: ServicesDep, caller: CallerDep) -> Link:
    """Sign a link to something of the job. Whoever has the link can GET just that until it runs out."""
    services.job(job_id, caller)
    name, _, query = body.target.partition("?")
    if _TARGET.fullmatch(name) is None:
        error = {"field": "body.target", "message": "Not something of a job that GET answers."}
        raise ProblemError(Kind.REQUEST_INVALID, errors=[error])
    href, until = services.signer.sign(f"/jobs/{job_id}/{quote(name)}", query, body.seconds)
    return Link(href=href, expires_at=datetime.fromtimestamp(until, UTC))
