"""The form of ``POST /jobs``, written to disk while it arrives.

The framework's own form parser spools the whole body to a temporary directory before the route runs. This one
writes the video straight to where it stays, looks at its first bytes, and stops at the first thing wrong.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

from fastapi import Request
from pydantic import ValidationError
from python_multipart.exceptions import FormParserError
from python_multipart.multipart import MultipartParser, parse_options_header

from service.jobs.schemas import JobOptions
from service.problems import Kind, ProblemError, field_errors
from service.receiving import receive
from service.storage import Storage

#: What a form may weigh besides its video: boundaries, headers, options.
FORM_OVERHEAD = 1 << 20
_MAX_OPTIONS = 64 * 1024
_SNIFF = 12
_ROOM_EVERY = 64 * 1024**2


@dataclass(frozen=True)
class ReceivedForm:
    """A complete form; the video lies in the file it was written to."""

    options: JobOptions
    video_bytes: int
    video_sha256: str


def container(head: bytes) -> str | None:
    """The container family by its first bytes: ``mp4`` (also MOV), ``webm`` (also Matroska), or None.

    Only the bytes count. A name or a declared type proves nothing, and a demuxer left to guess can be talked
    into reading other files.
    """
    if head[4:8] == b"ftyp":
        return "mp4"
    if head[:4] == b"\x1a\x45\xdf\xa3":
        return "webm"
    return None


async def receive_form(
    request: Request, target: Path, storage: Storage, max_video_bytes: int
) -> ReceivedForm:
    """Read the body of ``request``, writing the field ``video`` to ``target``. Raises ProblemError.

    The caller removes ``target`` when this raises.
    """
    form = _Form(request.headers.get("content-type", ""), target, storage, max_video_bytes)
    try:
        return await receive(request, form.feed, form.finish)
    finally:
        form.close()


def refuse_early(request: Request, storage: Storage, max_video_bytes: int) -> None:
    """Refuse, before a byte is read, what its headers show to be hopeless. Raises ProblemError."""
    length = declared_length(request)
    if length > max_video_bytes + FORM_OVERHEAD:
        detail = f"The body is said to have {length} bytes; a video may have {max_video_bytes}."
        problem = ProblemError(Kind.UPLOAD_TOO_LARGE, detail)
    elif not storage.has_room(length):
        problem = ProblemError(Kind.STORAGE_FULL, headers={"Retry-After": "60"})
    else:
        return
    problem.unread = True
    raise problem


def media_type(request: Request) -> str:
    """The media type of the body, without its parameters."""
    return request.headers.get("content-type", "").partition(";")[0].strip().lower()


def declared_length(request: Request) -> int:
    """Bytes of the body as its header says; 0 when it does not."""
    declared = request.headers.get("content-length", "")
    return int(declared) if declared.isdecimal() else 0


class _Form:
    """Collects the parts. All methods block, so they run in a worker thread, one at a time."""

    def __init__(self, content_type: str, target: Path, storage: Storage, max_video_bytes: int) -> None:
        kind, parameters = parse_options_header(content_type)
        boundary = parameters.get(b"boundary", b"")
        if kind != b"multipart/form-data" or not boundary:
            raise ProblemError(Kind.REQUEST_MEDIA_TYPE)
        self._storage = storage
        self._limit = max_video_bytes
        self._file = target.open("wb")
        self._head = b""
        self._digest = hashlib.sha256()
        self._video_bytes: int | None = None
        self._options: bytearray | None = None
        self._received = 0
        self._room_at = _ROOM_EVERY
        self._field = ""
        self._header_name = b""
        self._header_value = b""
        self._disposition = b""
        self._ended = False
        callbacks = {
            "on_part_begin": self._part_begin,
            "on_header_field": self._header_field,
            "on_header_value": self._header_text,
            "on_header_end": self._header_end,
            "on_headers_finished": self._headers_finished,
            "on_part_data": self._part_data,
            "on_part_end": self._part_end,
            "on_end": self._end,
        }
        try:
            self._parser = MultipartParser(boundary, callbacks)  # type: ignore[arg-type]
        except FormParserError as error:
            self._file.close()
            raise ProblemError(Kind.REQUEST_MALFORMED, "The form's boundary is too long.") from error

    def feed(self, chunk: bytes) -> None:
        """Take the next bytes of the body."""
        self._received += len(chunk)
        if self._received > self._limit + FORM_OVERHEAD:
            raise ProblemError(Kind.UPLOAD_TOO_LARGE, f"A video may have {self._limit} bytes.")
        if self._received > self._room_at:
            self._room_at += _ROOM_EVERY
            if not self._storage.has_room():
                raise ProblemError(Kind.STORAGE_FULL, headers={"Retry-After": "60"})
        try:
            self._parser.write(chunk)
        except FormParserError as error:
            raise ProblemError(Kind.REQUEST_MALFORMED, "The form's multipart encoding is broken.") from error

    def finish(self) -> ReceivedForm:
        """The body has ended: check that it was whole."""
        self._file.close()
        if self._received and not self._ended:
            raise ProblemError(Kind.UPLOAD_INCOMPLETE, "The form ends before its closing boundary.")
        if self._video_bytes is None:
            raise ProblemError(Kind.VIDEO_MISSING)
        return ReceivedForm(self._parsed_options(), self._video_bytes, self._digest.hexdigest())

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _parsed_options(self) -> JobOptions:
        if self._options is None:
            return JobOptions()
        try:
            return JobOptions.model_validate_json(bytes(self._options) or b"{}")
        except ValidationError as error:
            raise ProblemError(Kind.OPTIONS_INVALID, errors=field_errors(error.errors())) from error

    # Parser callbacks

    def _part_begin(self) -> None:
        self._disposition = b""

    def _header_field(self, data: bytes, start: int, end: int) -> None:
        self._header_name += data[start:end]

    def _header_text(self, data: bytes, start: int, end: int) -> None:
        self._header_value += data[start:end]

    def _header_end(self) -> None:
        if self._header_name.lower() == b"content-disposition":
            self._disposition = self._header_value
        self._header_name = self._header_value = b""

    def _headers_finished(self) -> None:
        _, parameters = parse_options_header(self._disposition)
        self._field = parameters.get(b"name", b"").decode("utf-8", "replace")
        if self._field == "video" and self._video_bytes is None:
            self._video_bytes = 0
        elif self._field == "options" and self._options is None:
            self._options = bytearray()
        else:
            error = {"field": self._field[:80], "message": "Not a field of this form, or given twice."}
            raise ProblemError(Kind.REQUEST_INVALID, errors=[error])

    def _part_data(self, data: bytes, start: int, end: int) -> None:
        if self._field == "options":
            assert self._options is not None
            self._options += data[start:end]
            if len(self._options) > _MAX_OPTIONS:
                raise ProblemError(Kind.OPTIONS_INVALID, "The options are too long.")
            return
        assert self._video_bytes is not None
        self._video_bytes += end - start
        if self._video_bytes > self._limit:
            raise ProblemError(Kind.UPLOAD_TOO_LARGE, f"A video may have {self._limit} bytes.")
        if len(self._head) < _SNIFF:
            self._head += data[start : min(end, start + _SNIFF)]
            if len(self._head) >= _SNIFF:
                self._check_container()
        part = memoryview(data)[start:end]
        self._digest.update(part)
        self._file.write(part)

    def _part_end(self) -> None:
        if self._field == "video":
            if not self._video_bytes:
                raise ProblemError(Kind.VIDEO_EMPTY)
            self._check_container()

    def _end(self) -> None:
        self._ended = True

    def _check_container(self) -> None:
        if container(self._head) is None:
            raise ProblemError(Kind.VIDEO_CONTAINER)
