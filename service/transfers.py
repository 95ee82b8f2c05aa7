"""The client's side of resumable uploads: parts with checksums, resumed where the service says they stand."""

from __future__ import annotations

import base64
import hashlib
import time
from collections.abc import Callable, Mapping
from typing import IO, Any, Protocol

import httpx

from service.errors import ServiceError

PART_BYTES = 4 * 1024**2
_TUS = {"Tus-Resumable": "1.0.0"}
#: Answers after which it helps to ask where the upload stands and go on: a lost race, a damaged part.
_RESUME = frozenset({408, 409, 423, 429, 460})

BytesProgress = Callable[[int, int], None]


class Ask(Protocol):
    """Sends a request. Raises ServiceError, with status 0 when nobody answers."""

    def __call__(self, method: str, path: str, **arguments: Any) -> httpx.Response:
        """The answer."""
        ...


def upload(
    ask: Ask,
    file: IO[bytes],
    size: int,
    tell: BytesProgress | None,
    *,
    part_bytes: int = PART_BYTES,
    patience: float = 60.0,
    pause: float = 0.5,
) -> str:
    """Send ``size`` bytes of ``file``; returns the upload's id.

    A service or network that is away is waited for, ``patience`` seconds from the last byte that arrived.
    Raises ServiceError.
    """
    upload_id = begin(ask, size)
    send(ask, upload_id, file, size, tell, part_bytes=part_bytes, patience=patience, pause=pause)
    return upload_id


def begin(ask: Ask, size: int) -> str:
    """Make an upload of ``size`` bytes; returns its id. Raises ServiceError."""
    created = ask("POST", "/uploads", headers={**_TUS, "Upload-Length": str(size)})
    return str(created.headers["Location"].rpartition("/")[2])


def give_up(ask: Ask, upload_id: str) -> None:
    """Remove an upload that no job will be made of. Raises ServiceError."""
    ask("DELETE", f"/uploads/{upload_id}", headers=_TUS)


def send(
    ask: Ask,
    upload_id: str,
    file: IO[bytes],
    size: int,
    tell: BytesProgress | None,
    *,
    part_bytes: int = PART_BYTES,
    patience: float = 60.0,
    pause: float = 0.5,
) -> None:
    """Send the bytes of an upload; see :func:`upload`. Raises ServiceError."""
    path = f"/uploads/{upload_id}"
    offset, last = 0, time.monotonic()
    while offset < size:
        file.seek(offset)
        part = file.read(min(part_bytes, size - offset))
        try:
            answer = ask("PATCH", path, headers=_part_headers(offset, part), content=part)
            offset, last = _offset(answer.headers), time.monotonic()
        except ServiceError as error:
            helps = error.status == 0 or error.status >= 500 or error.status in _RESUME
            if not helps or time.monotonic() - last > patience:
                raise
            time.sleep(pause)
            offset = _standing(ask, path, offset)
        if tell is not None:
            tell(offset, size)


def _standing(ask: Ask, path: str, known: int) -> int:
    """Where the upload stands; as before when nobody answers."""
    try:
        return _offset(ask("HEAD", path, headers=_TUS).headers)
    except ServiceError as error:
        if error.status and error.status < 500:
            raise
        return known


def _part_headers(offset: int, part: bytes) -> dict[str, str]:
    digest = base64.b64encode(hashlib.sha256(part).digest()).decode()
    return {
        **_TUS,
        "Content-Type": "application/offset+octet-stream",
        "Upload-Offset": str(offset),
        "Upload-Checksum": f"sha256 {digest}",
    }


def _offset(headers: Mapping[str, str]) -> int:
    text = headers.get("Upload-Offset", "")
    if not text.isdecimal():
        raise ServiceError(0, "client.protocol", "The service does not say where the upload stands.")
    return int(text)
