"""Uploads that survive a bad network: tus 1.0 (https://tus.io/protocols/resumable-upload), with creation,
termination, expiration and checksum."""

from __future__ import annotations

import base64
import binascii
import re
from email.utils import formatdate
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Header, Path, Request, Response
from fastapi.concurrency import run_in_threadpool

from service.access.gate import CallerDep
from service.access.keys import Caller
from service.access.quotas import QuotaError
from service.jobs.model import is_job_id
from service.problems import Kind, ProblemError, declared
from service.services import Services, ServicesDep
from service.submission import announce, over_quota
from service.tus import lifecycle
from service.tus.receive import ALGORITHMS, Appender, append, parse_checksum
from service.tus.rows import Lock, TooManyUploadsError, Upload

VERSION = "1.0.0"
EXTENSIONS = "creation,termination,expiration,checksum"
_MEDIA_TYPE = "application/offset+octet-stream"
_METADATA_KEY = re.compile(r"[\x21-\x2b\x2d-\x7e]{1,64}")
_MAX_NUMBER = 2**53


def _version(
    tus_resumable: Annotated[str | None, Header(description="`1.0.0`", examples=[VERSION])] = None,
) -> None:
    if tus_resumable != VERSION:
        raise ProblemError(Kind.UPLOAD_VERSION, headers={"Tus-Version": VERSION})


router = APIRouter(prefix="/uploads", tags=["uploads"])
_tus = Depends(_version)

UploadId = Annotated[str, Path(description="The last part of `Location`.", max_length=64)]


def _headers(**named: str) -> dict[str, Any]:
    return {
        name.replace("_", "-"): {"schema": {"type": "string"}, "description": text}
        for name, text in named.items()
    }


_OFFSET = _headers(Upload_Offset="Bytes received.", Upload_Expires="When it is given up, as an HTTP date.")


@router.options("", status_code=204)
def get_upload_options(services: ServicesDep, response: Response) -> None:
    """What of tus is offered."""
    response.headers["Tus-Version"] = VERSION
    response.headers["Tus-Extension"] = EXTENSIONS
    response.headers["Tus-Max-Size"] = str(services.settings.max_upload_bytes)
    response.headers["Tus-Checksum-Algorithm"] = ",".join(ALGORITHMS)


@router.post(
    "",
    status_code=201,
    dependencies=[_tus],
    responses={
        201: {"description": "Created.", "headers": {**_headers(Location="Where to send it."), **_OFFSET}},
        **declared(
            Kind.UPLOAD_VERSION, Kind.UPLOAD_HEADERS, Kind.UPLOAD_TOO_LARGE, Kind.VIDEO_EMPTY,
            Kind.QUOTA, Kind.STORAGE_FULL, Kind.REQUEST_INVALID,
        ),
    },
)  # fmt: skip
def create_upload(
    services: ServicesDep,
    caller: CallerDep,
    response: Response,
    upload_length: Annotated[
        str | None, Header(description="Bytes of the whole video.", examples=["7340032"])
    ] = None,
    upload_metadata: Annotated[
        str | None, Header(max_length=4096, description="As in tus; checked, not kept.")
    ] = None,
) -> None:
    """Begin an upload; `PATCH` its `Location` next. A job may be made of it at once, see `POST /jobs`."""
    length = _number(upload_length, "Upload-Length")
    _check_metadata(upload_metadata)
    if length > services.settings.max_upload_bytes:
        raise ProblemError(
            Kind.UPLOAD_TOO_LARGE,
            f"A video may have {services.settings.max_upload_bytes} bytes.",
            headers={"Tus-Max-Size": str(services.settings.max_upload_bytes)},
        )
    if length == 0:
        raise ProblemError(Kind.VIDEO_EMPTY)
    if not services.storage.has_room(length):
        raise ProblemError(Kind.STORAGE_FULL, headers={"Retry-After": "60"})
    try:
        upload = services.uploads.create(caller.owner, length, services.quota(caller))
    except QuotaError as error:
        raise over_quota(error) from error
    except TooManyUploadsError:
        detail = f"{services.settings.max_open_uploads} unfinished uploads are allowed."
        raise ProblemError(Kind.QUOTA, detail, headers={"Retry-After": "60"}) from None
    try:
        services.storage.begin_upload(upload.id).touch()
    except OSError as error:
        services.uploads.remove(upload.id)
        services.storage.discard_upload(upload.id)
        raise ProblemError(Kind.STORAGE_FULL, headers={"Retry-After": "60"}) from error
    response.headers["Location"] = f"/uploads/{upload.id}"
    _say(response, upload)


@router.head(
    "/{upload_id}",
    dependencies=[_tus],
    response_class=Response,
    responses={
        200: {
            "description": "How far it is.",
            "headers": {**_OFFSET, **_headers(Upload_Length="Bytes in all.")},
        },
        **declared(Kind.UPLOAD_VERSION, Kind.UPLOAD_NOT_FOUND),
    },
)
def get_upload_offset(upload_id: UploadId, services: ServicesDep, caller: CallerDep) -> Response:
    """Where to go on."""
    upload = _upload(services, upload_id, caller)
    response = Response(headers={"Upload-Length": str(upload.length), "Cache-Control": "no-store"})
    _say(response, upload)
    return response


