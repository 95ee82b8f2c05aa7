"""From a request for a picture to its bytes: out of the cache, from whoever asked just before, or drawn."""

from __future__ import annotations

import asyncio
import time
from pathlib import Path

import anyio
import anyio.to_thread

from service.metrics import Metrics
from service.pictures import PictureCache, View
from service.problems import ProblemError
from service.rendering import RenderPool

_Key = tuple[str, str, View]


class Drawing:
    """Of one app, on its event loop."""

    def __init__(self, pool: RenderPool, pictures: PictureCache, metrics: Metrics, most: int) -> None:
        """``most``: requests that the pool works on or lets wait; one more is enough to be turned away."""
        self._pool, self._pictures, self._metrics = pool, pictures, metrics
        # Threads of their own: waiting for pictures may not keep other routes from theirs.
        self._threads = anyio.CapacityLimiter(most + 1)
        self._under_way: dict[_Key, asyncio.Task[bytes]] = {}

    async def picture(self, job_id: str, artifact: str, avatar: Path, view: View, owner: str) -> bytes:
        """The picture; the same one asked for many times at once is drawn once. Raises ProblemError."""
        kept = self._pictures.get(job_id, artifact, view)
        if kept is not None:
            self._metrics.renders.labels("cached").inc()
            return kept
        key = (job_id, artifact, view)
        task = self._under_way.get(key)
        if task is not None:
            self._metrics.renders.labels("shared").inc()
        else:
            task = asyncio.create_task(self._draw(key, avatar, owner))
            self._under_way[key] = task
            task.add_done_callback(lambda done: self._end(key, done))
        # A client that goes away takes nobody else's picture along.
        return await asyncio.shield(task)

    async def _draw(self, key: _Key, avatar: Path, owner: str) -> bytes:
        start = time.perf_counter()
        try:
            picture = await anyio.to_thread.run_sync(
                self._pool.render, avatar, key[2], owner, limiter=self._threads
            )
        except ProblemError as error:
            self._metrics.renders.labels(error.kind.code).inc()
            raise
        self._metrics.renders.labels("drawn").inc()
        self._metrics.render_seconds.observe(time.perf_counter() - start)
        self._pictures.put(*key, picture)
        return picture

    def _end(self, key: _Key, task: asyncio.Task[bytes]) -> None:
        del self._under_way[key]
        if not task.cancelled():
            task.exception()  # seen, also when everybody who asked has gone
