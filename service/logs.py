"""Log lines that say which job and which trace they belong to, as text for people or JSON for machines."""

from __future__ import annotations

import json
import logging
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from datetime import UTC, datetime
from typing import Literal

#: What the current thread works on; set by :func:`about`, and empty everywhere else.
_SUBJECT: ContextVar[dict[str, str]] = ContextVar("subject", default={})  # noqa: B039 (never changed, only replaced)
_TRACEPARENT = re.compile(r"00-([0-9a-f]{32})-([0-9a-f]{16})-[0-9a-f]{2}")


@contextmanager
def about(job_id: str, traceparent: str | None = None, **more: str) -> Iterator[None]:
    """Everything logged inside is about this job, and part of this W3C trace."""
    subject = {"job": job_id, **more}
    match = _TRACEPARENT.fullmatch(traceparent or "")
    if match is not None:
        subject |= {"trace_id": match.group(1), "parent_span_id": match.group(2)}
    token = _SUBJECT.set(subject)
    try:
        yield
    finally:
        _SUBJECT.reset(token)


class JsonFormatter(logging.Formatter):
    """One JSON object a line: time, level, logger, message, and what it is about."""

    def __init__(self, process: str) -> None:
        super().__init__()
        self._process = process

    def format(self, record: logging.LogRecord) -> str:
        """See logging.Formatter."""
        line = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "process": self._process,
            "pid": record.process,
            "logger": record.name,
            "message": record.getMessage(),
            **_SUBJECT.get(),
        }
        if record.exc_info:
            line["error"] = self.formatException(record.exc_info)
        return json.dumps(line, ensure_ascii=False)


class TextFormatter(logging.Formatter):
    """A line for people; the trace follows in brackets where there is one."""

    def __init__(self, process: str) -> None:
        super().__init__(f"%(asctime)s {process}[%(process)d] %(levelname)s %(message)s")

    def format(self, record: logging.LogRecord) -> str:
        """See logging.Formatter."""
        trace = _SUBJECT.get().get("trace_id")
        text = super().format(record)
        return f"{text} [trace {trace}]" if trace else text


def configure(process: str, kind: Literal["text", "json"]) -> None:
    """Send the log of this process to standard error. To be called once, by the program's main."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(JsonFormatter(process) if kind == "json" else TextFormatter(process))
    logging.basicConfig(level=logging.INFO, handlers=[handler], force=True)
