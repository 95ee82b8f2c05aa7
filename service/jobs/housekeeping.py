"""Removing what nobody needs any more: deleted jobs, and uploads that never became a job."""

from __future__ import annotations

import logging

from service.database import scrub
from service.jobs.idempotency import IdempotencyKeys
from service.jobs.store import JobStore
from service.storage import Storage
from service.tus import lifecycle
from service.tus.rows import UploadStore
from service.webhooks.outbox import Outbox

log = logging.getLogger(__name__)


def purge_deleted(store: JobStore, storage: Storage) -> list[str]:
    """Remove the files, then the row, of every deleted job no worker holds; returns their ids.

    The row goes last: a crash in between leaves a row that the next call finishes with.
    """
    purged = []
    for job_id in store.due_for_purge():
        try:
            storage.delete_job(job_id)
        except OSError as error:
            log.warning("job %s: its files could not be removed yet: %s", job_id, error)
            continue
        if store.purge(job_id):
            purged.append(job_id)
    if purged:
        scrub(store.engine)
    return purged


def sweep_records(store: JobStore) -> None:
    """Forget idempotency keys that have expired and webhook messages that were finished long ago."""
    IdempotencyKeys(store.engine).sweep()
    Outbox(store.engine).sweep()


def sweep_uploads(store: JobStore, storage: Storage, older_than: float) -> list[str]:
    """Remove uploads without a job that nobody wrote to for ``older_than`` seconds; returns their ids."""
    # Resumable uploads have rows and a time of their own, which these rows say.
    uploads = UploadStore(store.engine, older_than)
    expired = lifecycle.sweep(uploads, store, storage)
    idle = {*storage.idle_uploads(older_than)}
    orphans = sorted(idle - store.known(idle) - uploads.known(idle))
    for job_id in orphans:
        storage.discard_upload(job_id)
    return sorted({*orphans, *expired})
