"""One PATCH of an upload: bytes appended to a file, kept as far as they are safe."""

from __future__ import annotations

import base64
import binascii
import hashlib
import hmac
import os
from functools import partial
from pathlib import Path

from fastapi import Request

from service.problems import Kind, ProblemError
from service.receiving import guarded, receive
from service.storage import Storage
from service.tus.rows import Lock, UploadStore
from service.uploads import container

ALGORITHMS = ("sha1", "sha256")
_SNIFF = 12
#: Bytes between two commits.
_COMMIT_EVERY = 8 * 1024**2


def parse_checksum(header: str | None) -> tuple[str, bytes] | None:
    """Algorithm and digest of ``Upload-Checksum``. Raises ProblemError (400)."""
    if header is None:
        return None
    name, _, encoded = header.strip().partition(" ")
    try:
        digest = base64.b64decode(encoded, validate=True)
    except (binascii.Error, ValueError):
        digest = b""
    if name not in ALGORITHMS or len(digest) != hashlib.new(name).digest_size:
        raise ProblemError(
            Kind.UPLOAD_HEADERS, f"Upload-Checksum is one of {', '.join(ALGORITHMS)} and base64."
        )
    return name, digest


class Appender:
    """Writes one request's bytes. Methods block, so they run in a worker thread, one at a time.

    With a checksum all of the request counts or nothing; without one, whatever arrived before the
    connection broke is kept, and the sender resumes there.
    """

    def __init__(
        self, uploads: UploadStore, storage: Storage, lock: Lock, checksum: tuple[str, bytes] | None
    ) -> None:
        self._uploads, self._storage, self._lock = uploads, storage, lock
        self._checksum = checksum
        self._digest = hashlib.new(checksum[0]) if checksum else None
        self._path: Path = storage.upload_part(lock.upload_id)
        self._file = self._path.open("r+b")
        # Bytes that a crash left behind the last commit were never promised.
        self._file.truncate(lock.offset)
        self._file.seek(lock.offset)
        self.safe = self._at = lock.offset

    def feed(self, chunk: bytes) -> None:
        """Append. Raises ProblemError: too long, no room, not a video."""
        if self._at + len(chunk) > self._lock.length:
            raise ProblemError(Kind.UPLOAD_TOO_LARGE, "The body goes past the Upload-Length.")
        self._file.write(chunk)
        if self._digest is not None:
            self._digest.update(chunk)
        before, self._at = self._at, self._at + len(chunk)
        if before < _SNIFF <= self._at or self._at == self._lock.length:
            self._sniff()
        if self._at - self.safe >= _COMMIT_EVERY:
            if not self._storage.has_room():
                raise ProblemError(Kind.STORAGE_FULL, headers={"Retry-After": "60"})
            if self._digest is None:
                self._commit()

    def end(self, *, whole: bool) -> None:
        """The body ended, or broke off. Raises ProblemError (460) when the checksum differs."""
        if self._checksum is not None and self._digest is not None:
            if whole and not hmac.compare_digest(self._digest.digest(), self._checksum[1]):
                self.roll_back()
                raise ProblemError(Kind.UPLOAD_CHECKSUM)
            if not whole:
                self.roll_back()
                return
        self._commit()

    def roll_back(self) -> None:
        """Leave the file as long as what was promised."""
        self._file.truncate(self.safe)
        self._at = self.safe

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _commit(self) -> None:
        if self._at == self.safe:
            return
        self._file.flush()
        os.fsync(self._file.fileno())
        if not self._uploads.commit(self._lock, self._at):
            raise ProblemError(Kind.UPLOAD_NOT_FOUND, "The upload was ended meanwhile.")
        self.safe = self._at

    def _sniff(self) -> None:
        self._file.flush()
        with self._path.open("rb") as file:
            if container(file.read(_SNIFF)) is None:
                raise ProblemError(Kind.VIDEO_CONTAINER)


async def append(request: Request, appender: Appender) -> int:
    """Write the body of ``request``; returns the new offset. Raises ProblemError."""
    try:
        await receive(request, appender.feed, partial(appender.end, whole=True))
    except ProblemError as problem:
        if problem.kind in (Kind.UPLOAD_INCOMPLETE, Kind.UPLOAD_STALLED):
            # Not awaited in a thread: a cancelled request may await nothing more.
            guarded(partial(appender.end, whole=False))
        raise
    return appender.safe
