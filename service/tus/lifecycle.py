"""Where uploads and jobs meet: an upload is completed, consumed, ended or forgotten."""

from __future__ import annotations

from service.jobs.model import JobState
from service.jobs.store import JobStore
from service.storage import Storage
from service.tus.rows import Lock, UploadStore


def complete(uploads: UploadStore, store: JobStore, storage: Storage, lock: Lock) -> bool:
    """All bytes are there: make the file final, and queue the job that waits for it. Whether one did."""
    storage.finish_upload(lock.upload_id)
    uploads.finish(lock)
    return hand_over(uploads, store, lock.upload_id, lock.length)


def hand_over(uploads: UploadStore, store: JobStore, upload_id: str, length: int) -> bool:
    """Queue the job waiting for this complete upload, if there is one; the files are the job's from then on.

    Called by whoever comes last, the upload or the job, and by the sweep should both have missed each other.
    """
    if not store.upload_arrived(upload_id, length):
        return False
    uploads.remove(upload_id)
    return True


def end(uploads: UploadStore, store: JobStore, storage: Storage, upload_id: str) -> None:
    """Remove an upload that its owner has given up, with its bytes and the job that waits for it."""
    store.request_cancel(upload_id)
    if uploads.remove(upload_id):
        storage.discard_upload(upload_id)


def sweep(uploads: UploadStore, store: JobStore, storage: Storage) -> list[str]:
    """Remove the uploads that have expired, end the jobs that waited for them; returns the uploads."""
    for upload in uploads.finished():
        job = store.get(upload.id)
        if job is not None and job.state is JobState.AWAITING_UPLOAD:
            hand_over(uploads, store, upload.id, upload.length)
        elif job is not None:
            uploads.remove(upload.id)  # a crash came between the job and this
    gone = uploads.overdue()
    for upload_id in gone:
        store.expire_upload(upload_id)
        if uploads.remove(upload_id):
            storage.discard_upload(upload_id)
    return gone
