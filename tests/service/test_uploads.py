"""Submitting a video over a real connection: what is accepted, what is refused, and what is left behind."""

from __future__ import annotations

import json
import socket
import sqlite3
import threading
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from sqlalchemy.exc import OperationalError

from service.jobs.model import is_job_id
from service.queue import JobQueue
from service.storage import Storage
from tests.service.conftest import VIDEO, Live, problem

BOUNDARY = "----frontier"


def form(*parts: tuple[str, bytes], end: bool = True) -> bytes:
    body = b""
    for name, content in parts:
        disposition = f'form-data; name="{name}"' + ('; filename="x"' if name == "video" else "")
        body += f"--{BOUNDARY}\r\nContent-Disposition: {disposition}\r\n\r\n".encode() + content + b"\r\n"
    return body + (f"--{BOUNDARY}--\r\n".encode() if end else b"")


def post(live: Live, content: bytes | Iterator[bytes]) -> httpx.Response:
    headers = {"Content-Type": f"multipart/form-data; boundary={BOUNDARY}"}
    return live.http.post("/jobs", content=content, headers=headers)


def test_a_video_becomes_a_queued_job(live: Live) -> None:
    name = "../../My Hand \u2603.MOV"
    options = {"side": "left", "preset": "draft", "seed": 3, "fov": 60.5, "max_frames": 90, "holdout": 8}
    answer = live.http.post(
        "/jobs", files={"video": (name, VIDEO, "text/html")}, data={"options": json.dumps(options)}
    )
    assert answer.status_code == 202
    body = answer.json()
    assert is_job_id(body["id"])
    assert answer.headers["location"] == f"/jobs/{body['id']}" == body["links"]["self"]
    assert (body["state"], body["fraction"], body["attempt"], body["error"]) == ("queued", 0.0, 0, None)
    assert body["options"] == {**options, "device": None}
    assert body["video_bytes"] == len(VIDEO)
    job = live.services.store.get(body["id"])
    assert job is not None
    assert live.services.storage.source(job.video).read_bytes() == VIDEO
    assert live.files().count(f"uploads/{body['id']}/source") == 1
    assert not any("Hand" in file for file in live.files())


def test_a_webm_is_accepted_and_options_have_defaults(live: Live) -> None:
    answer = live.http.post("/jobs", files={"video": ("v", b"\x1a\x45\xdf\xa3" + bytes(100))})
    assert answer.status_code == 202
    assert answer.json()["options"] == {
        "side": "auto",
        "preset": "auto",
        "seed": 0,
        "fov": None,
        "max_frames": None,
        "holdout": None,
        "device": None,
    }


LIMIT = 1_000_000
BAD_FORMS: dict[str, tuple[bytes, int, str]] = {
    "text": (form(("video", b"this is a text file, not a video")), 415, "video.unsupported_container"),
    "short text": (form(("video", b"hi")), 415, "video.unsupported_container"),
    "script for another demuxer": (form(("video", b"ffconcat version 1.0\nfile a.mp4\n")), 415, "video."),
    "empty": (form(("video", b"")), 422, "video.empty"),
    "no video": (form(("options", b"{}")), 422, "video.missing"),
    "no parts": (form(), 422, "video.missing"),
    "no body": (b"", 422, "video.missing"),
    "unknown field": (form(("video", VIDEO), ("movie", b"x")), 422, "request.invalid"),
    "two videos": (form(("video", VIDEO), ("video", VIDEO)), 422, "request.invalid"),
    "options are not JSON": (form(("options", b"side=left"), ("video", VIDEO)), 422, "options.invalid"),
    "options are a list": (form(("options", b"[]"), ("video", VIDEO)), 422, "options.invalid"),
    # A request must not name files of the server: templates are for the command line.
    "a template": (form(("video", VIDEO), ("options", b'{"template": "builtin"}')), 422, "options.invalid"),
    "unknown option": (form(("video", VIDEO), ("options", b'{"color": 1}')), 422, "options.invalid"),
    "fov is no number": (form(("video", VIDEO), ("options", b'{"fov": NaN}')), 422, "options.invalid"),
    "holdout too small": (form(("video", VIDEO), ("options", b'{"holdout": 1}')), 422, "options.invalid"),
    "options too long": (form(("options", b" " * 100_000), ("video", VIDEO)), 422, "options.invalid"),
    "cut off": (form(("video", VIDEO), end=False), 400, "upload.incomplete"),
    "not multipart inside": (b"hello", 400, "request.malformed"),
    "one byte too many": (form(("video", VIDEO.ljust(LIMIT + 1, b"x"))), 413, "upload.too_large"),
    "far too many": (form(("video", VIDEO.ljust(3 * LIMIT, b"x"))), 413, "upload.too_large"),
    "long epilogue": (form(("video", VIDEO)) + bytes(3 * LIMIT), 413, "upload.too_large"),
}


