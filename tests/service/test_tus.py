"""Resumable uploads: the protocol and its limits."""

from __future__ import annotations

import hashlib
import re
import tempfile
from pathlib import Path

import pytest
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from service.access.quotas import Quota
from service.jobs.model import new_job_id
from service.jobs.store import create_store
from service.problems import ProblemError
from service.settings import Settings
from service.storage import Storage
from service.tus.receive import Appender
from service.tus.rows import UploadStore
from tests.service.conftest import VIDEO, Live, problem
from tests.service.tus import BYTES, TUS, begin, checksum, name, offset, patch


def test_options_say_what_is_offered(live: Live) -> None:
    answer = live.http.options("/uploads")
    assert answer.status_code == 204
    assert answer.headers["Tus-Extension"] == "creation,termination,expiration,checksum"
    assert answer.headers["Tus-Version"] == "1.0.0"
    assert int(answer.headers["Tus-Max-Size"]) == live.services.settings.max_upload_bytes
    assert answer.headers["Tus-Checksum-Algorithm"] == "sha1,sha256"


def test_an_upload_in_parts_becomes_a_queued_job(live: Live) -> None:
    path = begin(live)
    for start in range(0, len(VIDEO), 3000):
        assert offset(live, path) == start
        answer = patch(live, path, start, VIDEO[start : start + 3000])
        assert answer.status_code == 204, answer.text
        assert answer.headers["Upload-Offset"] == str(min(start + 3000, len(VIDEO)))
        assert answer.headers["Upload-Expires"].endswith("GMT")
    assert offset(live, path) == len(VIDEO)
    job = live.http.post("/jobs", json={"upload": name(path), "options": {"side": "left"}})
    assert job.status_code == 202, job.text
    body = job.json()
    assert (body["id"], body["state"], body["video_bytes"]) == (name(path), "queued", len(VIDEO))
    assert body["options"]["side"] == "left"
    claim = live.services.store.claim(body["id"])
    assert claim is not None
    assert live.services.storage.source(claim.video).read_bytes() == VIDEO
    problem(live.http.post("/jobs", json={"upload": name(path)}), 409, "upload.used")
    assert live.http.head(path, headers=TUS).status_code == 404


def test_a_job_made_first_waits_for_its_upload(live: Live) -> None:
    path = begin(live)
    body = live.http.post("/jobs", json={"upload": name(path)}).json()
    assert (body["state"], body["links"]["upload"], body["video_bytes"]) == ("awaiting_upload", path, None)
    assert live.services.store.claim(body["id"]) is None
    assert patch(live, path, 0, VIDEO[:100]).status_code == 204
    assert patch(live, path, 100, VIDEO[100:]).status_code == 204
    body = live.http.get(f"/jobs/{name(path)}").json()
    assert (body["state"], body["links"]["upload"], body["video_bytes"]) == ("queued", None, len(VIDEO))


@pytest.mark.parametrize("whole", [False, True])
def test_a_job_of_an_upload_is_idempotent(live: Live, whole: bool) -> None:
    path, headers = begin(live), {"Idempotency-Key": new_job_id()}
    if whole:
        patch(live, path, 0, VIDEO)
    first, second = (live.http.post("/jobs", json={"upload": name(path)}, headers=headers) for _ in range(2))
    assert first.status_code == second.status_code == 202
    assert second.headers["Idempotency-Replayed"] == "true"
    other = {"upload": name(path), "options": {"seed": 2}}
    problem(live.http.post("/jobs", json=other, headers=headers), 422, "idempotency.mismatch")


@pytest.mark.parametrize("how", ["terminate", "cancel", "delete"])
def test_giving_up_removes_the_bytes_and_ends_the_job(live: Live, how: str) -> None:
    before = live.files()
    path = begin(live)
    job = f"/jobs/{name(path)}"
    live.http.post("/jobs", json={"upload": name(path)})
    patch(live, path, 0, VIDEO[:500])
    match how:
        case "terminate":
            assert live.http.delete(path, headers=TUS).status_code == 204
        case "cancel":
            assert live.http.post(f"{job}/cancel").json()["state"] == "cancelled"
        case _:
            assert live.http.delete(job).status_code == 204
    assert live.files() == before
    problem(live.http.delete(path, headers=TUS), 404, "upload.not_found")
    problem(patch(live, path, 500, VIDEO[500:]), 404, "upload.not_found")
    if how != "delete":
        assert live.http.get(job).json()["state"] == "cancelled"
        problem(live.http.post(f"{job}/restart"), 409, "job.no_video")


