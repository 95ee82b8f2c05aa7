"""A small client of the HTTP API: submit a video, follow the job, render, download."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import time
import uuid
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Self
from urllib.parse import quote

import httpx

from service.answers import FINAL, AssetInfo, EventInfo, JobError, JobInfo, parse_events, parse_job, refusal
from service.errors import ServiceError
from service.transfers import BytesProgress, begin, give_up, send

__all__ = ["AssetInfo", "BytesProgress", "EventInfo", "JobError", "JobInfo", "MassClient", "ServiceError"]

DEFAULT_URL = "http://127.0.0.1:8000"
#: How often a connection is tried again before it counts as lost.
_RECONNECTS = 5
#: How many times a service that was asked too often is left alone as long as it says, and how long at most.
_WAITS, _LONGEST_WAIT = 3, 60


class MassClient:
    """Talks to one service. Every method raises ServiceError."""

    def __init__(
        self,
        url: str = DEFAULT_URL,
        timeout: float = 60.0,
        transport: httpx.BaseTransport | None = None,
        key: str | None = None,
    ) -> None:
        """``key``: for a service that asks for one (default: ``$MASS_KEY``)."""
        key = key or os.environ.get("MASS_KEY")
        headers = {"Authorization": f"Bearer {key}"} if key else {}
        self._http = httpx.Client(base_url=url, timeout=timeout, transport=transport, headers=headers)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the connections."""
        self._http.close()

    def submit(
        self,
        video: Path,
        options: Mapping[str, Any] | None = None,
        on_progress: BytesProgress | None = None,
        *,
        resumable: bool = True,
    ) -> JobInfo:
        """Upload a video and create its job. Raises OSError when the file cannot be read.

        ``resumable``: in parts, so that a broken connection costs one of them; otherwise as one form.
        """
        with video.open("rb") as file:
            size = video.stat().st_size
            if resumable:
                return self._submit_in_parts(file, size, options, on_progress)
            stream: Any = file if on_progress is None else _Counted(file, size, on_progress)
            return parse_job(
                self._request(
                    "POST",
                    "/jobs",
                    # The name on this machine is nobody else's business.
                    files={"video": ("video", stream, "application/octet-stream")},
                    data={"options": json.dumps(dict(options))} if options else None,
                ).json()
            )

    def _submit_in_parts(
        self, file: IO[bytes], size: int, options: Mapping[str, Any] | None, tell: BytesProgress | None
    ) -> JobInfo:
        """The job first, so that wrong options are told before the video is sent; then its bytes."""
        upload_id = begin(self._request, size)
        wish = {"upload": upload_id, "options": dict(options or {})}
        # Sent again after an answer that was lost, the key makes no second job.
        headers = {"Idempotency-Key": str(uuid.uuid4())}
        try:
            self._insist("POST", "/jobs", json=wish, headers=headers)
        except ServiceError:
            with contextlib.suppress(ServiceError):
                give_up(self._request, upload_id)
            raise
        send(self._request, upload_id, file, size, tell)
        return self.job(upload_id)

    def restart(
        self, job_id: str, options: Mapping[str, Any] | None = None, from_stage: str | None = None
    ) -> JobInfo:
        """A new job of the same video."""
        wish = {"options": dict(options or {}), "from_stage": from_stage}
        headers = {"Idempotency-Key": str(uuid.uuid4())}
        return parse_job(self._insist("POST", f"{_path(job_id)}/restart", json=wish, headers=headers).json())

    def animate(self, job_id: str, motion: Mapping[str, Any], hand: str | None = None) -> JobInfo:
        """A job that renders a motion of a finished hand; its file is ``motion.mp4`` or ``motion.webp``."""
        headers = {"Idempotency-Key": str(uuid.uuid4())}
        query = {} if hand is None else {"hand": hand}
        path = f"{_path(job_id)}/renders"
        return parse_job(self._insist("POST", path, json=dict(motion), headers=headers, params=query).json())

    def events(self, job_id: str, after: int = 0) -> Iterator[EventInfo]:
        """What happens to the job, from the event after ``after`` to its end. Connections that break are
        taken up again where they broke; raises ServiceError when that fails, too."""
        ended, failures = False, 0
        while not ended:
            before = after
            try:
                with self._http.stream(
                    "GET", f"{_path(job_id)}/events", headers={"Last-Event-ID": str(after)}
                ) as answer:
                    if answer.is_error:
                        answer.read()
                        raise refusal(answer)
                    if answer.status_code == 204:
                        return
                    for event in parse_events(answer.iter_lines()):
                        after = event.id
                        ended = event.data.get("state") in FINAL
                        yield event
            except httpx.HTTPError as error:
                failures = 0 if after > before else failures + 1
                if failures > _RECONNECTS:
                    raise self._unreachable(error) from error
                time.sleep(min(0.5 * failures, 5.0))

    def job(self, job_id: str) -> JobInfo:
        """The job as it is now."""
        return parse_job(self._request("GET", _path(job_id)).json())

    def jobs(self) -> Iterator[JobInfo]:
        """All jobs, newest first."""
        cursor: str | None = None
        while True:
            page = self._request("GET", "/jobs", params={} if cursor is None else {"cursor": cursor}).json()
            yield from map(parse_job, page["jobs"])
            cursor = page["next"]
            if cursor is None:
                return

    def wait(
        self,
        job_id: str,
        on_update: Callable[[JobInfo], None] | None = None,
        poll_seconds: float = 1.0,
        patience: float = 60.0,
    ) -> JobInfo:
        """Follow the job to its end. A service that goes away is waited for, ``patience`` seconds long."""
        response = self._request("GET", _path(job_id))
        etag, job = response.headers.get("etag", ""), parse_job(response.json())
        if on_update is not None:
            on_update(job)
        last_answer = time.monotonic()
        while not job.finished:
            time.sleep(poll_seconds)
            try:
                response = self._request(
                    "GET", _path(job_id), headers={"If-None-Match": etag} if etag else {}
                )
            except ServiceError as error:
                away = error.status == 0 or error.status >= 500
                if not away or time.monotonic() - last_answer > patience:
                    raise
                continue
            last_answer = time.monotonic()
            if response.status_code == 304:
                continue
            etag, job = response.headers.get("etag", ""), parse_job(response.json())
            if on_update is not None:
                on_update(job)
        return job

    def logs(self, job_id: str) -> Iterator[str]:
        """What the engine has said so far."""
        after = 0
        while True:
            page = self._request(
                "GET", f"{_path(job_id)}/logs", params={"after": after, "limit": 1000}
            ).json()
            yield from (line["text"] for line in page["lines"])
            if not page["lines"]:
                return
            after = page["next"]

    def cancel(self, job_id: str) -> JobInfo:
        """Stop a queued or running job."""
        return parse_job(self._request("POST", f"{_path(job_id)}/cancel").json())

    def delete(self, job_id: str) -> None:
        """Remove the job and everything of it."""
        self._request("DELETE", _path(job_id))

    def render(
        self,
        job_id: str,
        pose: str = "rest",
        camera: str = "source",
        width: int = 512,
        height: int = 512,
        image_format: str = "png",
        channel: str = "rgb",
    ) -> bytes:
        """An encoded picture (``png``, ``jpeg`` or ``webp``) of the finished hand.

        ``channel``: ``rgb``, ``alpha``, ``depth``, ``normal``, ``distortion`` or ``surfels``.
        """
        query = {
            "pose": pose,
            "camera": camera,
            "width": width,
            "height": height,
            "format": image_format,
            "channel": channel,
        }
        return self._request("GET", f"{_path(job_id)}/render", params=query).content

    def assets(self, job_id: str) -> list[AssetInfo]:
        """The files of a finished job."""
        found = self._request("GET", f"{_path(job_id)}/assets").json()["assets"]
        return [AssetInfo(entry["name"], entry["bytes"], entry["sha256"]) for entry in found]

    def download(
        self, job_id: str, asset: AssetInfo, folder: Path, on_progress: BytesProgress | None = None
    ) -> Path:
        """Write an asset below ``folder``, checked against its SHA-256; returns the file."""
        target = folder / asset.name
        if not target.resolve().is_relative_to(folder.resolve()):
            raise ServiceError(0, "client.name", f"The service sent the unusable file name {asset.name!r}.")
        target.parent.mkdir(parents=True, exist_ok=True)
        part = target.with_name(f"{target.name}.part")
        digest, received = hashlib.sha256(), 0
        try:
            with (
                self._http.stream("GET", f"{_path(job_id)}/assets/{quote(asset.name)}") as response,
                part.open("wb") as file,
            ):
                if response.is_error:
                    response.read()
                    raise refusal(response)
                for chunk in response.iter_bytes():
                    file.write(chunk)
                    digest.update(chunk)
                    received += len(chunk)
                    if on_progress is not None:
                        on_progress(received, asset.bytes)
            if digest.hexdigest() != asset.sha256:
                raise ServiceError(
                    0, "client.checksum", f"{asset.name} arrived damaged.", "Download it again."
                )
            part.replace(target)
        except httpx.HTTPError as error:
            raise self._unreachable(error) from error
        finally:
            part.unlink(missing_ok=True)
        return target

    def _insist(self, method: str, path: str, **arguments: Any) -> httpx.Response:
        """Ask again when no answer came. For requests that may safely arrive twice."""
        for left in range(_RECONNECTS, -1, -1):
            try:
                return self._request(method, path, **arguments)
            except ServiceError as error:
                if error.status or not left:
                    raise
                time.sleep(0.5)
        raise AssertionError("unreachable")

    def _request(self, method: str, path: str, **arguments: Any) -> httpx.Response:
        for left in range(_WAITS, -1, -1):
            try:
                response = self._http.request(method, path, **arguments)
            except httpx.HTTPError as error:
                raise self._unreachable(error) from error
            if not response.is_error:
                return response
            problem = refusal(response)
            wait = response.headers.get("retry-after", "")
            # The answer to HEAD has no code. A form that was read once cannot be sent again.
            too_often = problem.code in ("rate.exceeded", "http.429") and "files" not in arguments
            if not (left and too_often and wait.isdecimal() and int(wait) <= _LONGEST_WAIT):
                raise problem
            time.sleep(int(wait))
        raise AssertionError("unreachable")

    def _unreachable(self, error: httpx.HTTPError) -> ServiceError:
        return ServiceError(
            0,
            "client.unreachable",
            f"The service at {self._http.base_url} does not answer ({error or type(error).__name__}).",
            "Start it with `mass serve`, or name another with --url.",
        )


class _Counted:
    """A file that tells how much of it was read."""

    def __init__(self, file: IO[bytes], total: int, tell: BytesProgress) -> None:
        self._file, self._total, self._tell, self._sent = file, total, tell, 0

    def read(self, size: int = -1) -> bytes:
        data = self._file.read(size)
        self._sent += len(data)
        self._tell(self._sent, self._total)
        return data

    def fileno(self) -> int:
        return self._file.fileno()  # its size is taken from here


def _path(job_id: str) -> str:
    return f"/jobs/{quote(job_id, safe='')}"
