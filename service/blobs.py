"""Objects by key: the little that is asked of any place where files are kept for more than one machine.

Two kinds, chosen by URL: ``file:///folder`` (a shared file system) and ``s3://bucket/prefix`` (anything that
speaks S3; ``?endpoint=https://host:port`` for one that is not Amazon's, ``&region=`` where it wants one).
Credentials are never in the URL: the S3 client looks for them where it always does (``AWS_ACCESS_KEY_ID`` and
``AWS_SECRET_ACCESS_KEY``, a profile, the machine's role).
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import uuid
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol
from urllib.parse import parse_qs, unquote, urlsplit

_KEY = re.compile(r"(?:[A-Za-z0-9_-][A-Za-z0-9._-]*/)*[A-Za-z0-9_-][A-Za-z0-9._-]*")
#: Most keys in one request to delete.
_BATCH = 1000


class BlobError(OSError):
    """The place cannot be reached, refuses, or is wrongly named. Trying again later may help."""


class BlobMissingError(BlobError):
    """There is no such object."""


@dataclass(frozen=True)
class Blob:
    """One object: its key, size, and when it was written (seconds since 1970)."""

    key: str
    bytes: int
    modified: float


class BlobStore(Protocol):
    """Whole objects, written and read from files. A key is a relative path without dots in front.

    Every method raises BlobError when the place fails, ValueError for a key that is none.
    """

    def put(self, key: str, source: Path) -> None:
        """Store the file; whoever reads the key sees the old object or the new one, whole."""

    def get(self, key: str, target: Path) -> None:
        """Write the object to ``target``, whole or not at all. Raises BlobMissingError."""

    def listing(self, prefix: str) -> Iterator[Blob]:
        """All objects under ``prefix``, which ends with a slash, in the order of their keys."""

    def delete(self, prefix: str) -> int:
        """Remove every object under ``prefix``, older versions too; returns how many keys there were."""


def open_blobs(url: str) -> BlobStore:
    """The store that ``url`` names. Raises BlobError for a URL of no kind known here."""
    parts = urlsplit(url)
    if parts.scheme == "file" and parts.netloc in ("", "localhost") and parts.path.startswith("/"):
        return LocalBlobs(Path(unquote(parts.path)))
    if parts.scheme == "s3" and parts.netloc:
        query = {name: values[-1] for name, values in parse_qs(parts.query).items()}
        return S3Blobs(
            parts.netloc, parts.path.strip("/"), query.get("endpoint"), query.get("region", "us-east-1")
        )
    raise BlobError(
        f"no storage of this kind: {parts.scheme}://... (use file:///folder or s3://bucket/prefix)"
    )


class LocalBlobs:
    """Objects as files below a folder."""

    def __init__(self, root: Path) -> None:
        self._root = root

    def put(self, key: str, source: Path) -> None:
        """See BlobStore."""
        target = self._root / _checked(key)
        with _translated():
            target.parent.mkdir(parents=True, exist_ok=True, mode=0o750)
            _copy(source, target)

    def get(self, key: str, target: Path) -> None:
        """See BlobStore."""
        source = self._root / _checked(key)
        if not source.is_file():
            raise BlobMissingError(f"there is no {key}")
        with _translated():
            _copy(source, target)

    def listing(self, prefix: str) -> Iterator[Blob]:
        """See BlobStore."""
        folder = self._root / _checked_prefix(prefix)
        found = []
        for path in folder.rglob("*"):
            with contextlib.suppress(FileNotFoundError):  # gone since it was listed
                if path.is_file() and not path.name.startswith("."):
                    status = path.stat()
                    key = path.relative_to(self._root).as_posix()
                    found.append(Blob(key, status.st_size, status.st_mtime))
        yield from sorted(found, key=lambda blob: blob.key)

    def delete(self, prefix: str) -> int:
        """See BlobStore."""
        folder = self._root / _checked_prefix(prefix)
        count = sum(1 for _ in self.listing(prefix))
        with _translated(), contextlib.suppress(FileNotFoundError):
            shutil.rmtree(folder)
        return count


class S3Blobs:
    """Objects in a bucket, below a prefix of it."""

    def __init__(
        self, bucket: str, prefix: str = "", endpoint: str | None = None, region: str = "us-east-1"
    ) -> None:
        # Slow to import, and needed by those only who use it.
        import boto3
        from botocore.config import Config

        config = Config(
            connect_timeout=5,
            read_timeout=60,
            retries={"max_attempts": 4, "mode": "standard"},
            s3={"addressing_style": "path" if endpoint else "auto"},
            # Others than Amazon's refuse checksums they were not asked for.
            request_checksum_calculation="when_required",
            response_checksum_validation="when_required",
        )
        self._client: Any = boto3.client("s3", endpoint_url=endpoint, region_name=region, config=config)
        self._bucket = bucket
        self._prefix = f"{prefix}/" if prefix else ""

    def put(self, key: str, source: Path) -> None:
        """See BlobStore. Large files go in parts, and appear when the last one has arrived."""
        with _translated(key):
            self._client.upload_file(str(source), self._bucket, self._prefix + _checked(key))

    def get(self, key: str, target: Path) -> None:
        """See BlobStore."""
        part = _beside(target)
        try:
            with _translated(key):
                self._client.download_file(self._bucket, self._prefix + _checked(key), str(part))
                part.replace(target)
        finally:
            part.unlink(missing_ok=True)

    def listing(self, prefix: str) -> Iterator[Blob]:
        """See BlobStore."""
        pages = self._client.get_paginator("list_objects_v2")
        with _translated(prefix):
            for page in pages.paginate(Bucket=self._bucket, Prefix=self._prefix + _checked_prefix(prefix)):
                for entry in page.get("Contents", ()):
                    key = entry["Key"].removeprefix(self._prefix)
                    yield Blob(key, entry["Size"], entry["LastModified"].timestamp())

    def delete(self, prefix: str) -> int:
        """See BlobStore."""
        keys = [{"Key": self._prefix + blob.key} for blob in self.listing(prefix)]
        self._remove(keys, prefix)
        self._remove(self._versions(prefix), prefix)
        return len(keys)

    def _versions(self, prefix: str) -> list[dict[str, str]]:
        """What a bucket that keeps versions still has of what was deleted."""
        with _translated(prefix):
            try:
                status = self._client.get_bucket_versioning(Bucket=self._bucket).get("Status")
            except self._client.exceptions.ClientError:
                return []  # a server that knows no versions, or credentials that may not ask
            if status is None:
                return []
            found = []
            pages = self._client.get_paginator("list_object_versions")
            for page in pages.paginate(Bucket=self._bucket, Prefix=self._prefix + prefix):
                entries = (*page.get("Versions", ()), *page.get("DeleteMarkers", ()))
                found += [{"Key": entry["Key"], "VersionId": entry["VersionId"]} for entry in entries]
            return found

    def _remove(self, objects: list[dict[str, str]], prefix: str) -> None:
        with _translated(prefix):
            for start in range(0, len(objects), _BATCH):
                batch = {"Objects": objects[start : start + _BATCH], "Quiet": True}
                answer = self._client.delete_objects(Bucket=self._bucket, Delete=batch)
                if answer.get("Errors"):
                    raise BlobError(f"{len(answer['Errors'])} objects under {prefix} were not removed")


def _checked(key: str) -> str:
    if _KEY.fullmatch(key) is None:
        raise ValueError(f"not a key: {key!r}")
    return key


def _checked_prefix(prefix: str) -> str:
    if not prefix.endswith("/"):
        raise ValueError(f"not a prefix: {prefix!r}")
    return _checked(prefix[:-1]) + "/"


@contextlib.contextmanager
def _translated(key: str = "") -> Iterator[None]:
    """Turn what a file system or an S3 client raises into BlobError, keeping what matters of a full disk."""
    try:
        yield
    except BlobError:
        raise
    except OSError as error:
        raise BlobError(error.errno, error.strerror, error.filename) from error
    except Exception as error:
        module = type(error).__module__.partition(".")[0]
        if module not in ("botocore", "boto3", "s3transfer"):
            raise
        code = str(getattr(error, "response", {}).get("Error", {}).get("Code", ""))
        if code in ("404", "NoSuchKey"):
            raise BlobMissingError(f"there is no {key}") from error
        raise BlobError(f"{key}: {error}") from error


def _beside(target: Path) -> Path:
    return target.with_name(f".{target.name}.{uuid.uuid4().hex}")


def _copy(source: Path, target: Path) -> None:
    """Copy so that ``target`` is there whole, durably, or not at all."""
    part = _beside(target)
    try:
        shutil.copyfile(source, part)
        with part.open("rb") as file:
            os.fsync(file.fileno())
        part.replace(target)
    finally:
        part.unlink(missing_ok=True)
