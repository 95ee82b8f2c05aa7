"""The wake-up messages: their broker, their queues, and the one message there is.

A message carries ``{job_id}`` and means "look at this row". Losing one costs time, never a job: the
reconciler sends it again. Getting one twice costs nothing: the claim in the row lets one worker through.

This file says how messages are sent and how both ends reach the broker; how they are taken is said in one
place too, worker/app.py.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any

from celery import Celery
from kombu.exceptions import KombuError
from redis.exceptions import RedisError

from service.settings import Settings

TASK = "mass.reconstruct"

log = logging.getLogger(__name__)


def broker_url(settings: Settings) -> str:
    """The broker in force: ``redis_url``, or the embedded server's socket in the data directory."""
    return settings.redis_url or f"redis+socket://{settings.data_dir / 'run' / 'broker.sock'}"


def queue_for(options: Mapping[str, Any], settings: Settings) -> str:
    """The queue of a job with these options: that of the device it asks for, else the default one."""
    return {"cpu": "cpu", "cuda": "gpu"}.get(str(options.get("device")), settings.default_queue)


def create_celery(settings: Settings) -> Celery:
    """The Celery app of both ends. The API only sends by name; the worker adds the task."""
    app = Celery("mass", broker=broker_url(settings), set_as_current=False)
    app.conf.update(
        task_default_queue=settings.default_queue,
        # Never pickle: a message must not be able to carry code.
        task_serializer="json",
        accept_content=["json"],
        # The state lives in the job row.
        task_ignore_result=True,
        result_backend=None,
        task_track_started=False,
        broker_transport_options={
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
    )
    return app


class JobQueue:
    """Sends the wake-up message."""

    def __init__(self, app: Celery, default_queue: str) -> None:
        self._app = app
        self._default = default_queue

    def publish(self, job_id: str, queue: str | None = None) -> bool:
        """Send; False when the broker could not be reached (logged, and left to the reconciler)."""
        try:
            self._app.send_task(TASK, args=[job_id], queue=queue or self._default, ignore_result=True)
        except (KombuError, RedisError, OSError) as error:
            log.warning("job %s: broker not reached (%s); the reconciler will send it", job_id, error)
            return False
        return True

    def close(self) -> None:
        """Close the pooled connections."""
        self._app.close()


def create_queue(settings: Settings) -> JobQueue:
    """The queue of ``settings``."""
    return JobQueue(create_celery(settings), settings.default_queue)
