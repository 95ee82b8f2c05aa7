"""The API's document, the page, the guard at the door, and rules about the code itself."""

from __future__ import annotations

import ast
import json
import re
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any, get_args

import pytest
from openapi_spec_validator import validate

from service import bodies
from service.bodies import MAX_BODY
from service.compatibility import breaking_changes
from service.openapi import document
from service.pictures import Channel
from service.problems import Kind, ProblemBody
from service.reference import DOCUMENT, updated
from tests.service.conftest import VIDEO, Live, problem

ROOT = Path(__file__).parents[2]


def test_the_committed_document_is_not_stale() -> None:
    committed = (ROOT / "openapi" / "openapi.json").read_text()
    assert committed == document(), "run: make openapi"


def test_the_document_is_valid_and_every_error_in_it_is_a_problem() -> None:
    parsed = json.loads(document())
    validate(parsed)
    operations = [operation for path in parsed["paths"].values() for operation in path.values()]
    names = [operation["operationId"] for operation in operations]
    assert len(set(names)) == len(names)
    assert all(name.isidentifier() for name in names)
    assert "HTTPValidationError" not in json.dumps(parsed)
    for name in re.findall(r"#/components/schemas/(\w+)", json.dumps(parsed)):
        assert name in parsed["components"]["schemas"]
    for operation in operations:
        assert operation["description"]
        errors = {status: body for status, body in operation["responses"].items() if status >= "400"}
        assert "500" in errors
        for status, body in errors.items():
            assert set(body["content"]) == {"application/problem+json"}
            examples = body["content"]["application/problem+json"]["examples"]
            for code, example in examples.items():
                assert ProblemBody.model_validate(example["value"]).code == code
                assert example["value"]["status"] == int(status)
        if "requestBody" in operation:
            assert {"400", "413"} <= set(errors)
    assert "413" in parsed["paths"]["/jobs"]["post"]["responses"]
    assert "multipart/form-data" in parsed["paths"]["/jobs"]["post"]["requestBody"]["content"]


def test_every_kind_of_problem_is_described(live: Live) -> None:
    codes = [kind.code for kind in Kind]
    assert len(set(codes)) == len(codes)
    for kind in Kind:
        body = live.http.get(f"/problems/{kind.code}").json()
        assert body == {
            "code": kind.code,
            "status": kind.status,
            "title": kind.title,
            "advice": kind.advice,
        }
    problem(live.http.get("/problems/none"), 404, "request.not_found")


def test_unknown_paths_and_methods_are_problems(live: Live) -> None:
    problem(live.http.get("/nothing/here"), 404, "request.not_found")
    problem(live.http.get("/web/none.js"), 404, "request.not_found")
    answer = live.http.put("/jobs")
    problem(answer, 405, "request.method_not_allowed")
    assert answer.headers["allow"]


def test_the_page_and_the_docs_are_served_with_a_strict_policy(live: Live) -> None:
    page = live.http.get("/")
    assert page.status_code == 200
    assert "script-src 'self'" in page.headers["content-security-policy"]
    assert page.headers["x-content-type-options"] == "nosniff"
    assert "<script>" not in page.text
    assert "http://" not in page.text
    assert "https://" not in page.text
    docs = live.http.get("/docs")
    assert docs.headers["content-security-policy"] == page.headers["content-security-policy"]
    assert "<script>" not in docs.text
    assert "://" not in docs.text
    for name in ("page.js", "docs.js", "style.css"):
        assert f"/web/{name}" in page.text + docs.text
        asset = live.http.get(f"/web/{name}")
        assert asset.status_code == 200
        assert "innerHTML" not in asset.text
        assert "://" not in asset.text
    assert live.http.get("/openapi.json").json() == json.loads(document())


