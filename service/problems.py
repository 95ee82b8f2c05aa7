"""Errors as users see them: RFC 9457 problem details, each with a stable code and one sentence of advice."""

from __future__ import annotations

from collections import defaultdict
from enum import Enum
from typing import Any

import anyio
from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel, Field
from starlette.exceptions import HTTPException
from starlette.responses import JSONResponse
from starlette.types import Receive, Scope, Send

MEDIA_TYPE = "application/problem+json"


class Kind(Enum):
    """Every error the service answers with: code, status, title, advice. The codes are part of the API."""

    REQUEST_MALFORMED = (
        "request.malformed",
        400,
        "The request cannot be read",
        "Check how the body is encoded.",
    )
    REQUEST_HOST = (
        "request.host",
        403,
        "The Host header is not one this service answers to",
        "Use the service's own address, or have the name added to MASS_ALLOWED_HOSTS.",
    )
    REQUEST_ORIGIN = (
        "request.origin",
        403,
        "Another site's page sent this request",
        "Send changes from the service's own page or from a program.",
    )
    ACCESS_KEY = (
        "access.key",
        401,
        "This needs a key",
        "Send `Authorization: Bearer <key>`; `mass keys create` makes one.",
    )
    ACCESS_SCOPE = (
        "access.scope",
        403,
        "The key does not allow this",
        "Use a key with the scope that `detail` names.",
    )
    ACCESS_LINK = (
        "access.link",
        403,
        "The link has run out or was changed",
        "Ask for a new one with POST /jobs/{id}/links.",
    )
    QUOTA = (
        "quota.exceeded",
        429,
        "You have as much as you may have",
        "Wait the seconds in Retry-After, or delete finished jobs.",
    )
    NOT_FOUND = ("request.not_found", 404, "There is nothing at this path", "See /docs for the paths.")
    METHOD = (
        "request.method_not_allowed",
        405,
        "This path does not take that method",
        "See /docs for the methods of each path.",
    )
    REQUEST_MEDIA_TYPE = (
        "request.media_type",
        415,
        "The body is not a form",
        "Send multipart/form-data with the video in the field `video`.",
    )
    REQUEST_TOO_LARGE = (
        "request.too_large",
        413,
        "The body is too long",
        "Send less; only videos may be long, see POST /jobs and POST /uploads.",
    )
    REQUEST_INVALID = (
        "request.invalid",
        422,
        "A parameter is missing or wrong",
        "Correct the parameters listed under `errors`.",
    )
    HTTP = ("request.refused", 400, "The request was refused", "See /docs for what the service accepts.")
    INTERNAL = (
        "service.internal",
        500,
        "The service failed",
        "Try again; if it stays, report it with the time of the request.",
    )

    NOT_READY = (
        "service.not_ready",
        503,
        "The service cannot do all of its work",
        "See `errors` for the parts in trouble; jobs that were accepted are safe.",
    )

    UPLOAD_INCOMPLETE = (
        "upload.incomplete",
        400,
        "The upload ended early",
        "Send the whole file again; nothing of the broken upload was kept.",
    )
    UPLOAD_STALLED = (
        "upload.stalled",
        408,
        "The request stopped in the middle",
        "Send it again over a better connection.",
    )
    UPLOAD_TOO_LARGE = (
        "upload.too_large",
        413,
        "The upload is too large",
        "Send a shorter or smaller video; /capabilities names the limit.",
    )
    UPLOAD_NOT_FOUND = (
        "upload.not_found",
        404,
        "There is no such upload",
        "Begin a new one with POST /uploads; unfinished ones are kept until Upload-Expires.",
    )
    UPLOAD_VERSION = (
        "upload.version",
        412,
        "This version of tus is not spoken here",
        "Send the header `Tus-Resumable: 1.0.0`.",
    )
    UPLOAD_HEADERS = (
        "upload.headers",
        400,
        "A header of the upload is missing or wrong",
        "Correct the header that `detail` names; OPTIONS /uploads says what is offered.",
    )
    UPLOAD_MEDIA_TYPE = (
        "upload.media_type",
        415,
        "The body is not part of an upload",
        "Send it as application/offset+octet-stream.",
    )
    UPLOAD_OFFSET = (
        "upload.offset",
        409,
        "That is not where the upload stands",
        "Ask with HEAD for the Upload-Offset and go on from there.",
    )
    UPLOAD_LOCKED = (
        "upload.locked",
        423,
        "Another request is writing to this upload",
        "Try again after the seconds in Retry-After.",
    )
    UPLOAD_CHECKSUM = (
        "upload.checksum",
        460,
        "The bytes do not match their checksum",
        "Send this part again; nothing of it was kept.",
    )
    UPLOAD_USED = (
        "upload.used",
        409,
        "A job has been made of this upload already",
        "Use POST /jobs/{id}/restart to make another of the same video.",
    )
    STORAGE_FULL = (
        "storage.full",
        507,
        "The service has no room for this upload",
        "Delete finished jobs or try again later.",
    )
    VIDEO_MISSING = (
        "video.missing",
        422,
        "The form has no video",
        "Put the file into the form field `video`.",
    )
    VIDEO_EMPTY = ("video.empty", 422, "The video is empty", "Check the file: it has no bytes.")
    VIDEO_CONTAINER = (
        "video.unsupported_container",
        415,
        "This is not an MP4, MOV or WebM file",
        "Upload the video as the phone recorded it, or convert it to MP4.",
    )
    OPTIONS_INVALID = (
        "options.invalid",
        422,
        "The options are wrong",
        "Correct the options listed under `errors`.",
    )

    JOB_NOT_FOUND = (
        "job.not_found",
        404,
        "There is no such job",
        "Check the id; a deleted job is gone for good.",
    )
    JOB_NOT_READY = (
        "job.not_ready",
        409,
        "The job has not finished",
        "Wait until its state is `succeeded`.",
    )
    JOB_NO_RESULT = (
        "job.no_result",
        409,
        "The job ended without a result",
        "See the job's `error` for why, and submit another video.",
    )
    JOB_FINISHED = (
        "job.finished",
        409,
        "The job is over already",
        "There is nothing to cancel; DELETE removes it.",
    )
    JOB_UNFINISHED = (
        "job.unfinished",
        409,
        "The job is not over yet",
        "Cancel it first, or wait for its end.",
    )
    JOB_NO_VIDEO = (
        "job.no_video",
        409,
        "The job's video is no longer here",
        "Submit the video again.",
    )
    IDEMPOTENCY_IN_PROGRESS = (
        "idempotency.in_progress",
        409,
        "The same request is being answered now",
        "Wait for its answer, or send it again after the seconds in Retry-After.",
    )
    IDEMPOTENCY_MISMATCH = (
        "idempotency.mismatch",
        422,
        "This Idempotency-Key came with another request before",
        "Use a new key for each new request.",
    )
    PREVIEW_NONE = (
        "preview.none",
        404,
        "There is no preview yet",
        "The first one comes when the engine has begun to colour the hand.",
    )
    STREAMS = (
        "events.too_many",
        429,
        "You have too many event streams open",
        "Close one, or poll GET /jobs/{id} with If-None-Match.",
    )
    ASSET_NOT_FOUND = (
        "asset.not_found",
        404,
        "The job has no such asset",
        "The job's list of assets has the names.",
    )
    ASSET_RANGE = (
        "asset.range",
        416,
        "That range lies outside the file",
        "Ask for bytes within the size the asset list gives.",
    )

    WEBHOOK_NOT_FOUND = ("webhook.not_found", 404, "There is no such webhook", "GET /webhooks lists yours.")
    WEBHOOK_URL = (
        "webhook.url",
        422,
        "Nothing can be sent to this address",
        "Use an https address that everybody can reach.",
    )

    POSE_INVALID = (
        "pose.invalid",
        422,
        "The pose is not one",
        "Use a name such as `fist`, `frame:N`, or 48 comma-separated angles in radians.",
    )
    CAMERA_INVALID = (
        "camera.invalid",
        422,
        "The camera is not one",
        "Use `source`, or `orbit:YAW,PITCH` in degrees, with `,DISTANCE` in metres if you like.",
    )
    RENDER_TOO_LARGE = (
        "render.too_large",
        422,
        "The picture would be too large",
        "Ask for fewer pixels; /capabilities names the limit.",
    )
    RENDER_NO_HAND = (
        "render.no_hand",
        404,
        "The job has no such hand",
        "Leave `hand` out, or submit the video with the option `side` set to `both`.",
    )
    RENDER_REFUSED = ("render.refused", 422, "The engine refused the request", "Change the pose or camera.")
    RENDER_FAILED = (
        "render.failed",
        500,
        "The picture could not be made",
        "Try another pose or camera; if it stays, submit the video again.",
    )
    RENDER_BUSY = (
        "render.busy",
        503,
        "Too many pictures are being made",
        "Try again after the seconds in Retry-After.",
    )
    RENDER_TIMEOUT = (
        "render.timeout",
        503,
        "The picture took too long",
        "Ask for a smaller picture, or try again after the seconds in Retry-After.",
    )

    def __init__(self, code: str, status: int, title: str, advice: str) -> None:
        self.code = code
        self.status = status
        self.title = title
        self.advice = advice


