"""Jobs: submit, list, look, cancel, delete."""

from __future__ import annotations

import hashlib
from typing import Annotated, Any

from fastapi import APIRouter, Path, Query, Request, Response
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import JSONResponse

from service.jobs.housekeeping import purge_deleted
from service.jobs.model import Job, is_job_id, new_job_id
from service.jobs.schemas import JobOptions, JobPage, JobView, job_view
from service.jobs.store import Cancel
from service.problems import Kind, ProblemError, declared
from service.queue import queue_for
from service.services import Services, ServicesDep, not_modified
from service.uploads import ReceivedForm, receive_form, refuse_early

router = APIRouter(prefix="/jobs", tags=["jobs"])

JobId = Annotated[str, Path(description="The id `POST /jobs` answered with.", max_length=64)]

_FORM: dict[str, Any] = {
    "required": True,
    "content": {
        "multipart/form-data": {
            "schema": {
                "type": "object",
                "required": ["video"],
                "additionalProperties": False,
                "properties": {
                    "video": {
                        "type": "string",
                        "contentMediaType": "application/octet-stream",
                        "description": "An MP4, MOV or WebM file of one hand.",
                    },
                    "options": {
                        "type": "string",
                        "contentMediaType": "application/json",
                        "contentSchema": JobOptions.model_json_schema(),
                        "description": "JSON; every option may be left out.",
                    },
                },
            },
            "encoding": {"options": {"contentType": "application/json"}},
        }
    },
}


@router.post(
    "",
    status_code=202,
    response_model=JobView,
    openapi_extra={"requestBody": _FORM},
    responses={
        202: {
            "description": "Accepted; `Location` is where to look for progress.",
            "headers": {"Location": {"schema": {"type": "string"}}},
        },
        **declared(
            Kind.REQUEST_MALFORMED,
            Kind.UPLOAD_INCOMPLETE,
            Kind.UPLOAD_STALLED,
            Kind.UPLOAD_TOO_LARGE,
            Kind.REQUEST_MEDIA_TYPE,
            Kind.VIDEO_CONTAINER,
            Kind.REQUEST_INVALID,
            Kind.VIDEO_MISSING,
            Kind.VIDEO_EMPTY,
            Kind.OPTIONS_INVALID,
            Kind.STORAGE_FULL,
        ),
    },
)
async def create_job(request: Request, response: Response, services: ServicesDep) -> JobView:
    """Submit a video. It is written to disk as it arrives and refused at the first thing wrong with it."""
    limit = services.settings.max_upload_bytes
    refuse_early(request, services.storage, limit)
    job_id = new_job_id()
    target = await run_in_threadpool(services.storage.begin_upload, job_id)
    try:
        form = await receive_form(request, target, services.storage, limit)
        job = await run_in_threadpool(_accept, services, job_id, form)
    except BaseException:
        # Not awaited in a thread: a cancelled request may await nothing more.
        services.storage.discard_upload(job_id)
        raise
    await run_in_threadpool(_announce, services, job)
    response.headers["Location"] = f"/jobs/{job_id}"
    return job_view(job)


def _accept(services: Services, job_id: str, form: ReceivedForm) -> Job:
    video = services.storage.finish_upload(job_id)
    options = form.options.model_dump(exclude_none=True)
    queue = queue_for(options, services.settings)
    return services.store.create(options, video, job_id=job_id, video_bytes=form.video_bytes, queue=queue)


def _announce(services: Services, job: Job) -> None:
    if services.queue.publish(job.id, job.queue):
        services.store.mark_published(job.id)


@router.get("", responses=declared(Kind.REQUEST_INVALID))
def list_jobs(
    services: ServicesDep,
    limit: Annotated[int, Query(ge=1, le=100)] = 20,
    cursor: Annotated[str | None, Query(max_length=64, description="`next` of the page before.")] = None,
) -> JobPage:
    """The jobs, newest first."""
    if cursor is not None and not is_job_id(cursor):
        error = {"field": "query.cursor", "message": "Not a cursor this service gave out."}
        raise ProblemError(Kind.REQUEST_INVALID, errors=[error])
    jobs, following = services.store.page(limit, cursor)
    return JobPage(jobs=[job_view(job) for job in jobs], next=following)


@router.get(
    "/{job_id}",
    response_model=JobView,
    responses={304: {"description": "Unchanged since the ETag sent."}, **declared(Kind.JOB_NOT_FOUND)},
)
def get_job(job_id: JobId, request: Request, services: ServicesDep) -> Response:
    """State, stage, progress and, if it failed, why. Poll with `If-None-Match`."""
    body = job_view(services.job(job_id)).model_dump(mode="json")
    response = JSONResponse(body, headers={"Cache-Control": "private, no-cache"})
    etag = f'"{hashlib.sha256(response.body).hexdigest()[:32]}"'
    if not_modified(request, etag):
        return Response(status_code=304, headers={"ETag": etag})
    response.headers["ETag"] = etag
    return response


@router.post("/{job_id}/cancel", status_code=202, responses=declared(Kind.JOB_NOT_FOUND, Kind.JOB_FINISHED))
def cancel_job(job_id: JobId, services: ServicesDep) -> JobView:
    """End a queued job at once, or have a running one stopped. May be repeated while it is stopping."""
    job = services.job(job_id)
    if services.store.request_cancel(job.id) == Cancel.FINISHED:
        raise ProblemError(Kind.JOB_FINISHED, f"The job is {job.state}.")
    return job_view(services.job(job_id))


@router.delete("/{job_id}", status_code=204, responses=declared(Kind.JOB_NOT_FOUND))
def delete_job(job_id: JobId, services: ServicesDep) -> None:
    """Remove the job, its video and its results. A running job vanishes at once; its bytes go when its
    worker has stopped."""
    if not is_job_id(job_id) or not services.store.delete(job_id):
        raise ProblemError(Kind.JOB_NOT_FOUND)
    services.pictures.drop(job_id)
    purge_deleted(services.store, services.storage)
