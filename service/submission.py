"""From a request to a queued job: at most one per Idempotency-Key, and never a row without its video."""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass
from typing import Any

from fastapi import Request, Response
from fastapi.concurrency import run_in_threadpool
from pydantic import ValidationError
from sqlalchemy.exc import IntegrityError

from service.access.keys import Caller
from service.access.quotas import QuotaError
from service.jobs.idempotency import Made, Reservation, ReservationLostError, parse_key
from service.jobs.model import Job, JobKind, is_job_id, new_job_id
from service.jobs.schemas import JobOptions, MotionRequest
from service.problems import Kind, ProblemError, field_errors
from service.queue import queue_for
from service.services import Services
from service.tus import lifecycle

#: Says that the answer is about a job made by an earlier request with the same key.
REPLAYED = "Idempotency-Replayed"


@dataclass(frozen=True)
class Wanted:
    """A job about to be inserted; its video is on disk under the id ``job_id``."""

    job_id: str
    options: JobOptions | MotionRequest
    video: str
    video_bytes: int | None
    fingerprint: str
    restarted_from: str | None = None
    from_stage: str | None = None
    kind: JobKind = JobKind.FIT
    parent: str | None = None


_TRACEPARENT = re.compile(r"00-(?!0{32})[0-9a-f]{32}-(?!0{16})[0-9a-f]{16}-[0-9a-f]{2}")
#: Receives the request's body and puts the video in its place, under the id given.
Receive = Callable[[str], Awaitable[Wanted]]


async def submit(
    services: Services,
    request: Request,
    response: Response,
    caller: Caller,
    key: str | None,
    receive: Receive,
) -> Job:
    """Make the job that the request asks for, or find the one an earlier copy of the request made.

    Raises ProblemError; nothing of a refused request stays on disk.
    """
    reservation = await run_in_threadpool(_reserve, services, caller, key)
    job_id = new_job_id()
    made: Job | None = None
    try:
        wanted = await receive(job_id)
        if isinstance(reservation, Made):
            job = await run_in_threadpool(_replay, services, reservation, wanted)
            response.headers[REPLAYED] = "true"
        else:
            job = made = await run_in_threadpool(_insert, services, caller, reservation, wanted, request)
    finally:
        if made is None:
            # Not awaited in a thread: a cancelled request may await nothing more.
            services.storage.discard_upload(job_id)
            services.storage.drop_attempts(job_id)
            if isinstance(reservation, Reservation):
                services.keys.release(reservation)
    if made is not None:
        await run_in_threadpool(announce, services, job.id)
    response.headers["Location"] = f"/jobs/{job.id}"
    return job


def submit_upload(
    services: Services,
    request: Request,
    response: Response,
    caller: Caller,
    key: str | None,
    upload_id: str,
    options: JobOptions,
) -> Job:
    """Make a job of an upload, whole or not yet; it takes the upload's id. Raises ProblemError."""
    reservation = _reserve(services, caller, key)
    mark = fingerprint("POST /jobs", "upload", upload_id, spelled(options))
    wanted = Wanted(upload_id, options, f"uploads/{upload_id}/source", None, mark)
    try:
        if isinstance(reservation, Made):
            job = _replay(services, reservation, wanted)
            response.headers[REPLAYED] = "true"
        else:
            job = _of_upload(services, caller, reservation, wanted, request)
    finally:
        if isinstance(reservation, Reservation):
            services.keys.release(reservation)  # does nothing once a job is bound to it
    response.headers["Location"] = f"/jobs/{job.id}"
    return job


def _of_upload(
    services: Services, caller: Caller, reservation: Reservation | None, wanted: Wanted, request: Request
) -> Job:
    if is_job_id(wanted.job_id) and services.store.get(wanted.job_id, caller.sees) is not None:
        raise ProblemError(Kind.UPLOAD_USED)
    upload = services.uploads.get(wanted.job_id, caller.sees) if is_job_id(wanted.job_id) else None
    if upload is None:
        raise ProblemError(Kind.UPLOAD_NOT_FOUND)
    try:
        _insert(services, caller, reservation, wanted, request, awaits_upload=True)
    except IntegrityError:
        raise ProblemError(Kind.UPLOAD_USED) from None
    # Looked up again: it may have been completed just before the row was there to be told.
    upload = services.uploads.get(wanted.job_id)
    if (
        upload is not None
        and upload.complete
        and lifecycle.hand_over(services.uploads, services.store, upload.id, upload.length)
    ):
        announce(services, upload.id)
    job = services.store.get(wanted.job_id)
    if job is None:
        raise ProblemError(Kind.JOB_NOT_FOUND)
    return job


