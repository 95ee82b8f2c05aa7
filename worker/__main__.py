"""``python -m worker``: take jobs until told to stop. Configured by MASS_* (service/settings.py)."""

from __future__ import annotations

import logging
import sys
import warnings

from celery.platforms import SecurityWarning

from service.logs import configure
from service.processes import hide_memory
from service.settings import Settings
from worker.app import run_worker
from worker.sandbox import announce, self_test


def main() -> int:
    """Run one worker; returns the exit code."""
    settings = Settings()
    configure("worker", settings.log_format)
    # Our own lines say what happens to jobs.
    for name in ("celery.worker.strategy", "celery.app.trace"):
        logging.getLogger(name).setLevel(logging.WARNING)
    # The warning is about messages that carry code, which root must not run; only JSON is accepted here.
    warnings.simplefilter("ignore", SecurityWarning)
    hide_memory()
    report = self_test(settings)
    announce(report)
    if settings.sandbox == "require" and not report.is_sound:
        logging.error("the engine cannot be shut in here as MASS_SANDBOX=require asks; not starting")
        return 1
    return run_worker(settings)


if __name__ == "__main__":
    sys.exit(main())
