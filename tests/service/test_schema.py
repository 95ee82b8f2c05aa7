"""Schemathesis over the whole API: whatever is sent, the answer is one that the document declares."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import pytest
import schemathesis
from hypothesis import HealthCheck, given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from schemathesis.checks import not_a_server_error
from schemathesis.specs.openapi.checks import (
    content_type_conformance,
    response_headers_conformance,
    response_schema_conformance,
    status_code_conformance,
)

from service.openapi import document
from service.settings import Settings
from tests.service.conftest import Live, serve

CHECKS = (
    not_a_server_error,
    status_code_conformance,
    content_type_conformance,
    response_headers_conformance,
    response_schema_conformance,
)


@pytest.fixture(scope="module")
def there(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Live, dict[str, str]]]:
    """A service, and the names of things that exist in it."""
    settings = Settings(data_dir=tmp_path_factory.mktemp("schema"), min_free_bytes=0, max_open_uploads=0)
    with serve(settings) as live:
        tus = {"Tus-Resumable": "1.0.0", "Upload-Length": "50"}
        names = {
            "job_id": live.finished()[0],
            "upload_id": live.http.post("/uploads", headers=tus).headers["location"].rpartition("/")[2],
            "webhook_id": live.http.post("/webhooks", json={"url": "https://a.invalid/"}).json()["id"],
            "name": "report.json",
            "code": "video.empty",
        }
        yield live, names


OPERATIONS = [
    (method, path) for path, methods in json.loads(document())["paths"].items() for method in methods
]


@pytest.mark.parametrize(("method", "path"), OPERATIONS)
def test_every_answer_is_declared(method: str, path: str, there: tuple[Live, dict[str, str]]) -> None:
    live, names = there
    schemathesis.serializer.alias("application/offset+octet-stream", "application/octet-stream")
    schema = schemathesis.openapi.from_dict(json.loads(document()))

    @given(case=schema[path][method].as_strategy(), real=st.booleans())
    @hypothesis_settings(
        max_examples=15, deadline=None, derandomize=True, database=None, suppress_health_check=[*HealthCheck]
    )
    def run(case: Any, real: bool) -> None:
        # Some requests are about something that exists; what a DELETE would remove is kept for the others.
        if real and method != "delete":
            for name in case.path_parameters or {}:
                case.path_parameters[name] = names.get(name, "x")
        answer = case.call(base_url=f"http://{live.host}:{live.port}", timeout=30)
        # Whoever cannot do its work says so with 503: no worker runs here.
        checks = [check for check in CHECKS if answer.status_code != 503 or check is not not_a_server_error]
        case.validate_response(answer, checks=checks)

    run()