@router.patch(
    "/{upload_id}",
    status_code=204,
    dependencies=[_tus],
    openapi_extra={
        "requestBody": {
            "required": True,
            "content": {_MEDIA_TYPE: {"schema": {"type": "string", "contentMediaType": _MEDIA_TYPE}}},
        }
    },
    responses={
        204: {"description": "Kept.", "headers": _OFFSET},
        **declared(
            Kind.UPLOAD_VERSION, Kind.UPLOAD_HEADERS, Kind.UPLOAD_NOT_FOUND, Kind.UPLOAD_MEDIA_TYPE,
            Kind.UPLOAD_OFFSET, Kind.UPLOAD_LOCKED, Kind.UPLOAD_TOO_LARGE, Kind.UPLOAD_CHECKSUM,
            Kind.UPLOAD_INCOMPLETE, Kind.UPLOAD_STALLED, Kind.VIDEO_CONTAINER, Kind.STORAGE_FULL,
        ),
    },
)  # fmt: skip
async def append_to_upload(
    upload_id: UploadId,
    request: Request,
    response: Response,
    services: ServicesDep,
    caller: CallerDep,
    upload_offset: Annotated[str | None, Header(description="Bytes sent before.", examples=["0"])] = None,
    upload_checksum: Annotated[str | None, Header(description="`sha1` or `sha256`, a space, base64.")] = None,
) -> None:
    """Send the next bytes. A part with a checksum counts whole or not; of one without, what arrived."""
    try:
        lock, checksum = await run_in_threadpool(
            _begin, services, upload_id, caller, request, upload_offset, upload_checksum
        )
    except ProblemError as refusal:
        refusal.unread = True
        raise
    try:
        offset = await _write(services, lock, request, checksum)
        if offset == lock.length and await run_in_threadpool(
            lifecycle.complete, services.uploads, services.store, services.storage, lock
        ):
            await run_in_threadpool(announce, services, upload_id)
    except ProblemError as refusal:
        if refusal.kind is Kind.VIDEO_CONTAINER:
            _refuse(services, upload_id, refusal)
        raise
    finally:
        services.uploads.unlock(lock)
    response.headers["Upload-Offset"] = str(offset)
    upload = services.uploads.get(upload_id)
    if upload is not None:
        _say(response, upload)


@router.delete(
    "/{upload_id}",
    status_code=204,
    dependencies=[_tus],
    responses=declared(Kind.UPLOAD_VERSION, Kind.UPLOAD_NOT_FOUND),
)
def end_upload(upload_id: UploadId, services: ServicesDep, caller: CallerDep) -> None:
    """Give the upload up. A job that waits for it is cancelled."""
    _upload(services, upload_id, caller)
    lifecycle.end(services.uploads, services.store, services.storage, upload_id)


def _upload(services: Services, upload_id: str, caller: Caller) -> Upload:
    found = services.uploads.get(upload_id, caller.sees) if is_job_id(upload_id) else None
    if found is None:
        raise ProblemError(Kind.UPLOAD_NOT_FOUND)
    return found


def _begin(
    services: Services,
    upload_id: str,
    caller: Caller,
    request: Request,
    offset: str | None,
    checksum: str | None,
) -> tuple[Lock, tuple[str, bytes] | None]:
    upload = _upload(services, upload_id, caller)
    if request.headers.get("content-type", "").partition(";")[0].strip().lower() != _MEDIA_TYPE:
        raise ProblemError(Kind.UPLOAD_MEDIA_TYPE)
    expected = parse_checksum(checksum)
    start = _number(offset, "Upload-Offset")
    here = {"Upload-Offset": str(upload.offset)}
    if start != upload.offset or upload.complete:
        raise ProblemError(Kind.UPLOAD_OFFSET, f"The next byte is number {upload.offset}.", headers=here)
    declared_bytes = request.headers.get("content-length", "")
    if declared_bytes.isdecimal() and start + int(declared_bytes) > upload.length:
        raise ProblemError(Kind.UPLOAD_TOO_LARGE, "The body goes past the Upload-Length.")
    lock = services.uploads.lock(upload_id)
    if lock is None:
        raise ProblemError(Kind.UPLOAD_LOCKED, headers={"Retry-After": "2"})
    if lock.offset != start:
        services.uploads.unlock(lock)
        raise ProblemError(Kind.UPLOAD_OFFSET, f"The next byte is number {lock.offset}.")
    return lock, expected


async def _write(services: Services, lock: Lock, request: Request, checksum: tuple[str, bytes] | None) -> int:
    try:
        appender = await run_in_threadpool(Appender, services.uploads, services.storage, lock, checksum)
    except FileNotFoundError as error:
        raise ProblemError(Kind.UPLOAD_NOT_FOUND) from error
    try:
        return await append(request, appender)
    except BaseException:
        appender.roll_back()
        raise
    finally:
        appender.close()


def _refuse(services: Services, upload_id: str, refusal: ProblemError) -> None:
    """What was sent is no video: nothing more of it is wanted."""
    services.store.upload_refused(upload_id, refusal.code, f"{refusal.kind.title}.", refusal.advice)
    services.uploads.remove(upload_id)
    services.storage.discard_upload(upload_id)


def _say(response: Response, upload: Upload) -> None:
    response.headers["Upload-Offset"] = str(upload.offset)
    response.headers["Upload-Expires"] = formatdate(upload.expires_at, usegmt=True)


def _number(text: str | None, name: str) -> int:
    if text is None or not text.isascii() or not text.isdecimal() or int(text[:17]) > _MAX_NUMBER:
        raise ProblemError(Kind.UPLOAD_HEADERS, f"{name} is a number of bytes.")
    return int(text[:17])


def _check_metadata(header: str | None) -> None:
    for pair in (header or "").split(",") if header else ():
        key, _, value = pair.strip().partition(" ")
        try:
            base64.b64decode(value, validate=True)
        except (binascii.Error, ValueError):
            key = ""
        if _METADATA_KEY.fullmatch(key) is None:
            raise ProblemError(Kind.UPLOAD_HEADERS, "Upload-Metadata is a list of keys and base64 values.")
