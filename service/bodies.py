"""A limit for every body that is not a video, applied before anything parses it."""

from __future__ import annotations

from starlette.datastructures import Headers
from starlette.requests import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.problems import Kind, ProblemError, ProblemResponse

MAX_BODY = 512 * 1024


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
            await self._refuse(scope, receive, send)
            return
        if declared != "0" or "transfer-encoding" in headers:
            while True:
                message = await receive()
                if message["type"] != "http.request":
                    return  # the client has gone
                body += message.get("body", b"")
                if len(body) > MAX_BODY:
                    await self._refuse(scope, receive, send)
                    return
                if not message.get("more_body"):
                    break
        whole: list[Message] = [{"type": "http.request", "body": body, "more_body": False}]

        async def replay() -> Message:
            return whole.pop() if whole else await receive()

        await self._app(scope, replay, send)

    async def _refuse(self, scope: Scope, receive: Receive, send: Send) -> None:
        problem = ProblemError(Kind.REQUEST_TOO_LARGE, f"A body may have {MAX_BODY} bytes here.")
        problem.unread = True
        await ProblemResponse(Request(scope), problem)(scope, receive, send)


def _is_video(scope: Scope) -> bool:
    method, path = scope["method"], scope["path"]
    return bool(
        (method == "POST" and path == "/jobs") or (method == "PATCH" and path.startswith("/uploads/"))
    )