@pytest.mark.parametrize("chunked", [False, True])
@pytest.mark.parametrize("name", BAD_FORMS)
def test_a_bad_form_is_refused_and_leaves_nothing(live: Live, name: str, chunked: bool) -> None:
    content, status, code = BAD_FORMS[name]
    before = live.files()
    jobs = live.http.get("/jobs").json()
    pieces = (content[i : i + 50_000] for i in range(0, len(content), 50_000))
    answer = post(live, pieces if chunked else content)
    body = problem(answer, status, answer.json()["code"] if code.endswith(".") else code)
    assert str(body["code"]).startswith(code)
    if code in ("options.invalid", "request.invalid") and "long" not in name:
        assert body["errors"]
    assert live.files() == before
    assert live.http.get("/jobs").json() == jobs


def test_exactly_the_limit_is_accepted(live: Live) -> None:
    assert post(live, form(("video", VIDEO.ljust(LIMIT, b"x")))).status_code == 202


def test_a_body_that_is_no_form_is_refused(live: Live) -> None:
    problem(live.http.post("/jobs", json={"video": "x"}), 422, "request.invalid")
    too_long = {"upload": "x", "options": {"side": "x" * 100_000}}
    problem(live.http.post("/jobs", json=too_long), 413, "upload.too_large")
    problem(live.http.post("/jobs", json={"upload": "x"}), 404, "upload.not_found")
    problem(live.http.post("/jobs", content=VIDEO), 415, "request.media_type")
    problem(
        live.http.post("/jobs", content=VIDEO, headers={"Content-Type": "multipart/form-data"}),
        415,
        "request.media_type",
    )
    problem(
        live.http.post(
            "/jobs", content=VIDEO, headers={"Content-Type": f"multipart/form-data; boundary={'b' * 500}"}
        ),
        400,
        "request.malformed",
    )
    assert not any(file.endswith(".part") for file in live.files())


def request_head(live: Live, length: int) -> bytes:
    return (
        f"POST /jobs HTTP/1.1\r\nHost: {live.host}:{live.port}\r\nContent-Length: {length}\r\n"
        f"Content-Type: multipart/form-data; boundary={BOUNDARY}\r\n\r\n"
    ).encode()


def read_all(connection: socket.socket) -> bytes:
    answer = b""
    while data := connection.recv(65536):
        answer += data
    return answer


def test_five_gigabytes_announced_are_refused_before_a_byte_is_sent(live: Live) -> None:
    before = live.files()
    with socket.create_connection((live.host, live.port), timeout=20) as connection:
        connection.sendall(request_head(live, 5 * 1024**3))
        answer = read_all(connection)
    head, _, body = answer.partition(b"\r\n\r\n")
    assert head.startswith(b"HTTP/1.1 413 ")
    assert b"application/problem+json" in head
    assert b"connection: close" in head.lower()
    assert json.loads(body)["code"] == "upload.too_large"
    assert live.files() == before
    assert live.http.get("/healthz").status_code == 200


def test_a_client_that_sends_on_after_a_refusal_still_gets_the_answer(live: Live) -> None:
    before = live.files()
    with socket.create_connection((live.host, live.port), timeout=20) as connection:
        connection.sendall(request_head(live, 900_000))
        connection.sendall(form(("video", b"just text " * 50), end=False))
        answer = b""
        while not answer.endswith(b"}"):
            answer += connection.recv(65536)
        for _ in range(10):  # had the server hung up, the second of these would fail
            connection.sendall(bytes(40_000))
        answer += read_all(connection)
    assert answer.startswith(b"HTTP/1.1 415 ")
    assert b"video.unsupported_container" in answer
    assert live.files() == before