def test_what_is_no_video_is_refused_at_its_first_bytes(live: Live) -> None:
    before = live.files()
    path = begin(live)
    live.http.post("/jobs", json={"upload": name(path)})
    assert patch(live, path, 0, b"ffconcat").status_code == 204  # too short to tell
    problem(patch(live, path, 8, b" version 1.0 file a.mp4"), 415, "video.unsupported_container")
    assert live.files() == before
    job = live.http.get(f"/jobs/{name(path)}").json()
    assert (job["state"], job["error"]["code"]) == ("failed", "video.unsupported_container")
    short = begin(live, 5)
    problem(patch(live, short, 0, b"hello"), 415, "video.unsupported_container")
    assert live.files() == before


def test_a_wrong_offset_changes_nothing(live: Live) -> None:
    path = begin(live)
    patch(live, path, 0, VIDEO[:100])
    for wrong in (0, 99, 101, len(VIDEO)):
        answer = patch(live, path, wrong, b"x")
        problem(answer, 409, "upload.offset")
        assert answer.headers["Upload-Offset"] == "100"
    assert offset(live, path) == 100


@pytest.mark.parametrize("algorithm", ["sha1", "sha256"])
def test_a_part_counts_when_its_checksum_matches(live: Live, algorithm: str) -> None:
    path = begin(live)
    wrong = {"Upload-Checksum": checksum(b"other", algorithm)}
    problem(patch(live, path, 0, VIDEO[:500], **wrong), 460, "upload.checksum")
    assert offset(live, path) == 0
    right = {"Upload-Checksum": checksum(VIDEO[:500], algorithm)}
    assert patch(live, path, 0, VIDEO[:500], **right).status_code == 204
    assert offset(live, path) == 500
    assert live.services.storage.upload_part(name(path)).read_bytes() == VIDEO[:500]


@pytest.mark.parametrize("header", ["md5 1B2M2Y8AsgTpgAmY7PhCfg==", "sha1", "sha1 ***", "sha256 AAAA", ""])
def test_bad_checksum_headers(live: Live, header: str) -> None:
    path = begin(live)
    problem(patch(live, path, 0, VIDEO[:50], **{"Upload-Checksum": header}), 400, "upload.headers")
    assert offset(live, path) == 0


def test_the_protocol_is_insisted_on(live: Live) -> None:
    path = begin(live)
    for version in ({}, {"Tus-Resumable": "0.2.2"}):
        for method, where in (("POST", "/uploads"), ("PATCH", path), ("DELETE", path)):
            answer = live.http.request(method, where, headers={**version, "Upload-Length": "5"})
            problem(answer, 412, "upload.version")
            assert answer.headers["Tus-Version"] == "1.0.0"
        assert live.http.head(path, headers=version).status_code == 412
    plain = {**TUS, "Upload-Offset": "0", "Content-Type": "text/plain"}
    problem(live.http.patch(path, headers=plain, content=b"x"), 415, "upload.media_type")
    # A form may not stand for another method.
    overridden = {**TUS, "X-HTTP-Method-Override": "DELETE"}
    assert live.http.post(path, headers=overridden).status_code == 405


