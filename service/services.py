"""What the routes work with, made once per app and closed with it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Annotated, cast

from fastapi import Depends, Request

from service.access.keys import Caller
from service.access.links import Signer, service_secret
from service.access.quotas import Quota
from service.drawing import Drawing
from service.jobs.idempotency import IdempotencyKeys
from service.jobs.model import FINAL_STATES, Job, JobKind, JobState, is_job_id
from service.jobs.store import JobStore, create_store
from service.metrics import Metrics
from service.pictures import PictureCache
from service.problems import Kind, ProblemError
from service.queue import JobQueue, create_queue
from service.rendering import Loader, RenderPool, create_pool
from service.settings import Settings
from service.storage import Storage, create_storage
from service.tus.rows import UploadStore, create_uploads
from service.watching import StreamSlots
from service.webhooks.outbox import Outbox


@dataclass(frozen=True)
class Services:
    """Everything behind the routes."""

    settings: Settings
    store: JobStore
    keys: IdempotencyKeys
    uploads: UploadStore
    storage: Storage
    queue: JobQueue
    pool: RenderPool
    pictures: PictureCache
    drawing: Drawing
    signer: Signer
    streams: StreamSlots
    outbox: Outbox
    metrics: Metrics

    def job(self, job_id: str, caller: Caller) -> Job:
        """The job, if the caller may see it. Raises ProblemError (404): others' jobs do not exist."""
        job = self.store.get(job_id, caller.sees) if is_job_id(job_id) else None
        if job is None:
            raise ProblemError(Kind.JOB_NOT_FOUND)
        return job

    def artifact(self, job_id: str, caller: Caller) -> str:
        """The name of the job's result directory. Raises ProblemError (404, 409)."""
        return _artifact(self.job(job_id, caller))

    def avatar(self, job_id: str, caller: Caller) -> str:
        """:meth:`artifact` of a job that made an avatar. Raises ProblemError (404, 409)."""
        job = self.job(job_id, caller)
        if job.kind != JobKind.FIT:
            raise ProblemError(Kind.JOB_NO_RESULT, "It made a motion, not a hand; see its assets.")
        return _artifact(job)

    def quota(self, caller: Caller) -> Quota:
        """What the caller may have."""
        chosen = self.settings
        return (
            Quota(chosen.quota_jobs, chosen.quota_bytes, chosen.quota_minutes) if caller.limited else Quota()
        )


def _artifact(job: Job) -> str:
    if job.state == JobState.SUCCEEDED and job.artifact is not None:
        return job.artifact
    if job.state in FINAL_STATES:
        raise ProblemError(Kind.JOB_NO_RESULT, f"The job is {job.state}.")
    raise ProblemError(Kind.JOB_NOT_READY, f"The job is {job.state}.", headers={"Retry-After": "5"})


@contextmanager
def open_services(settings: Settings, loader: Loader) -> Iterator[Services]:
    """Open all of it; close all of it, also when opening fails half way."""
    with ExitStack() as stack:
        store = create_store(settings)
        stack.callback(store.close)
        storage = create_storage(settings)
        queue = create_queue(settings)
        stack.callback(queue.close)
        pool = create_pool(settings, loader)
        stack.callback(pool.close)
        pool.start()
        pictures, metrics = PictureCache(settings.render_cache_bytes), Metrics(store)
        signer = Signer(service_secret(settings.secret.get_secret_value(), settings.data_dir))
        yield Services(
            settings=settings,
            store=store,
            keys=IdempotencyKeys(store.engine),
            uploads=create_uploads(settings, store.engine),
            storage=storage,
            queue=queue,
            pool=pool,
            pictures=pictures,
            drawing=Drawing(pool, pictures, metrics, settings.render_workers + settings.render_queue),
            signer=signer,
            streams=StreamSlots(settings.max_streams),
            outbox=Outbox(store.engine),
            metrics=metrics,
        )


async def _services(request: Request) -> Services:
    return cast(Services, request.app.state.services)


ServicesDep = Annotated[Services, Depends(_services)]


def not_modified(request: Request, etag: str) -> bool:
    """Whether the client holds this version already (If-None-Match, compared weakly)."""
    header = request.headers.get("if-none-match", "")
    held = {part.strip().removeprefix("W/") for part in header.split(",")}
    return header.strip() == "*" or etag.removeprefix("W/") in held
