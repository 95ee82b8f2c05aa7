"""The API's document, the page, the guard at the door, and rules about the code itself."""

from __future__ import annotations

import ast
import json
import re
import subprocess
import sys
from pathlib import Path
from typing import get_args

import pytest
from openapi_spec_validator import validate

from service.openapi import document
from service.pictures import Channel
from service.problems import Kind
from tests.service.conftest import VIDEO, Live, problem

ROOT = Path(__file__).parents[2]


def test_the_committed_document_is_not_stale() -> None:
    committed = (ROOT / "openapi" / "openapi.json").read_text()
    assert committed == document(), "run: python -m service.openapi > openapi/openapi.json"


def test_the_document_is_valid_and_every_error_in_it_is_a_problem() -> None:
    parsed = json.loads(document())
    validate(parsed)
    operations = [operation for path in parsed["paths"].values() for operation in path.values()]
    names = [operation["operationId"] for operation in operations]
    assert len(set(names)) == len(names)
    assert all(name.isidentifier() for name in names)
    assert "HTTPValidationError" not in json.dumps(parsed)
    for operation in operations:
        assert operation["description"]
        errors = {status: body for status, body in operation["responses"].items() if status >= "400"}
        assert "500" in errors
        for body in errors.values():
            assert set(body["content"]) == {"application/problem+json"}
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
    assert body["max_upload_bytes"] == live.services.settings.max_upload_bytes
    assert body["max_render_pixels"] == live.services.settings.max_render_pixels
    assert body["channels"] == list(get_args(Channel))


def test_the_page_offers_every_channel(live: Live) -> None:
    assert re.findall(r'<option value="(\w+)"', live.http.get("/").text) == list(get_args(Channel))


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
