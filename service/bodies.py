"""A limit for every body that is not a video, applied before anything parses it."""

from __future__ import annotations

import anyio
from starlette.datastructures import Headers
from starlette.requests import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.problems import Kind, ProblemError, ProblemResponse

MAX_BODY = 512 * 1024
#: Such a body is here in this time, or its sender is playing for time.
SECONDS = 30.0


class BodyLimit:
    """ASGI middleware. Videos have limits of their own where they are received."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Refuse a long body, or hand a short one on in one piece."""
        if scope["type"] != "http" or _is_video(scope):
            await self._app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        declared = headers.get("content-length", "0")
        body = b""
        if not declared.isdecimal() or int(declared[:12]) > MAX_BODY:
            await _answer(_too_long(), scope, receive, send)
            return
        if declared != "0" or "transfer-encoding" in headers:
            received = await self._read(receive)
            if received is None:
                return
            if isinstance(received, ProblemError):
                await _answer(received, scope, receive, send)
                return
            body = received
        whole: list[Message] = [{"type": "http.request", "body": body, "more_body": False}]

        async def replay() -> Message:
            return whole.pop() if whole else await receive()

        await self._app(scope, replay, send)

    async def _read(self, receive: Receive) -> bytes | ProblemError | None:
        """The whole body; what is wrong with it; or None when the client has gone."""
        body: bytes = b""
        with anyio.move_on_after(SECONDS):
            while True:
                message = await receive()
                if message["type"] != "http.request":
                    return None
                body += message.get("body", b"")
                if len(body) > MAX_BODY:
                    return _too_long()
                if not message.get("more_body"):
                    return body
        return ProblemError(Kind.UPLOAD_STALLED)


def _too_long() -> ProblemError:
    return ProblemError(Kind.REQUEST_TOO_LARGE, f"A body may have {MAX_BODY} bytes here.")


async def _answer(problem: ProblemError, scope: Scope, receive: Receive, send: Send) -> None:
    problem.unread = True
    await ProblemResponse(Request(scope), problem)(scope, receive, send)


def _is_video(scope: Scope) -> bool:
    method, path = scope["method"], scope["path"]
    return bool(
        (method == "POST" and path == "/jobs") or (method == "PATCH" and path.startswith("/uploads/"))
    )
