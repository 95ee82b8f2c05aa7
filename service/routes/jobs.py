"""Jobs: list, look, cancel, restart, delete. How they come in is routes/submission.py."""

from __future__ import annotations

import hashlib
from typing import Annotated

from fastapi import APIRouter, Path, Query, Request, Response
from fastapi.responses import JSONResponse

from service.access.gate import CallerDep
from service.jobs.housekeeping import purge_deleted
from service.jobs.model import JobState, is_job_id
from service.jobs.schemas import JobPage, JobView, job_view
from service.jobs.store import Cancel
from service.problems import Kind, ProblemError, declared
from service.services import ServicesDep, not_modified
from service.tus import lifecycle

router = APIRouter(prefix="/jobs", tags=["jobs"])

JobId = Annotated[str, Path(description="The id `POST /jobs` answered with.", max_length=64)]


Cursor = Annotated[str | None, Query(max_length=64, description="`next` of the page before.")]


def checked_cursor(cursor: str | None) -> str | None:
    """The cursor, if it is one. Raises ProblemError (422)."""
    if cursor is not None and not is_job_id(cursor):
        error = {"field": "query.cursor", "message": "Not a cursor this service gave out."}
        raise ProblemError(Kind.REQUEST_INVALID, errors=[error])
    return cursor


@router.get("", responses=declared(Kind.REQUEST_INVALID))
def list_jobs(
    services: ServicesDep,
    caller: CallerDep,
    limit: Annotated[int, Query(ge=1, le=100)] = 20,
    cursor: Cursor = None,
    state: Annotated[list[JobState] | None, Query(max_length=8, description="Only jobs in these.")] = None,
) -> JobPage:
    """The jobs, newest first. A job that arrives while the pages are read belongs before the first."""
    jobs, following = services.store.page(limit, checked_cursor(cursor), caller.sees, state or ())
    return JobPage(jobs=[job_view(job) for job in jobs], next=following)


@router.get(
    "/{job_id}",
    response_model=JobView,
    responses={304: {"description": "Unchanged since the ETag sent."}, **declared(Kind.JOB_NOT_FOUND)},
)
def get_job(job_id: JobId, request: Request, services: ServicesDep, caller: CallerDep) -> Response:
    """State, stage, progress and, if it failed, why. Poll with `If-None-Match`."""
    body = job_view(services.job(job_id, caller)).model_dump(mode="json")
    response = JSONResponse(body, headers={"Cache-Control": "private, no-cache"})
    etag = f'"{hashlib.sha256(response.body).hexdigest()[:32]}"'
    if not_modified(request, etag):
        return Response(status_code=304, headers={"ETag": etag})
    response.headers["ETag"] = etag
    return response


@router.post(
    "/{job_id}/cancel",
    responses={
        200: {"description": "The job is cancelled."},
        202: {"description": "A worker is stopping it; the state is `cancelling`.", "model": JobView},
        **declared(Kind.JOB_NOT_FOUND, Kind.JOB_FINISHED),
    },
)
def cancel_job(job_id: JobId, services: ServicesDep, caller: CallerDep, response: Response) -> JobView:
    """End a job that has not begun at once, or have a running one stopped. May be repeated."""
    services.job(job_id, caller)
    outcome = services.store.request_cancel(job_id)
    job = services.job(job_id, caller)
    if outcome is Cancel.FINISHED:
        raise ProblemError(Kind.JOB_FINISHED, f"The job is {job.state}.")
    if outcome is Cancel.CANCELLED:
        lifecycle.end(services.uploads, services.store, services.storage, job_id)
    response.status_code = 200 if job.state == JobState.CANCELLED else 202
    return job_view(job)


@router.delete("/{job_id}", status_code=204, responses=declared(Kind.JOB_NOT_FOUND))
def delete_job(job_id: JobId, services: ServicesDep, caller: CallerDep) -> None:
    """Remove the job, its video and its results. A running job vanishes at once; its bytes go when its
    worker has stopped."""
    services.job(job_id, caller)
    if not services.store.delete(job_id):
        raise ProblemError(Kind.JOB_NOT_FOUND)
    services.uploads.remove(job_id)
    services.pictures.drop(job_id)
    purge_deleted(services.store, services.storage)
