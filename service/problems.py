"""Errors as users see them: RFC 9457 problem details, each with a stable code and one sentence of advice."""

from __future__ import annotations

from collections import defaultdict
from typing import Any

import anyio
from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel, Field
from starlette.exceptions import HTTPException
from starlette.responses import JSONResponse
from starlette.types import Receive, Scope, Send

from service.problem_kinds import Kind as Kind

MEDIA_TYPE = "application/problem+json"


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
