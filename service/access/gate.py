"""Who may: every request is admitted here, before a byte of its body is read, or not at all.

A route cannot forget to ask: what is not in :data:`PUBLIC` needs a key, ``write`` to change anything, and
``admin`` for what is in :data:`ADMIN_ONLY`. Whose thing a path names is checked where the thing is looked up.
"""

from __future__ import annotations

import ipaddress
from typing import Annotated, Literal, cast

from fastapi import Depends, Request
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import Headers
from starlette.types import ASGIApp, Receive, Send
from starlette.types import Scope as AsgiScope

from service.access.keys import ANYONE, Caller, KeyStore, Scope
from service.access.links import Signer, is_signed
from service.access.rates import RateLimiter, network
from service.problems import Kind, ProblemError, ProblemResponse

#: Paths (and what lies below those that end in a slash) that say nothing about anybody's jobs.
PUBLIC = ("/", "/web/", "/docs", "/openapi.json", "/healthz", "/readyz", "/capabilities", "/problems/")
ADMIN_ONLY = ("/metrics",)
_SAFE = {"GET", "HEAD", "OPTIONS"}

Auth = Literal["auto", "keys", "open"]


def asks_for_keys(auth: Auth, host: str) -> bool:
    """Whether a service listening on ``host`` asks for keys: by itself, everywhere but on loopback."""
    if auth != "auto":
        return auth == "keys"
    try:
        return not ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host != "localhost"


def is_public(path: str) -> bool:
    """Whether a path is answered without a key."""
    return any(
        path == known or (known.endswith("/") and known != "/" and path.startswith(known)) for known in PUBLIC
    )


class Gate:
    """ASGI middleware: puts the :class:`Caller` into the request's state.

    ``addresses`` and ``owners`` say how often one of them may ask.
    """

    def __init__(self, app: ASGIApp, *, keyed: bool, addresses: RateLimiter, owners: RateLimiter) -> None:
        self._app = app
        self._keyed = keyed
        self._addresses, self._owners = addresses, owners

    async def __call__(self, scope: AsgiScope, receive: Receive, send: Send) -> None:
        """Admit or refuse."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        try:
            # Before the key: whoever has none may not ask the database without end either.
            _count(self._addresses, network((scope.get("client") or ("",))[0]))
            caller = await self._caller(scope)
            _count(self._owners, caller.owner if caller.limited else None)
        except ProblemError as refusal:
            headers = Headers(scope=scope)
            refusal.unread = "content-length" in headers or "transfer-encoding" in headers
            await ProblemResponse(Request(scope), refusal)(scope, receive, send)
            return
        scope.setdefault("state", {})["caller"] = caller
        await self._app(scope, receive, send)

    async def _caller(self, scope: AsgiScope) -> Caller:
        path, safe = scope["path"], scope["method"] in _SAFE
        if not self._keyed or is_public(path):
            return ANYONE
        state = scope["app"].state
        query = scope["query_string"].decode("latin-1")
        if safe and is_signed(query):
            signer: Signer = state.signer
            if signer.check(path, query):
                # It opens this one path, whosever it is.
                return Caller("", frozenset({Scope.READ, Scope.ADMIN}))
            raise ProblemError(Kind.ACCESS_LINK)
        kind, _, key = Headers(scope=scope).get("authorization", "").partition(" ")
        keys: KeyStore = state.api_keys
        found = await run_in_threadpool(keys.check, key.strip()) if kind.lower() == "bearer" else None
        if found is None:
            raise ProblemError(Kind.ACCESS_KEY, headers={"WWW-Authenticate": 'Bearer realm="mass"'})
        needed = Scope.ADMIN if path in ADMIN_ONLY else Scope.READ if safe else Scope.WRITE
        if needed not in found.scopes:
            raise ProblemError(Kind.ACCESS_SCOPE, f"The key lacks the scope `{needed}`.")
        return found


def _count(limiter: RateLimiter, who: str | None) -> None:
    """Raise ProblemError (429) when that was one too many."""
    wait = limiter.take(who) if who else 0
    if wait:
        raise ProblemError(Kind.RATE, headers={"Retry-After": str(wait)})


async def _caller(request: Request) -> Caller:  # async: a plain function would be sent to a worker thread
    return cast(Caller, request.state.caller)


CallerDep = Annotated[Caller, Depends(_caller)]
