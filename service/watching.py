"""Event streams: a job's journal, replayed from where a watcher left off and followed to the job's end."""

from __future__ import annotations

import json
import threading
from collections import Counter
from collections.abc import AsyncIterator, Iterator
from contextlib import contextmanager

import anyio
from fastapi.concurrency import run_in_threadpool
from fastapi.sse import KEEPALIVE_COMMENT, format_sse_event

from service.jobs.journal import Entry
from service.jobs.model import FINAL_STATES, JobState
from service.jobs.store import JobStore

#: How often the journal is looked at, how often a silent stream says that it lives, and how long one lasts;
#: its watcher then comes back with the number of the last event. Seconds.
LOOK_SECONDS = 0.5
PING_SECONDS = 15.0
LONGEST_SECONDS = 3600.0
_BATCH = 500


class StreamSlots:
    """How many streams each owner has open in this process."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._open: Counter[str] = Counter()
        self._lock = threading.Lock()

    def room(self, owner: str) -> bool:
        """Whether the owner may open one more."""
        with self._lock:
            return self._open[owner] < self._most

    @contextmanager
    def held(self, owner: str) -> Iterator[None]:
        """Count one while it is open."""
        with self._lock:
            self._open[owner] += 1
        try:
            yield
        finally:
            with self._lock:
                self._open[owner] -= 1


async def follow(store: JobStore, job_id: str, after: int) -> AsyncIterator[bytes]:
    """The events numbered above ``after`` as server-sent events, until the job is over or deleted."""
    silent = lasted = 0.0
    yield format_sse_event(retry=2000)
    while lasted < LONGEST_SECONDS:
        entries = await run_in_threadpool(store.events, job_id, after, _BATCH)
        for entry in entries:
            yield encode(entry)
            after = entry.seq
            if is_last(entry):
                return
        if not entries and await run_in_threadpool(store.get, job_id) is None:
            return
        silent = 0.0 if entries else silent + LOOK_SECONDS
        if silent >= PING_SECONDS:
            silent = 0.0
            yield KEEPALIVE_COMMENT
        if len(entries) < _BATCH:
            await anyio.sleep(LOOK_SECONDS)
            lasted += LOOK_SECONDS


def encode(entry: Entry) -> bytes:
    """One event on the wire; its id is its number in the job's journal."""
    return format_sse_event(
        data_str=json.dumps({"seq": entry.seq, "at": entry.at, **entry.data}),
        event=entry.kind,
        id=str(entry.seq),
    )


def is_last(entry: Entry) -> bool:
    """Whether nothing can follow."""
    return JobState(entry.data["state"]) in FINAL_STATES
