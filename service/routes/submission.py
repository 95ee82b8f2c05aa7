"""How jobs come in: a video with its options, or another job's video with other options."""

from __future__ import annotations

from functools import partial
from typing import Annotated, Any

from fastapi import APIRouter, Header, Request, Response
from fastapi.concurrency import run_in_threadpool
from pydantic import ValidationError

from service.access.gate import CallerDep
from service.access.keys import Caller
from service.jobs.model import FINAL_STATES, JobKind
from service.jobs.schemas import JobOptions, JobView, RestartRequest, UploadedJob, job_view
from service.problems import Kind, ProblemError, declared, field_errors
from service.routes.jobs import JobId
from service.services import Services, ServicesDep
from service.submission import (
    Wanted,
    changed_options,
    fingerprint,
    refuse_over_quota,
    spelled,
    submit,
    submit_upload,
)
from service.uploads import declared_length, media_type, receive_form, refuse_early

router = APIRouter(prefix="/jobs", tags=["jobs"])

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
                        "description": "An MP4, MOV or WebM file.",
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
        },
        "application/json": {"schema": {"$ref": "#/components/schemas/UploadedJob"}},
    },
}

ACCEPTED: dict[int | str, dict[str, Any]] = {
    202: {
        "description": "Accepted; `Location` is where to look for progress.",
        "headers": {
            "Location": {"schema": {"type": "string"}},
            "Idempotency-Replayed": {
                "schema": {"type": "string", "enum": ["true"]},
                "description": "The job was made by an earlier request with the same key.",
            },
        },
    }
}
IDEMPOTENCY = (Kind.IDEMPOTENCY_IN_PROGRESS, Kind.IDEMPOTENCY_MISMATCH, Kind.JOB_NOT_FOUND)

_MAX_JSON = 64 * 1024

IdempotencyKey = Annotated[
    str | None,
    Header(
        description="Makes it safe to send the request again: with the same key and body it makes no second "
        "job. 1 to 128 visible ASCII characters, remembered for 24 hours.",
        examples=["5f0c7e1a-8d1c-4b7e-9d55-0e6f0b7f2f11"],
    ),
]


@router.post(
    "",
    status_code=202,
    response_model=JobView,
    openapi_extra={"requestBody": _FORM},
    responses={
        **ACCEPTED,
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
            Kind.QUOTA,
            Kind.UPLOAD_NOT_FOUND,
            Kind.UPLOAD_USED,
            *IDEMPOTENCY,
        ),
    },
)
async def create_job(
    request: Request,
    response: Response,
    services: ServicesDep,
    caller: CallerDep,
    idempotency_key: IdempotencyKey = None,
) -> JobView:
    """Submit a video: in a form, written to disk as it arrives and refused at the first thing wrong with it,
    or as the id of an upload, which may still be under way (the job awaits it then)."""
    if media_type(request) == "application/json":
        wish = await _uploaded(request)
        make = partial(submit_upload, services, request, response, caller, idempotency_key)
        return job_view(await run_in_threadpool(make, wish.upload, wish.options))
    limit = services.settings.max_upload_bytes
    refuse_early(request, services.storage, limit)
    await run_in_threadpool(refuse_over_quota, services, caller, declared_length(request))

    async def receive(job_id: str) -> Wanted:
        target = await run_in_threadpool(services.storage.begin_upload, job_id)
        form = await receive_form(request, target, services.storage, limit)
        video = await run_in_threadpool(services.storage.finish_upload, job_id)
        mark = fingerprint("POST /jobs", form.video_sha256, spelled(form.options))
        return Wanted(job_id, form.options, video, form.video_bytes, mark)

    return job_view(await submit(services, request, response, caller, idempotency_key, receive))


async def _uploaded(request: Request) -> UploadedJob:
    body = b""
    async for chunk in request.stream():
        body += chunk
        if len(body) > _MAX_JSON:
            problem = ProblemError(Kind.UPLOAD_TOO_LARGE, f"The JSON may have {_MAX_JSON} bytes.")
            problem.unread = True
            raise problem
    try:
        return UploadedJob.model_validate_json(body)
    except ValidationError as error:
        only_options = all(fault["loc"][:1] == ("options",) for fault in error.errors())
        kind = Kind.OPTIONS_INVALID if only_options else Kind.REQUEST_INVALID
        raise ProblemError(kind, errors=field_errors(error.errors())) from error


@router.post(
    "/{job_id}/restart",
    status_code=202,
    response_model=JobView,
    responses={
        **ACCEPTED,
        **declared(
            Kind.REQUEST_INVALID,
            Kind.OPTIONS_INVALID,
            Kind.JOB_UNFINISHED,
            Kind.JOB_NO_VIDEO,
            Kind.QUOTA,
            *IDEMPOTENCY,
        ),
    },
)
async def restart_job(
    job_id: JobId,
    request: Request,
    response: Response,
    services: ServicesDep,
    caller: CallerDep,
    body: RestartRequest | None = None,
    idempotency_key: IdempotencyKey = None,
) -> JobView:
    """Make a new job of a finished one's video: after a failure, with other options, from a later stage.

    The first job stays as it is; each has its own result and is deleted by itself.
    """
    wish = body or RestartRequest()

    async def receive(new_id: str) -> Wanted:
        return await run_in_threadpool(_again, services, caller, job_id, new_id, wish)

    return job_view(await submit(services, request, response, caller, idempotency_key, receive))


def _again(services: Services, caller: Caller, job_id: str, new_id: str, wish: RestartRequest) -> Wanted:
    job = services.job(job_id, caller)
    if job.kind != JobKind.FIT:
        raise ProblemError(Kind.JOB_NO_VIDEO, "It renders a motion; ask its parent for another.")
    if job.state not in FINAL_STATES:
        raise ProblemError(Kind.JOB_UNFINISHED, f"The job is {job.state}.")
    options = changed_options(job.options, wish.options)
    try:
        video = services.storage.share(services.storage.source(job.video), new_id)
    except FileNotFoundError:
        raise ProblemError(Kind.JOB_NO_VIDEO) from None
    if wish.from_stage is not None:
        services.storage.share_checkpoint(job_id, new_id)
    mark = fingerprint(f"POST /jobs/{job_id}/restart", wish.from_stage or "", spelled(options))
    return Wanted(new_id, options, video, job.video_bytes, mark, job_id, wish.from_stage)