def test_capabilities_name_the_limits(live: Live) -> None:
    body = live.http.get("/capabilities").json()
    assert body["device"] == "cpu"
    assert body["max_upload_bytes"] == live.services.settings.max_upload_bytes
    assert body["max_render_pixels"] == live.services.settings.max_render_pixels
    assert body["channels"] == list(get_args(Channel))


def test_the_page_offers_every_channel(live: Live) -> None:
    selector = live.http.get("/").text.partition('id="channel"')[2].partition("</select>")[0]
    assert re.findall(r'<option value="(\w+)"', selector) == list(get_args(Channel))


@pytest.mark.parametrize(
    "host", ["evil.example", "localhost.evil.example", "", "[", "127.0.0.1.evil.example"]
)
def test_a_foreign_host_name_is_refused(live: Live, host: str) -> None:
    problem(live.http.get("/jobs", headers={"Host": host}), 403, "request.host")


@pytest.mark.parametrize("host", ["localhost", "localhost:99", "127.0.0.1", "[::1]:80", "192.168.1.7"])
def test_addresses_and_localhost_are_answered(live: Live, host: str) -> None:
    assert live.http.get("/healthz", headers={"Host": host}).status_code == 200


@pytest.mark.parametrize("origin", ["http://evil.example", "null", "http://127.0.0.1:1", ""])
def test_other_sites_cannot_change_anything(live: Live, origin: str) -> None:
    before = live.files()
    answer = live.http.post("/jobs", files={"video": ("v", VIDEO)}, headers={"Origin": origin})
    problem(answer, 403, "request.origin")
    assert live.files() == before
    job_id = live.submit()
    problem(live.http.delete(f"/jobs/{job_id}", headers={"Origin": origin}), 403, "request.origin")
    own = {"Origin": f"http://{live.host}:{live.port}"}
    assert live.http.delete(f"/jobs/{job_id}", headers=own).status_code == 204


def test_the_service_imports_neither_torch_nor_the_engine_nor_picture_libraries() -> None:
    code = (
        "import sys, service.app, service.openapi; service.openapi.document(); "
        "print([m for m in ('torch', 'mass_engine', 'cv2', 'numpy', 'av') if m in sys.modules])"
    )
    ran = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=60, check=True
    )
    assert ran.stdout.strip() == "[]"


#: What blocks the one thread that serves everybody.
BLOCKING = {"open", "sleep", "read_bytes", "read_text", "write_bytes", "write_text", "render", "publish"}


def test_async_routes_await_and_do_not_block() -> None:
    """An ``async def`` that never awaits should be a plain ``def``, which runs in a worker thread."""
    found = 0
    for path in (ROOT / "service" / "routes").glob("*.py"):
        for function in ast.walk(ast.parse(path.read_text())):
            if not isinstance(function, ast.AsyncFunctionDef):
                continue
            found += 1
            inside = [*ast.walk(function)]
            assert any(isinstance(node, ast.Await | ast.AsyncFor) for node in inside), (
                f"{path.name}: {function.name}"
            )
            for node in inside:
                if isinstance(node, ast.Call):
                    name = node.func.attr if isinstance(node.func, ast.Attribute) else ast.unparse(node.func)
                    assert name not in BLOCKING, f"{path.name}: {function.name} calls {name}"
    assert found


