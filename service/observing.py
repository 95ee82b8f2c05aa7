"""What each request leaves behind: a log line, a count. Queries are not logged: links carry signatures."""

from __future__ import annotations

import logging
import re
import time

from starlette.datastructures import Headers
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.logs import about, trace_of

log = logging.getLogger(__name__)

_JOB_PATH = re.compile(r"/jobs/([0-9a-f-]{36})(?:/|$)")
#: Asked for every few seconds by machines.
_QUIET = {"/healthz", "/readyz", "/metrics"}


class Observer:
    """ASGI middleware; the outermost, so that refusals count as well."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass on, then say what came of it."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        status, start = 0, time.perf_counter()

        async def noted(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
            await send(message)

        job = _JOB_PATH.match(scope["path"])
        trace = trace_of(Headers(scope=scope).get("traceparent"))
        with about(job=job[1] if job else None, trace=trace):
            try:
                await self._app(scope, receive, noted)
            finally:
                self._note(scope, status, 1000 * (time.perf_counter() - start))

    def _note(self, scope: Scope, status: int, milliseconds: float) -> None:
        route = getattr(scope.get("route"), "path", "other")
        services = getattr(scope["app"].state, "services", None)
        if services is not None:
            services.metrics.requests.labels(scope["method"], route, str(status)).inc()
        if scope["path"] not in _QUIET:
            path = re.sub(r"[^\x21-\x7e]", "?", scope["path"])[:200]
            fields = {
                "method": scope["method"],
                "path": path,
                "status": status,
                "milliseconds": round(milliseconds, 1),
            }
            log.info("%s %s %d %.0f ms", scope["method"], path, status, milliseconds, extra=fields)
