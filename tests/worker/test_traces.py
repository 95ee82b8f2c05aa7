"""From the request to the engine: one trace, and log lines that say what they are about."""

from __future__ import annotations

import json

from tests.worker.api_process import api
from tests.worker.harness import Bench, wait_for

TRACE, SPAN = "4bf92f3577b34da6a3ce929d0e0e4736", "00f067aa0ba902b7"
TRACEPARENT = f"00-{TRACE}-{SPAN}-01"


def test_one_trace_goes_from_the_request_through_the_row_and_the_worker_to_the_engine() -> None:
    bench = Bench(log_format="json")
    try:
        worker = bench.worker()
        with api(bench) as running:
            video = running.video("traced", "environment")
            answer = running.http.post(
                "/jobs", files={"video": ("clip.mp4", video)}, headers={"traceparent": TRACEPARENT}
            )
            job_id = answer.json()["id"]
            job = bench.until(job_id, "succeeded")
        assert job.traceparent == TRACEPARENT
        assert job.artifact is not None
        seen = json.loads((bench.storage.artifact_path(job_id, job.artifact) / "tracks.json").read_text())
        assert seen["env"]["TRACEPARENT"] == TRACEPARENT
        wait_for("the worker has said so", lambda: "attempt 1 succeeded" in worker.log)
        lines = [json.loads(line) for line in worker.log.splitlines() if line.startswith("{")]
        about_it = [line for line in lines if line.get("job") == job_id]
        assert {line["trace"] for line in about_it} == {TRACE}
        assert {line["part"] for line in lines} == {"worker"}
        assert len(about_it) >= 2
    finally:
        bench.close()


def test_warnings_of_the_engine_stand_on_the_row_and_their_words_not_in_the_log(bench: Bench) -> None:
    worker = bench.worker()
    job_id = bench.submit("canary", canary="what it saw")
    job = bench.until(job_id, "succeeded")
    assert job.warnings == [{"code": "w", "message": "what it saw", "advice": ""}]
    assert "engine" in worker.log
    assert "what it saw" not in worker.log
