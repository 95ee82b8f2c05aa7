"""The worker process: Celery around the supervisor, the reconciler beside it.

The pool is one thread. The task only watches a child process, so it needs no process of its own; the main
thread stays in the event loop and keeps answering the broker during a job of an hour; and a signal to this
process reaches the supervisor as an event, which ends the engine and gives the job back at once. (A solo pool
would block the loop; a prefork pool adds a process that can be lost without the engine noticing.)
"""

from __future__ import annotations

import logging
import threading
from pathlib import Path
from typing import Any

from celery import Celery, bootsteps, signals
from kombu.entity import Queue

from service.jobs.store import create_store
from service.pulse import PULSE_SECONDS, pulse_path, sweep_pulses
from service.queue import create_celery, create_queue
from service.settings import Settings
from service.storage import create_storage
from worker.reconciler import Reconciler
from worker.supervisor import Supervisor
from worker.tasks import register

log = logging.getLogger(__name__)

#: How long the reconciler may take to finish its round at the end.
_RECONCILER_GRACE = 10.0
#: How soon after a job the next one is asked for.
_LOOK_SECONDS = 0.2


def create_app(settings: Settings, supervisor: Supervisor) -> Celery:
    """The consuming end of the queues, with the task and the sign of life.

    Messages are taken for good, not held until acknowledged. The row and its lease already bring back what a
    dying worker had; an unacknowledged message would add nothing but a copy to be delivered hours later, and
    a way to get stuck: when the broker restarts during a job, the acknowledgement fails, is not repeated, and
    the full prefetch window keeps the worker from ever asking for another job. So there are no late
    acknowledgements, and no visibility timeout to tune: nothing is ever waiting to be restored.
    """
    app = create_celery(settings)
    app.conf.update(
        task_queues=tuple(Queue(name, no_ack=True) for name in settings.worker_queues),  # type: ignore[no-untyped-call]
        worker_disable_prefetch=True,  # ask for a job only when there is a thread for it
        worker_prefetch_multiplier=1,
        worker_concurrency=1,
        worker_pool="threads",
        # A running job is finished when the broker goes away; it needs no broker.
        worker_cancel_long_running_tasks_on_connection_loss=False,
        worker_send_task_events=False,
        worker_enable_remote_control=False,  # jobs are cancelled through their row
        worker_hijack_root_logger=False,
        worker_redirect_stdouts=False,
    )
    register(app, supervisor)
    app.steps["worker"].add(_pulse_step(pulse_path(settings.data_dir)))
    return app


def run_worker(settings: Settings) -> int:
    """Work until SIGTERM or SIGINT; returns the exit code. Must be called from the main thread."""
    stopping = threading.Event()
    store, storage, queue = create_store(settings), create_storage(settings), create_queue(settings)
    supervisor = Supervisor(settings, store, storage, queue, stopping)
    reconciler = Reconciler(settings, store, storage, queue)
    app = create_app(settings, supervisor)

    def stop(**_: Any) -> None:
        stopping.set()

    signals.worker_shutting_down.connect(stop, weak=False)
    thread = threading.Thread(target=reconciler.run, args=(stopping,), name="reconciler", daemon=True)
    thread.start()
    worker = app.Worker(
        concurrency=1,
        pool="threads",
        queues=list(settings.worker_queues),
        without_mingle=True,
        without_gossip=True,
        without_heartbeat=True,
        loglevel="INFO",
        quiet=True,
    )
    try:
        worker.start()
    finally:
        signals.worker_shutting_down.disconnect(stop)
        stopping.set()
        thread.join(_RECONCILER_GRACE)
        queue.close()
        store.close()
    return int(worker.exitcode or 0)


def _nothing() -> None:
    """The turn of the event loop is the point."""


def _pulse_step(path: Path) -> type[Any]:
    """A part of the worker that touches ``path`` from the event loop, so only while that loop turns."""

    class Pulse(bootsteps.StartStopStep):  # type: ignore[misc]
        requires = ("celery.worker.components:Timer",)

        def start(self, worker: Any) -> None:
            path.parent.mkdir(parents=True, exist_ok=True)
            sweep_pulses(path.parent.parent)
            worker.timer.call_after(0.0, path.touch)
            self._timers = [
                worker.timer.call_repeatedly(PULSE_SECONDS, path.touch),
                # Nothing wakes the loop when the pool's thread is done; so it looks whether to ask for a job.
                worker.timer.call_repeatedly(_LOOK_SECONDS, _nothing),
            ]

        def stop(self, _worker: Any) -> None:
            for timer in self._timers:
                timer.cancel()
            path.unlink(missing_ok=True)

    return Pulse