class ProblemError(Exception):
    """An error to answer with. ``detail`` says what is wrong this time; code and advice can be narrowed."""

    def __init__(
        self,
        kind: Kind,
        detail: str = "",
        *,
        code: str | None = None,
        advice: str | None = None,
        errors: list[dict[str, str]] | None = None,
        headers: dict[str, str] | None = None,
    ) -> None:
        super().__init__(f"{kind.code}: {detail}")
        self.kind = kind
        self.detail = detail
        self.code = code or kind.code
        self.advice = advice or kind.advice
        self.errors = errors or []
        self.headers = headers
        #: The request's body is still arriving: answer, then hang up.
        self.unread = False


class FieldError(BaseModel):
    """One wrong parameter."""

    field: str
    message: str


class ProblemBody(BaseModel):
    """The body of every error (RFC 9457), plus a stable `code` and one sentence of `advice`."""

    type: str = Field(examples=["/problems/video.empty"])
    title: str
    status: int
    detail: str
    instance: str = Field(description="The path that was asked for.")
    code: str = Field(examples=["video.empty"])
    advice: str
    errors: list[FieldError] = Field(default_factory=list)


class ProblemResponse(JSONResponse):
    """A problem. When the request's body is still arriving it is answered at once and then hung up on.

    Closing while a client still sends would make its kernel drop our answer; so the answer goes out first,
    then the rest of the body is thrown away for a moment, then the connection ends.
    """

    media_type = MEDIA_TYPE
    linger_seconds = 2.0

    def __init__(self, request: Request, problem: ProblemError) -> None:
        body = ProblemBody(
            type=f"/problems/{problem.kind.code}",
            title=problem.kind.title,
            status=problem.kind.status,
            detail=problem.detail or f"{problem.kind.title}.",
            instance=request.url.path,
            code=problem.code,
            advice=problem.advice,
            errors=[FieldError(**error) for error in problem.errors],
        )
        headers = {"x-content-type-options": "nosniff", **(problem.headers or {})}
        if problem.unread:
            headers["connection"] = "close"
        super().__init__(body.model_dump(), problem.kind.status, headers)
        self._linger = problem.unread

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send, lingering when asked to."""
        if not self._linger:
            await super().__call__(scope, receive, send)
            return
        await send({"type": "http.response.start", "status": self.status_code, "headers": self.raw_headers})
        await send({"type": "http.response.body", "body": self.body, "more_body": True})
        with anyio.move_on_after(self.linger_seconds):
            while True:
                message = await receive()
                if message["type"] != "http.request" or not message.get("more_body"):
                    break
        await send({"type": "http.response.body", "body": b"", "more_body": False})


def declared(*kinds: Kind) -> dict[int | str, dict[str, Any]]:
    """The ``responses`` of a route that can answer with ``kinds``, for the OpenAPI document."""
    by_status: dict[int, list[Kind]] = defaultdict(list)
    for kind in kinds:
        by_status[kind.status].append(kind)
    schema = {"$ref": "#/components/schemas/ProblemBody"}
    return {
        status: {
            "description": "; ".join(f"`{kind.code}`: {kind.title}" for kind in group),
            "content": {
                MEDIA_TYPE: {"schema": schema, "examples": {kind.code: _example(kind) for kind in group}}
            },
        }
        for status, group in sorted(by_status.items())
    }


def _example(kind: Kind) -> dict[str, Any]:
    body = ProblemBody(
        type=f"/problems/{kind.code}",
        title=kind.title,
        status=kind.status,
        detail=f"{kind.title}.",
        instance="/the/path",
        code=kind.code,
        advice=kind.advice,
    )
    return {"summary": kind.title, "value": body.model_dump()}


def field_errors(errors: Any) -> list[dict[str, str]]:
    """Pydantic's errors without the values sent in: those may be large or private."""
    return [
        {"field": ".".join(str(part) for part in error["loc"]), "message": str(error["msg"])}
        for error in errors[:20]
    ]