def test_a_broken_connection_leaves_nothing(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    before = live.files()
    started, discarded = threading.Event(), threading.Event()
    begin, discard = Storage.begin_upload, Storage.discard_upload

    def watched_begin(self: Storage, job_id: str) -> Path:
        path = begin(self, job_id)
        started.set()
        return path

    def watched_discard(self: Storage, job_id: str) -> None:
        discard(self, job_id)
        discarded.set()

    monkeypatch.setattr(Storage, "begin_upload", watched_begin)
    monkeypatch.setattr(Storage, "discard_upload", watched_discard)
    with socket.create_connection((live.host, live.port), timeout=20) as connection:
        connection.sendall(request_head(live, 900_000))
        connection.sendall(form(("video", VIDEO), end=False))
        assert started.wait(20)
        assert not discarded.is_set()
    assert discarded.wait(20)
    assert live.files() == before
    assert live.http.get("/healthz").status_code == 200


def test_a_client_that_goes_silent_is_given_up(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    before = live.files()
    monkeypatch.setattr("service.receiving.STALL_SECONDS", 0.2)
    with socket.create_connection((live.host, live.port), timeout=20) as connection:
        connection.sendall(request_head(live, 900_000))
        connection.sendall(form(("video", VIDEO), end=False))
        answer = read_all(connection)
    assert answer.startswith(b"HTTP/1.1 408 ")
    assert b"upload.stalled" in answer
    assert live.files() == before


def test_no_room_is_said_before_a_byte_is_read(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    before = live.files()
    monkeypatch.setattr(Storage, "free_bytes", lambda self: 1000)
    answer = post(live, form(("video", VIDEO)))
    problem(answer, 507, "storage.full")
    assert answer.headers["retry-after"]
    assert live.files() == before


def test_a_disk_that_fills_up_meanwhile_leaves_nothing(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    before = live.files()
    begin = Storage.begin_upload

    def full(self: Storage, job_id: str) -> Path:
        begin(self, job_id)
        return Path("/dev/full")

    monkeypatch.setattr(Storage, "begin_upload", full)
    problem(post(live, form(("video", VIDEO))), 507, "storage.full")
    assert live.files() == before
    monkeypatch.undo()
    assert live.submit()


def test_a_failure_of_the_database_leaves_no_upload(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    before = live.files()

    def broken(*_: object, **__: object) -> None:
        raise RuntimeError("database is gone")

    monkeypatch.setattr(live.services.store.__class__, "create", broken)
    body = problem(post(live, form(("video", VIDEO))), 500, "service.internal")
    assert "database" not in json.dumps(body)
    assert live.files() == before


@pytest.mark.parametrize(
    ("said", "status", "code"),
    [
        ("database is locked", 503, "service.not_ready"),
        ("database or disk is full", 507, "storage.full"),
    ],
)
def test_a_database_that_cannot_be_written_is_no_bug(
    live: Live, monkeypatch: pytest.MonkeyPatch, said: str, status: int, code: str
) -> None:
    before = live.files()

    def broken(*_: object, **__: object) -> None:
        raise OperationalError("INSERT", None, sqlite3.OperationalError(said))

    monkeypatch.setattr(live.services.store.__class__, "create", broken)
    answer = post(live, form(("video", VIDEO)))
    assert "INSERT" not in json.dumps(problem(answer, status, code))
    assert int(answer.headers["Retry-After"]) > 0
    assert live.files() == before


def test_a_broker_that_is_away_does_not_refuse_a_job(live: Live) -> None:
    job = live.services.store.get(live.submit())
    assert job is not None
    assert job.publish_attempts == 0  # left to the reconciler


def test_sending_marks_the_job_published(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    sent: list[str] = []

    def publish(self: JobQueue, job_id: str, *_: object) -> bool:
        sent.append(job_id)
        return True

    monkeypatch.setattr(JobQueue, "publish", publish)
    job_id = live.submit()
    job = live.services.store.get(job_id)
    assert job is not None
    assert sent == [job_id]
    assert job.publish_attempts == 1
