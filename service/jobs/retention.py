"""What is kept for how long after a job has ended, each kind for itself, on every machine that holds some."""

from __future__ import annotations

import logging

from sqlalchemy import select
from sqlalchemy.orm import Session

from service.jobs.model import FINAL_STATES, Job, JobState
from service.jobs.store import JobStore
from service.settings import Settings
from service.storage import Storage

log = logging.getLogger(__name__)

#: A directory without a row may belong to a job that is just being made.
_GRACE = 600.0


def enforce(settings: Settings, store: JobStore, storage: Storage) -> None:
    """Remove videos, checkpoints and jobs past their time, and files of jobs that are gone."""
    if settings.keep_job_seconds:
        for job in _ended(store, settings.keep_job_seconds, Job.deleted_at.is_(None)):
            store.delete(job.id)
    if settings.keep_video_seconds:
        for job in _ended(store, settings.keep_video_seconds, Job.video_dropped_at.is_(None)):
            storage.drop_video(job.id)
            store.mark_dropped(job.id, video=True)
    if settings.keep_checkpoint_seconds:
        unfinished = (Job.state != JobState.SUCCEEDED, Job.checkpoint_dropped_at.is_(None))
        for job in _ended(store, settings.keep_checkpoint_seconds, *unfinished):
            storage.drop_local(job.id)
            storage.drop_checkpoint(job.id)
            store.mark_dropped(job.id, video=False)
    _drop_unknown(store, storage)


def _drop_unknown(store: JobStore, storage: Storage) -> None:
    """Copies on this machine of jobs that another machine deleted, or a stopped engine's late output."""
    here = {*storage.local_jobs(_GRACE)}
    for job_id in sorted(here - store.known(here)) if here else ():
        log.info("job %s: gone; its files here are removed", job_id)
        storage.drop_local(job_id)


def _ended(store: JobStore, seconds: float, *where: object, limit: int = 100) -> list[Job]:
    before = store.now() - seconds
    query = select(Job).where(Job.state.in_(FINAL_STATES), Job.finished_at < before, *where)  # type: ignore[arg-type]
    with Session(store.engine, expire_on_commit=False) as session:
        return [*session.scalars(query.order_by(Job.finished_at).limit(limit))]
