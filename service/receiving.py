"""The body of a request, handed on while it arrives to something that blocks."""

from __future__ import annotations

import errno
from collections.abc import Callable
from functools import partial
from typing import TypeVar

import anyio
from fastapi import Request
from fastapi.concurrency import run_in_threadpool
from starlette.requests import ClientDisconnect

from service.problems import Kind, ProblemError

#: Seconds of silence before a sender is given up.
STALL_SECONDS = 60.0

T = TypeVar("T")


async def receive(request: Request, feed: Callable[[bytes], None], finish: Callable[[], T]) -> T:
    """Give the body to ``feed`` piece by piece, then return ``finish()``; both run in worker threads.

    Raises ProblemError: theirs, a full disk, a client that left (``upload.incomplete``) or fell silent
    (``upload.stalled``).
    """
    stream = request.stream()
    chunk: bytes | None = b""
    try:
        while True:
            with anyio.fail_after(STALL_SECONDS):
                chunk = await anext(stream, None)
            if chunk is None:
                break
            if chunk:
                await run_in_threadpool(guarded, partial(feed, chunk))
        return await run_in_threadpool(guarded, finish)
    except ProblemError as refusal:
        refusal.unread = chunk is not None
        raise
    except ClientDisconnect as error:
        raise ProblemError(Kind.UPLOAD_INCOMPLETE) from error
    except TimeoutError as error:
        stalled = ProblemError(Kind.UPLOAD_STALLED)
        stalled.unread = True
        raise stalled from error


def guarded(step: Callable[[], T]) -> T:
    """Run ``step``; a full disk is a problem to answer with."""
    try:
        return step()
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise ProblemError(Kind.STORAGE_FULL, headers={"Retry-After": "60"}) from error
        raise
