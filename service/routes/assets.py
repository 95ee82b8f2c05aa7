"""The files of a finished job."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path as FilePath
from typing import Annotated
from urllib.parse import quote

from fastapi import APIRouter, Path, Request, Response
from fastapi.responses import StreamingResponse

from service.access.gate import CallerDep
from service.jobs.schemas import AssetList, AssetView
from service.problems import Kind, ProblemError, declared
from service.routes.jobs import JobId
from service.services import ServicesDep, not_modified
from service.storage import MEDIA_TYPES

router = APIRouter(prefix="/jobs", tags=["results"])

_CHUNK = 256 * 1024
_ONE_RANGE = re.compile(r"bytes=(\d{0,18})-(\d{0,18})")


@router.get(
    "/{job_id}/assets",
    responses=declared(Kind.JOB_NOT_FOUND, Kind.JOB_NOT_READY, Kind.JOB_NO_RESULT),
)
def list_assets(job_id: JobId, services: ServicesDep, caller: CallerDep) -> AssetList:
    """The files, with size and SHA-256."""
    found = services.storage.assets(job_id, services.artifact(job_id, caller))
    views = [AssetView(**vars(asset), href=f"/jobs/{job_id}/assets/{quote(asset.name)}") for asset in found]
    return AssetList(assets=views)


@router.get(
    "/{job_id}/assets/{name:path}",
    response_class=Response,
    responses={
        200: {
            "description": "The file.",
            "content": {
                kind: {}
                if kind.endswith("json")
                else {"schema": {"type": "string", "contentMediaType": kind}}
                for kind in sorted(MEDIA_TYPES)
            },
        },
        206: {"description": "The range asked for (one range; several are answered with the whole file)."},
        304: {"description": "Unchanged since the ETag sent."},
        **declared(
            Kind.JOB_NOT_FOUND, Kind.JOB_NOT_READY, Kind.JOB_NO_RESULT, Kind.ASSET_NOT_FOUND, Kind.ASSET_RANGE
        ),
    },
)
def get_asset(
    job_id: JobId,
    name: Annotated[str, Path(max_length=200, description="A name from the list of assets.")],
    request: Request,
    services: ServicesDep,
    caller: CallerDep,
) -> Response:
    """Download one file; `Range` resumes a broken download."""
    found = services.storage.open_asset(job_id, services.artifact(job_id, caller), name)
    if found is None:
        raise ProblemError(Kind.ASSET_NOT_FOUND)
    asset, path = found
    etag = f'"{asset.sha256}"'
    headers = {
        "ETag": etag,
        "Cache-Control": "private, no-cache",
        "Accept-Ranges": "bytes",
        "Content-Disposition": f'attachment; filename="{path.name}"',
        "X-Content-Type-Options": "nosniff",
    }
    if not_modified(request, etag):
        return Response(status_code=304, headers=headers)
    status, start, end = 200, 0, asset.bytes
    wanted = request.headers.get("range")
    if wanted is not None and request.headers.get("if-range", etag) == etag:
        part = _byte_range(wanted, asset.bytes)
        if part is not None:
            status, (start, end) = 206, part
            headers["Content-Range"] = f"bytes {start}-{end - 1}/{asset.bytes}"
    headers["Content-Length"] = str(end - start)
    return StreamingResponse(_read(path, start, end), status, headers, asset.media_type)


def _byte_range(header: str, size: int) -> tuple[int, int] | None:
    """Start and end (exclusive) of the one range asked for; None where the header is to be ignored."""
    match = _ONE_RANGE.fullmatch(header.replace(" ", ""))
    if match is None or match.group(1) == match.group(2) == "":
        return None
    first, last = match.groups()
    if first == "":
        start, end = max(size - int(last), 0), size
    else:
        start, end = int(first), min(int(last) + 1, size) if last else size
        if last and int(last) < start:
            return None
    if start >= end:
        raise ProblemError(Kind.ASSET_RANGE, headers={"Content-Range": f"bytes */{size}"})
    return start, end


def _read(path: FilePath, start: int, end: int) -> Iterator[bytes]:
    with path.open("rb") as file:
        file.seek(start)
        while start < end and (chunk := file.read(min(_CHUNK, end - start))):
            start += len(chunk)
            yield chunk