def test_a_long_or_slow_body_is_refused_before_it_is_parsed(
    live: Live, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, long = "/webhooks", b"[" * (MAX_BODY + 1)
    headers = {"Content-Type": "application/json"}
    problem(live.http.post(path, content=long, headers=headers), 413, "request.too_large")
    problem(live.http.post(path, content=iter([long]), headers=headers), 413, "request.too_large")
    fits = b" " * (MAX_BODY - 2) + b"[]"
    problem(live.http.post(path, content=iter([fits]), headers=headers), 422, "request.invalid")
    monkeypatch.setattr(bodies, "SECONDS", 0.2)
    with socket.create_connection((live.host, live.port), timeout=30) as slow:
        slow.sendall(b"POST /webhooks HTTP/1.1\r\nHost: localhost\r\nContent-Length: 9\r\n\r\n{")
        assert slow.recv(1000).startswith(b"HTTP/1.1 408")
    problem(live.http.post(path, content=b"[" * 100_000, headers=headers), 400, "request.malformed")


def changed(document: dict[str, Any], path: str, value: Any = None) -> dict[str, Any]:
    """A copy in which what ``path`` (keys joined by >) leads to is another value, or gone."""
    copy = json.loads(json.dumps(document))
    *way, last = path.split(">")
    place = copy
    for key in way:
        place = place[int(key) if isinstance(place, list) else key]
    if value is None:
        del place[last]
    else:
        place[last] = value
    return dict(copy)


BREAKS = [
    ("paths>/jobs/{job_id}/logs", None, "is gone"),
    ("paths>/jobs>get", None, "is gone"),
    ("paths>/jobs>get>parameters", [], "no longer takes the query parameter limit"),
    ("paths>/jobs>get>parameters>0>required", True, "now requires"),
    ("paths>/jobs>get>parameters>0>schema>maximum", 50, "narrower maximum"),
    ("paths>/jobs>post>requestBody>content>multipart/form-data", None, "no longer takes multipart"),
    ("paths>/jobs/{job_id}/restart>post>requestBody>required", True, "now requires a body"),
    ("paths>/jobs/{job_id}/cancel>post>responses>202", None, "no longer answers 202"),
    ("paths>/jobs/{job_id}/render>get>responses>200>content>image/webp", None, "with image/webp"),
    ("components>schemas>JobView>properties>fraction", None, "no longer says fraction"),
    ("components>schemas>JobView>properties>fraction>type", "string", "may now be of type string"),
    ("components>schemas>JobOptions>properties>side>enum", ["left", "right"], "no longer takes auto, both"),
    ("components>schemas>LinkRequest>required", ["target", "seconds"], "now requires seconds"),
    ("components>schemas>Links>required", [], "no longer promises self"),
]


@pytest.mark.parametrize(("path", "value", "said"), BREAKS)
def test_a_breaking_change_is_noticed(path: str, value: Any, said: str) -> None:
    committed = json.loads((ROOT / "openapi" / "openapi.json").read_text())
    assert breaking_changes(committed, committed) == []
    found = breaking_changes(committed, changed(committed, path, value))
    assert any(said in change for change in found), found


def test_additions_break_nothing() -> None:
    committed = json.loads((ROOT / "openapi" / "openapi.json").read_text())
    for path, _, _ in BREAKS:
        if path.startswith("paths>/jobs/{job_id}/logs"):
            # What was not there before may come.
            assert breaking_changes(changed(committed, path), committed) == []
    more = changed(committed, "components>schemas>JobView>properties>mood", {"type": "string"})
    assert breaking_changes(committed, more) == []
    option = changed(committed, "components>schemas>JobOptions>properties>mood", {"type": "string"})
    assert breaking_changes(committed, option) == []


def test_the_documents_tables_are_not_stale() -> None:
    text = DOCUMENT.read_text()
    assert updated(text) == text, "run: python -m service.reference"
    for name in ("queued", "awaiting_upload", "worker.lost", "engine.timeout"):
        assert f"`{name}`" in text
    for path in json.loads(document())["paths"]:
        root = "/" + path.split("/")[1]
        assert root in text


def test_every_failure_of_a_video_is_in_the_document() -> None:
    """The engine's codes are found where it raises them, so that a new one cannot be forgotten."""
    written = DOCUMENT.read_text()
    codes = set()
    for path in (ROOT / "mass_engine").rglob("*.py"):
        codes |= set(re.findall(r'"(video\.[a-z_]+)"', path.read_text()))
    for code in codes - {"video.not_found", "video.one_hand"}:  # the command line's; a warning
        assert f"`{code}`" in written, code
