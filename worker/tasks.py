"""The one task: look at the row that a message names."""

from __future__ import annotations

from celery import Celery

from service.queue import TASK
from worker.supervisor import Supervisor


def register(app: Celery, supervisor: Supervisor) -> None:
    """Give ``app`` the task. A message about a job that is taken, over or unknown does nothing."""

    @app.task(name=TASK, ignore_result=True)  # type: ignore[untyped-decorator]
    def reconstruct(job_id: str) -> None:
        supervisor.run(job_id)
