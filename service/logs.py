"""Log lines that say which job and trace they belong to: as text, or as JSON for a machine."""

from __future__ import annotations

import json
import logging
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from datetime import UTC, datetime
from typing import Literal, TextIO

LogFormat = Literal["text", "json"]

#: What the current request or job is about; set by :func:`about`.
_ABOUT: ContextVar[dict[str, str] | None] = ContextVar("about", default=None)
#: Attributes of a record that are put into JSON when somebody passes them as ``extra``.
_EXTRA = ("method", "path", "status", "milliseconds")


@contextmanager
def about(**names: str | None) -> Iterator[None]:
    """Say in every line logged inside what it is about: ``job``, ``trace``."""
    token = _ABOUT.set({**(_ABOUT.get() or {}), **{k: v for k, v in names.items() if v is not None}})
    try:
        yield
    finally:
        _ABOUT.reset(token)


def trace_of(traceparent: str | None) -> str | None:
    """The trace id in a W3C trace context; None when it is none."""
    parts = (traceparent or "").split("-")
    return parts[1] if len(parts) == 4 and len(parts[1]) == 32 else None


class JsonFormatter(logging.Formatter):
    """One JSON object a line."""

    def __init__(self, part: str) -> None:
        super().__init__()
        self._part = part

    def format(self, record: logging.LogRecord) -> str:
        """The line."""
        said: dict[str, object] = {
            "at": datetime.fromtimestamp(record.created, UTC).isoformat(),
            "level": record.levelname,
            "part": self._part,
            "logger": record.name,
            "message": record.getMessage(),
            **getattr(record, "about", {}),
            **{name: getattr(record, name) for name in _EXTRA if hasattr(record, name)},
        }
        if record.exc_info:
            said["exception"] = self.formatException(record.exc_info)
        return json.dumps(said, ensure_ascii=False, default=str)


class TextFormatter(logging.Formatter):
    """For people: time, part, level, message, and at the end what it is about."""

    def __init__(self, part: str) -> None:
        super().__init__(f"%(asctime)s {part}[%(process)d] %(levelname)s %(message)s")

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802 - the base class's name
        """The line without its exception."""
        names: dict[str, str] = getattr(record, "about", {})
        unsaid = [f"{name}={value}" for name, value in names.items() if value not in record.message]
        return " ".join([super().formatMessage(record), *unsaid])


def configure(part: str, style: LogFormat, stream: TextIO | None = None) -> logging.Handler:
    """Send all lines of this process to ``stream`` (standard error); returns the handler in charge."""
    handler = logging.StreamHandler(stream or sys.stderr)
    handler.setFormatter(JsonFormatter(part) if style == "json" else TextFormatter(part))
    handler.addFilter(_add_about)
    root = logging.getLogger()
    root.handlers[:] = [handler]
    root.setLevel(logging.INFO)
    for name in ("httpx", "httpcore"):
        logging.getLogger(name).setLevel(logging.WARNING)
    return handler


def _add_about(record: logging.LogRecord) -> bool:
    record.about = _ABOUT.get() or {}
    return True
