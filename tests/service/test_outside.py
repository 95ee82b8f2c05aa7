"""What is seen from outside: health, readiness, figures, log lines."""

from __future__ import annotations

import io
import json
import logging
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from prometheus_client.parser import text_string_to_metric_families
from pydantic import SecretStr

from service.access.keys import KeyStore, Scope
from service.embedded import EmbeddedBroker
from service.jobs.store import create_store
from service.logs import about, configure, trace_of
from service.metrics import own_port
from service.pulse import pulse_path
from service.settings import Settings
from service.storage import Storage
from tests.service.conftest import VIDEO, Live, problem, serve


def figures(live: Live) -> dict[tuple[str, str], float]:
    answer = live.http.get("/metrics")
    assert answer.status_code == 200
    assert answer.headers["content-type"].startswith("text/plain")
    return {
        (sample.name, next(iter(sample.labels.values()), "")): sample.value
        for family in text_string_to_metric_families(answer.text)
        for sample in family.samples
    }


def test_readiness_names_the_parts_in_trouble(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    def wrong() -> set[str]:
        answer = live.http.get("/readyz")
        if answer.status_code == 200:
            return set()
        body: Any = problem(answer, 503, "service.not_ready")
        return {error["field"] for error in body["errors"]}

    assert live.http.get("/healthz").status_code == 200
    assert wrong() == {"broker", "workers"}
    data = live.services.settings.data_dir
    alive = pulse_path(data)
    alive.parent.mkdir(exist_ok=True)
    alive.touch()
    assert wrong() == {"broker"}
    monkeypatch.setattr(Storage, "has_room", lambda self, incoming=0: False)
    assert wrong() == {"broker", "disk"}
    alive.unlink()


def test_a_whole_service_is_ready(tmp_path: Path) -> None:
    broker = EmbeddedBroker(tmp_path)
    with broker, serve(Settings(data_dir=tmp_path, redis_url=broker.url, min_free_bytes=0)) as live:
        alive = pulse_path(tmp_path)
        alive.parent.mkdir(exist_ok=True)
        alive.touch()
        answer = live.http.get("/readyz")
        assert answer.json() == {"status": "ready", "checks": ["database", "broker", "disk", "workers"]}
        assert live.http.get("/capabilities").json()["workers"] == 1


def test_figures_of_jobs_stages_failures_and_pictures(tmp_path: Path, live: Live) -> None:
    settings = live.services.settings.model_copy(update={"data_dir": tmp_path})
    with serve(settings) as fresh:
        assert figures(fresh)["mass_jobs", "queued"] == 0
        job_id, waiting = fresh.submit(), fresh.submit()
        now = [fresh.services.store._clock()]
        store = create_store(settings, lambda: now[0])
        claim = store.claim(job_id)
        assert claim is not None
        for stage, seconds in (("read", 5.0), ("fit", 20.0)):
            store.report_progress(job_id, claim.token, stage, 0.1)
            now[0] += seconds
        store.fail(job_id, claim.token, "video.no_hand", "m", "a")
        store.delete(job_id)
        store.close()
        done, _ = fresh.finished()
        for _ in range(2):
            fresh.http.get(f"/jobs/{done}/render?width=32&height=32").raise_for_status()
        fresh.http.get(f"/jobs/{done}/render?pose=unknown")
        seen = figures(fresh)
        assert seen["mass_jobs", "queued"] == 1
        assert seen["mass_jobs", "succeeded"] == 1
        assert 0 <= seen["mass_queue_age_seconds", ""] < 600
        assert seen["mass_job_failures_total", "video.no_hand"] == 1  # also when it has been deleted
        assert (seen["mass_stage_seconds_total", "read"], seen["mass_stage_runs_total", "read"]) == (5.0, 1.0)
        assert seen["mass_stage_seconds_total", "fit"] == 20.0
        assert (seen["mass_renders_total", "drawn"], seen["mass_renders_total", "cached"]) == (1.0, 1.0)
        assert seen["mass_renders_total", "render.refused"] == 1.0
        assert seen["mass_render_seconds_count", ""] == 1.0
        text = fresh.http.get("/metrics").text
        assert 'mass_http_requests_total{method="GET",route="/jobs/{job_id}/render",status="200"} 2.0' in text
        assert waiting not in text
        assert job_id not in text


def test_figures_need_an_administrators_key(tmp_path: Path) -> None:
    with serve(Settings(data_dir=tmp_path, auth="keys", min_free_bytes=0)) as live:
        keys = KeyStore(live.services.store.engine)
        problem(live.http.get("/metrics"), 401, "access.key")
        for scope, status in ((Scope.WRITE, 403), (Scope.ADMIN, 200)):
            key = keys.create("ann", [scope])
            answer = live.http.get("/metrics", headers={"Authorization": f"Bearer {key}"})
            assert answer.status_code == status


def test_figures_on_a_port_of_their_own(tmp_path: Path) -> None:
    settings = Settings(data_dir=tmp_path, auth="keys", min_free_bytes=0, metrics_port=0)
    with serve(settings) as live:
        live.http.headers["Authorization"] = (
            f"Bearer {KeyStore(live.services.store.engine).create('root', [Scope.ADMIN])}"
        )
        problem(live.http.get("/metrics"), 404, "request.not_found")
        port = live.app.state.metrics_port
        assert port not in (0, live.port)
        text = httpx.get(f"http://127.0.0.1:{port}/metrics", trust_env=False).text
        assert 'mass_jobs{state="queued"} 0.0' in text
        with pytest.raises(OSError, match="in use"), own_port(live.services.metrics, "127.0.0.1", port):
            pass
    with pytest.raises(httpx.ConnectError):
        httpx.get(f"http://127.0.0.1:{port}/metrics", trust_env=False)


@pytest.fixture
def lines() -> Iterator[io.StringIO]:
    root = logging.getLogger()
    before, level = root.handlers[:], root.level
    stream = io.StringIO()
    configure("api", "json", stream)
    yield stream
    root.handlers[:] = before
    root.setLevel(level)


def test_log_lines_are_json_and_say_the_job_and_the_trace(live: Live, lines: io.StringIO) -> None:
    trace = "4bf92f3577b34da6a3ce929d0e0e4736"
    job_id = live.submit()
    headers = {"traceparent": f"00-{trace}-00f067aa0ba902b7-01"}
    live.http.get(f"/jobs/{job_id}?secret=hidden", headers=headers)
    live.http.get("/healthz")
    live.http.get("/no%0Asuch%1b[31m")
    said = [json.loads(line) for line in lines.getvalue().splitlines()]
    (look,) = (line for line in said if line.get("trace") == trace)
    assert look["job"] == job_id
    assert (look["method"], look["path"], look["status"], look["part"]) == (
        "GET",
        f"/jobs/{job_id}",
        200,
        "api",
    )
    assert "hidden" not in lines.getvalue()
    assert not [line for line in said if line.get("path") == "/healthz"]
    assert "\x1b" not in lines.getvalue()


def test_no_secret_gets_into_a_log(tmp_path: Path, lines: io.StringIO) -> None:
    settings = Settings(
        data_dir=tmp_path, auth="keys", min_free_bytes=0, secret=SecretStr("canary-of-the-service")
    )
    with serve(settings) as live:
        key = KeyStore(live.services.store.engine).create("ann", [Scope.WRITE])
        live.http.headers["Authorization"] = f"Bearer {key}"
        job_id = live.finished()[0]
        link = live.http.post(f"/jobs/{job_id}/links", json={"target": "assets/report.json"}).json()["href"]
        assert live.http.get(link, headers={"Authorization": ""}).status_code == 200
        hook = live.http.post("/webhooks", json={"url": "https://hook.invalid/canary-path"}).json()
        live.http.post("/jobs", files={"video": ("canary-name.mp4", VIDEO)})
        signature = re.search("signature=([0-9a-f]+)", link)
        assert signature is not None
    text = lines.getvalue()
    assert job_id in text
    for secret in (key, key.split("_")[2], signature[1], hook["secret"], "canary"):
        assert secret not in text
    assert "canary" not in repr(settings)


def test_text_lines_name_what_they_do_not_say_yet() -> None:
    stream = io.StringIO()
    root = logging.getLogger()
    before, level = root.handlers[:], root.level
    try:
        configure("worker", "text", stream)
        with about(job="j1", trace=None), about(trace="t1"):
            logging.getLogger("x").info("job %s: starts", "j1")
        logging.getLogger("x").warning("plain")
    finally:
        root.handlers[:] = before
        root.setLevel(level)
    first, second = stream.getvalue().splitlines()
    assert first.endswith("INFO job j1: starts trace=t1")
    assert second.endswith("WARNING plain")
    assert trace_of("00-x-y-z") is None
    assert trace_of(None) is None