def announce(services: Services, job_id: str) -> None:
    """Send the wake-up message; one that cannot be sent is left to the reconciler."""
    job = services.store.get(job_id)
    if job is not None and services.queue.publish(job_id, job.queue):
        services.store.mark_published(job_id)


def refuse_over_quota(services: Services, caller: Caller, incoming: int) -> None:
    """Refuse before the body is read what the quota cannot hold. Raises ProblemError (429)."""
    try:
        services.store.check_quota(caller.owner, services.quota(caller), jobs=1, size=incoming)
    except QuotaError as error:
        problem = over_quota(error)
        problem.unread = True
        raise problem from error


def over_quota(error: QuotaError) -> ProblemError:
    """The answer to who wants more than allowed."""
    return ProblemError(Kind.QUOTA, error.detail, headers={"Retry-After": str(error.wait)})


def fingerprint(*parts: str) -> str:
    """What makes two requests with one key the same request."""
    return hashlib.sha256("\x00".join(parts).encode()).hexdigest()


def changed_options(old: Mapping[str, Any], changes: Mapping[str, Any]) -> JobOptions:
    """The options of a restart: null sets one back to its default. Raises ProblemError (422)."""
    merged = {name: value for name, value in {**old, **changes}.items() if value is not None}
    try:
        return JobOptions.model_validate(merged)
    except ValidationError as error:
        raise ProblemError(Kind.OPTIONS_INVALID, errors=field_errors(error.errors())) from error


def traceparent(header: str) -> str:
    """The W3C trace context that was sent, or a new one."""
    if _TRACEPARENT.fullmatch(header):
        return header
    return f"00-{os.urandom(16).hex()}-{os.urandom(8).hex()}-00"


def spelled(options: JobOptions | MotionRequest) -> str:
    """The options as one canonical text."""
    return json.dumps(options.model_dump(exclude_none=True), sort_keys=True)


def _reserve(services: Services, caller: Caller, header: str | None) -> Reservation | Made | None:
    if header is None:
        return None
    key = parse_key(header)
    if key is None:
        error = {"field": "header.idempotency-key", "message": "Not 1 to 128 visible ASCII characters."}
        raise ProblemError(Kind.REQUEST_INVALID, errors=[error])
    found = services.keys.reserve(caller.owner, key)
    if found is None:
        problem = ProblemError(Kind.IDEMPOTENCY_IN_PROGRESS, headers={"Retry-After": "5"})
        problem.unread = True
        raise problem
    return found


def _replay(services: Services, made: Made, wanted: Wanted) -> Job:
    if made.fingerprint != wanted.fingerprint:
        raise ProblemError(Kind.IDEMPOTENCY_MISMATCH)
    job = services.store.get(made.job_id)
    if job is None:
        raise ProblemError(Kind.JOB_NOT_FOUND, "The job that this Idempotency-Key made has been deleted.")
    return job


def _insert(
    services: Services,
    caller: Caller,
    reservation: Reservation | None,
    wanted: Wanted,
    request: Request,
    awaits_upload: bool = False,
) -> Job:
    try:
        options = wanted.options.model_dump(exclude_none=True)
        return services.store.create(
            options,
            wanted.video,
            queue=queue_for(options, services.settings),
            job_id=wanted.job_id,
            owner=caller.owner,
            quota=services.quota(caller),
            awaits_upload=awaits_upload,
            video_bytes=wanted.video_bytes,
            kind=wanted.kind,
            parent=wanted.parent,
            restarted_from=wanted.restarted_from,
            from_stage=wanted.from_stage,
            traceparent=traceparent(request.headers.get("traceparent", "")),
            idempotency_key=None if reservation is None else (reservation, wanted.fingerprint),
        )
    except QuotaError as error:
        raise over_quota(error) from error
    except ReservationLostError:
        raise ProblemError(Kind.IDEMPOTENCY_IN_PROGRESS, headers={"Retry-After": "1"}) from None
