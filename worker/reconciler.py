"""Makes the queue agree with the job table, again and again: the part that loses nothing.

Every step is an atomic update that names the state it expects, so any number of reconcilers may run at once,
one beside each worker: there is none to be lost, and none to be elected.
"""

from __future__ import annotations

import logging
import threading

from service.jobs.housekeeping import purge_deleted, sweep_records, sweep_uploads
from service.jobs.retention import enforce
from service.jobs.store import JobStore
from service.queue import JobQueue
from service.settings import Settings
from service.storage import Storage

log = logging.getLogger(__name__)


class Reconciler:
    """Takes back jobs of silent workers, sends missing messages, removes what was deleted or abandoned."""

    def __init__(self, settings: Settings, store: JobStore, storage: Storage, queue: JobQueue) -> None:
        self._settings, self._store, self._storage, self._queue = settings, store, storage, queue

    def run(self, stopping: threading.Event) -> None:
        """Reconcile now and every ``reconcile_seconds`` until ``stopping`` is set."""
        while True:
            self.tick()
            if stopping.wait(self._settings.reconcile_seconds):
                return

    def tick(self) -> None:
        """One round. A step that fails is logged and tried again next time, and holds up no other."""
        for step in (self._requeue, self._publish, self._purge, self._sweep, self._retain):
            try:
                step()
            except Exception:
                log.exception("reconciler: %s failed", step.__name__)

    def _requeue(self) -> None:
        for job_id in self._store.requeue_expired_leases():
            log.warning("job %s: its worker went silent; back in the queue", job_id)

    def _publish(self) -> None:
        for job_id in self._store.due_for_publish():
            # Marked first: of several reconcilers one sends. A crash in between costs one pause.
            job = self._store.get(job_id)
            if job is None or not self._store.mark_published(job_id, if_due=True):
                continue
            if not self._queue.publish(job_id, job.queue):
                self._store.mark_unpublished(job_id)
                return  # the broker is away: the others can wait for the next round

    def _purge(self) -> None:
        purge_deleted(self._store, self._storage)

    def _sweep(self) -> None:
        sweep_uploads(self._store, self._storage, self._settings.orphan_upload_seconds)
        sweep_records(self._store)

    def _retain(self) -> None:
        enforce(self._settings, self._store, self._storage)