def install(app: FastAPI) -> None:
    """Make every error of ``app`` a problem; bugs are left to the guard."""
    app.add_exception_handler(ProblemError, _on_problem)
    app.add_exception_handler(HTTPException, _on_http)
    app.add_exception_handler(RequestValidationError, _on_invalid)


async def _on_problem(request: Request, error: Exception) -> ProblemResponse:
    assert isinstance(error, ProblemError)
    return ProblemResponse(request, error)


async def _on_http(request: Request, error: Exception) -> ProblemResponse:
    assert isinstance(error, HTTPException)
    kinds = {
        400: Kind.REQUEST_MALFORMED,
        404: Kind.NOT_FOUND,
        405: Kind.METHOD,
        413: Kind.UPLOAD_TOO_LARGE,
        500: Kind.INTERNAL,
    }
    kind = kinds.get(error.status_code, Kind.HTTP)
    headers = dict(error.headers or {})
    detail = "" if error.status_code in kinds else str(error.detail)
    return ProblemResponse(request, ProblemError(kind, detail, headers=headers))


async def _on_invalid(request: Request, error: Exception) -> ProblemResponse:
    assert isinstance(error, RequestValidationError)
    return ProblemResponse(request, ProblemError(Kind.REQUEST_INVALID, errors=field_errors(error.errors())))
