"""What every request and response passes: Host and Origin checks, protective headers, the last resort."""

from __future__ import annotations

import ipaddress
import logging
from urllib.parse import urlsplit

from sqlalchemy.exc import OperationalError
from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.problems import Kind, ProblemError, ProblemResponse

log = logging.getLogger(__name__)

_SAFE = {"GET", "HEAD", "OPTIONS"}
_PAGE_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
#: On every answer that does not say otherwise.
_HEADERS = {
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
    "referrer-policy": "no-referrer",
    "content-security-policy": _PAGE_POLICY,
    "cross-origin-resource-policy": "same-origin",
    "cross-origin-opener-policy": "same-origin",
    "permissions-policy": "camera=(), microphone=(), geolocation=()",
    # What a job is, and whose, is nobody's to keep on the way.
    "cache-control": "no-store",
}


def _problem_of(error: Exception) -> ProblemError:
    """What went wrong, for its user: a bug, or a database that cannot be written or reached."""
    if not isinstance(error, OperationalError):
        return ProblemError(Kind.INTERNAL)
    if "disk is full" in str(error.orig):
        return ProblemError(Kind.STORAGE_FULL, headers={"Retry-After": "60"})
    trouble = {"field": "database", "message": "It does not answer now."}
    return ProblemError(Kind.NOT_READY, errors=[trouble], headers={"Retry-After": "5"})


class Guard:
    """ASGI middleware. ``hosts`` are the names answered to besides IP addresses and ``localhost``.

    A page of another site can make a browser talk to a service on the user's own machine: under a name that
    it rebinds (hence the Host check; rebinding needs a name, so addresses are safe), or by a plain form post
    (hence the Origin check).
    """

    def __init__(self, app: ASGIApp, hosts: frozenset[str]) -> None:
        self._app = app
        self._hosts = hosts | {"localhost"}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Check, then pass on."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        started = False

        async def protected(message: Message) -> None:
            nonlocal started
            if message["type"] == "http.response.start":
                started = True
                out = MutableHeaders(scope=message)
                if scope["path"].startswith("/uploads"):
                    out["tus-resumable"] = "1.0.0"
                for name, value in _HEADERS.items():
                    out.setdefault(name, value)
            await send(message)

        kind = self._refusal(scope["method"], headers)
        if kind is None:
            try:
                await self._app(scope, receive, protected)
                return
            except Exception as error:
                # Left to the framework, this would reach the server, which then drops the connection.
                if started:
                    raise
                log.error("%s %s failed", scope["method"], scope["path"], exc_info=error)
                problem = _problem_of(error)
        else:
            problem = ProblemError(kind)
            problem.unread = "content-length" in headers or "transfer-encoding" in headers
        await ProblemResponse(Request(scope), problem)(scope, receive, protected)

    def _refusal(self, method: str, headers: Headers) -> Kind | None:
        host = headers.get("host", "")
        if "*" not in self._hosts and not self._known(host):
            return Kind.REQUEST_HOST
        origin = headers.get("origin")
        if method not in _SAFE and origin is not None and urlsplit(origin).netloc != host:
            return Kind.REQUEST_ORIGIN
        return None

    def _known(self, host: str) -> bool:
        try:
            name = urlsplit(f"//{host}").hostname or ""
        except ValueError:
            return False
        if name in self._hosts:
            return True
        try:
            ipaddress.ip_address(name)
        except ValueError:
            return False
        return True