@pytest.mark.parametrize(
    ("headers", "status", "code"),
    [
        ({}, 400, "upload.headers"),
        ({"Upload-Length": "-1"}, 400, "upload.headers"),
        ({"Upload-Length": "1e3"}, 400, "upload.headers"),
        ({"Upload-Length": "9" * 40}, 400, "upload.headers"),
        ({"Upload-Defer-Length": "1"}, 400, "upload.headers"),
        ({"Upload-Length": "0"}, 422, "video.empty"),
        ({"Upload-Length": "1000001"}, 413, "upload.too_large"),
        ({"Upload-Length": "5", "Upload-Metadata": "filename ###"}, 400, "upload.headers"),
        ({"Upload-Length": "5", "Upload-Metadata": "x" * 5000}, 422, "request.invalid"),
    ],
)
def test_what_cannot_begin(live: Live, headers: dict[str, str], status: int, code: str) -> None:
    before = live.files()
    problem(live.http.post("/uploads", headers={**TUS, **headers}), status, code)
    assert live.files() == before
    good = {"Upload-Metadata": "filename L2V0Yy9wYXNzd2Q=,empty", "Upload-Length": "5"}
    assert live.http.post("/uploads", headers={**TUS, **good}).status_code == 201


def test_no_byte_past_the_length(live: Live) -> None:
    path = begin(live, 1000)
    problem(patch(live, path, 0, VIDEO[:1001]), 413, "upload.too_large")
    pieces = live.http.patch(
        path, headers={**BYTES, "Upload-Offset": "0"}, content=iter([VIDEO[:900], VIDEO])
    )
    problem(pieces, 413, "upload.too_large")
    assert live.services.storage.upload_part(name(path)).stat().st_size == offset(live, path)


class Upload(RuleBasedStateMachine):
    """Parts of any size, with and without checksums, breaking off anywhere: kept is what was promised."""

    @initialize()
    def begin(self) -> None:
        self.folder = tempfile.TemporaryDirectory()
        root = Path(self.folder.name)
        self.store = create_store(Settings(data_dir=root))
        self.storage = Storage(root)
        self.uploads = UploadStore(self.store.engine, 1000)
        self.id = self.uploads.create("ann", 400, Quota()).id
        self.storage.begin_upload(self.id).touch()
        self.content = (VIDEO * 2)[:400]
        self.safe = 0

    def teardown(self) -> None:
        if hasattr(self, "store"):
            self.store.close()
            self.folder.cleanup()

    @rule(
        sizes=st.lists(st.integers(0, 90), max_size=4),
        summed=st.sampled_from([None, True, False]),
        whole=st.booleans(),
        crash=st.booleans(),
    )
    def send(self, sizes: list[int], summed: bool | None, whole: bool, crash: bool) -> None:
        lock = self.uploads.lock(self.id)
        assert lock is not None
        assert lock.offset == self.safe
        end = lock.offset + sum(sizes)
        digest = hashlib.sha1(self.content[lock.offset : end] if summed else b"else").digest()
        appender = Appender(self.uploads, self.storage, lock, None if summed is None else ("sha1", digest))
        try:
            at = lock.offset
            for size in sizes:
                appender.feed(self.content[at : at + size].ljust(size, b"x"))
                at += size
            if not crash:
                appender.end(whole=whole)
        except ProblemError:
            appender.roll_back()
        finally:
            appender.close()
            self.uploads.unlock(lock)
        kept = not crash and end <= 400 and (summed is None or (summed and whole))
        self.safe = end if kept else self.safe

    @invariant()
    def the_file_is_what_was_promised(self) -> None:
        if not hasattr(self, "store"):
            return
        upload = self.uploads.get(self.id)
        assert upload is not None
        assert upload.offset == self.safe
        data = self.storage.upload_part(self.id).read_bytes()
        assert data[: self.safe] == self.content[: self.safe]


TestUpload = Upload.TestCase
TestUpload.settings = hypothesis_settings(max_examples=20, stateful_step_count=15, deadline=None)


def test_the_page_of_headers_is_declared(live: Live) -> None:
    document = live.http.get("/openapi.json").json()
    assert set(document["paths"]["/uploads/{upload_id}"]) == {"head", "patch", "delete"}
    assert set(document["paths"]["/uploads"]) == {"options", "post"}
    for path in ("/uploads", "/uploads/{upload_id}"):
        for operation in document["paths"][path].values():
            assert re.fullmatch(r"[a-z_]+", operation["operationId"])
