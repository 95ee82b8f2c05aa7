"""The wake-up messages: their broker, their configuration, and the one message there is.

A message carries ``{job_id}`` and means "look at this row". Losing one costs time, never a job: the
reconciler sends it again. Getting one twice costs nothing: the claim in the row lets one worker through.
"""

from __future__ import annotations

import logging

from celery import Celery
from kombu.exceptions import KombuError
from redis.exceptions import RedisError

from service.settings import Settings

TASK = "mass.reconstruct"

log = logging.getLogger(__name__)


def broker_url(settings: Settings) -> str:
    """The broker in force: ``redis_url``, or the embedded server's socket in the data directory."""
    return settings.redis_url or f"redis+socket://{settings.data_dir / 'run' / 'broker.sock'}"


def create_celery(settings: Settings) -> Celery:
    """The Celery app of both ends. The API only sends by name; the worker adds the task."""
    app = Celery("mass", broker=broker_url(settings), set_as_current=False)
    limit = settings.job_timeout
    app.conf.update(
        task_default_queue=settings.queue_name,
        task_serializer="json",
        accept_content=["json"],
        # The state lives in the job row.
        task_ignore_result=True,
        result_backend=None,
        task_track_started=False,
        task_acks_late=True,
        worker_prefetch_multiplier=1,
        worker_concurrency=1,
        # Rejecting would restart a task that kills its child in a hot loop; the retry is bounded.
        task_reject_on_worker_lost=False,
        task_retry_on_worker_lost=True,
        task_time_limit=limit + 240,
        task_soft_time_limit=limit + 120,
        broker_transport_options={
            # Longer than any job: Redis never renews it, so it cannot be the means of recovery.
            "visibility_timeout": int(max(6 * 3600, 3 * limit)),
            "unacked_restore_interval": 15,
            "unacked_restore_throttle": 1,
            "socket_keepalive": True,
            "health_check_interval": 25,
            "socket_connect_timeout": 5,
            "global_keyprefix": "mass:",
        },
        broker_connection_retry_on_startup=True,
        broker_connection_max_retries=None,
        # The API answers quickly whether the broker does or not.
        task_publish_retry_policy={
            "max_retries": 2,
            "interval_start": 0,
            "interval_step": 0.2,
            "interval_max": 1,
        },
        worker_pool_start_method="spawn",
        worker_max_tasks_per_child=1,
        # False lets a running job finish when the broker comes back; True would start it from zero.
        worker_cancel_long_running_tasks_on_connection_loss=False,
        worker_soft_shutdown_timeout=30,
        worker_send_task_events=False,
    )
    return app


class JobQueue:
    """Sends the wake-up message."""

    def __init__(self, app: Celery, queue_name: str) -> None:
        self._app = app
        self._queue = queue_name

    def publish(self, job_id: str) -> bool:
        """Send; False when the broker could not be reached (logged, and left to the reconciler)."""
        try:
            self._app.send_task(TASK, args=[job_id], queue=self._queue, ignore_result=True)
        except (KombuError, RedisError, OSError) as error:
            log.warning("job %s: broker not reached (%s); the reconciler will send it", job_id, error)
            return False
        return True

    def close(self) -> None:
        """Close the pooled connections."""
        self._app.close()


def create_queue(settings: Settings) -> JobQueue:
    """The queue of ``settings``."""
    return JobQueue(create_celery(settings), settings.queue_name)
