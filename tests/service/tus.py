"""The client's side of a resumable upload, by hand."""

from __future__ import annotations

import base64
import hashlib

import httpx

from tests.service.conftest import VIDEO, Live

TUS = {"Tus-Resumable": "1.0.0"}
BYTES = {**TUS, "Content-Type": "application/offset+octet-stream"}


def begin(live: Live, length: int = len(VIDEO)) -> str:
    answer = live.http.post("/uploads", headers={**TUS, "Upload-Length": str(length)})
    assert answer.status_code == 201, answer.text
    assert answer.headers["Tus-Resumable"] == "1.0.0"
    return str(answer.headers["Location"])


def patch(live: Live, path: str, offset: int, data: bytes, **headers: str) -> httpx.Response:
    return live.http.patch(path, headers={**BYTES, "Upload-Offset": str(offset), **headers}, content=data)


def offset(live: Live, path: str) -> int:
    answer = live.http.head(path, headers=TUS)
    assert answer.status_code == 200
    assert answer.headers["Cache-Control"] == "no-store"
    return int(answer.headers["Upload-Offset"])


def checksum(data: bytes, name: str = "sha256") -> str:
    return f"{name} {base64.b64encode(hashlib.new(name, data).digest()).decode()}"


def name(path: str) -> str:
    return path.rsplit("/", 1)[1]
