"""Following a job: events with replay, log lines, previews, over real connections."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from service.settings import Settings
from service.watching import StreamSlots
from tests.service.conftest import Live, problem, serve


@dataclass
class Event:
    id: int
    kind: str
    data: dict[str, Any]


def events(lines: Iterator[str]) -> Iterator[Event]:
    fields: dict[str, str] = {}
    for line in lines:
        if line:
            key, _, value = line.partition(":")
            fields[key] = value.strip()
        else:
            if "data" in fields:
                yield Event(int(fields["id"]), fields["event"], json.loads(fields["data"]))
            fields = {}


@contextmanager
def stream(live: Live, job_id: str, **headers: str) -> Iterator[Iterator[Event]]:
    with live.http.stream("GET", f"/jobs/{job_id}/events", headers=headers) as answer:
        assert answer.status_code == 200
        assert answer.headers["content-type"].startswith("text/event-stream")
        assert answer.headers["cache-control"] == "no-cache"
        yield events(answer.iter_lines())


def run(live: Live, job_id: str, steps: int = 4) -> str:
    """Claim the job and report progress; returns the token."""
    claim = live.services.store.claim(job_id)
    assert claim is not None
    for step in range(steps):
        live.services.store.report_progress(job_id, claim.token, "fit", 0.1 * (step + 1), 9.0, f"s{step}")
    return claim.token


def test_a_watcher_sees_everything_as_it_happens_and_the_stream_ends(live: Live) -> None:
    job_id = live.submit()
    with stream(live, job_id) as seen:
        assert next(seen).data["state"] == "queued"
        token = run(live, job_id)
        got = [next(seen) for _ in range(5)]
        assert [event.kind for event in got] == ["state"] + ["progress"] * 4
        live.services.store.fail(job_id, token, "video.no_hand", "No hand.", "Show one.")
        rest = [*seen]
    assert [event.data["state"] for event in rest] == ["failed"]
    assert rest[0].data["error"] == {"code": "video.no_hand", "message": "No hand.", "advice": "Show one."}
    assert [event.id for event in got] == [2, 3, 4, 5, 6]
    fractions = [event.data["fraction"] for event in got]
    assert fractions == sorted(fractions)


@pytest.mark.parametrize("by", ["header", "query"])
def test_replay_goes_on_after_the_last_event_seen(live: Live, by: str) -> None:
    job_id = live.submit()
    token = run(live, job_id)
    live.services.store.request_cancel(job_id)
    live.services.store.finish_cancel(job_id, token)
    with stream(live, job_id) as seen:
        whole = [*seen]
    assert [event.id for event in whole] == [*range(1, 9)]
    assert [event.data["state"] for event in whole][-2:] == ["cancelling", "cancelled"]
    for last in range(8):
        headers = {"Last-Event-ID": str(last)} if by == "header" else {}
        query = f"?after={last}" if by == "query" else ""
        with live.http.stream("GET", f"/jobs/{job_id}/events{query}", headers=headers) as answer:
            assert [*events(answer.iter_lines())] == whole[last:]
    ended = live.http.get(f"/jobs/{job_id}/events", headers={"Last-Event-ID": "8"})
    assert (ended.status_code, ended.content) == (204, b"")


def test_a_stream_survives_its_server(live: Live, tmp_path: Path) -> None:
    settings = live.services.settings.model_copy(update={"data_dir": tmp_path})
    with serve(settings) as first:
        job_id = first.submit()
        token = run(first, job_id, 2)
        with stream(first, job_id) as seen:
            got = [next(seen) for _ in range(4)]
    with serve(settings) as second:
        second.services.store.fail(job_id, token, "c", "m", "a")
        with stream(second, job_id, **{"Last-Event-ID": str(got[-1].id)}) as seen:
            assert [event.data["state"] for event in seen] == ["failed"]


def test_the_stream_of_a_deleted_job_ends(live: Live) -> None:
    job_id = live.submit()
    run(live, job_id, 1)
    with stream(live, job_id) as seen:
        next(seen)
        live.http.delete(f"/jobs/{job_id}")
        states = [event.data["state"] for event in seen]
    assert states[-1] in ("running", "cancelling")


@pytest.mark.parametrize("last", ["x", "-1", "1.5", "\xb2", "9" * 30])
def test_bad_event_ids(live: Live, last: str) -> None:
    job_id = live.submit()
    headers = {b"Last-Event-ID": last.encode("latin-1")}
    problem(live.http.get(f"/jobs/{job_id}/events", headers=headers), 422, "request.invalid")


def test_streams_are_counted(live: Live, tmp_path: Path) -> None:
    settings: Settings = live.services.settings.model_copy(update={"data_dir": tmp_path, "max_streams": 1})
    with serve(settings) as small:
        job_id = small.submit()
        with stream(small, job_id) as seen:
            next(seen)
            answer = small.http.get(f"/jobs/{job_id}/events")
            problem(answer, 429, "events.too_many")
            assert int(answer.headers["Retry-After"]) > 0
        waited = threading.Event()
        for _ in range(1000):
            if small.services.streams.room("local"):
                break
            waited.wait(0.02)
        assert small.services.streams.room("local")
    slots = StreamSlots(1)
    with slots.held("ann"):
        assert not slots.room("ann")
        assert slots.room("bob")


def test_small_steps_are_not_all_kept(live: Live) -> None:
    job_id = live.submit()
    claim = live.services.store.claim(job_id)
    assert claim is not None
    for step in range(200):
        live.services.store.report_progress(job_id, claim.token, "fit", step / 2000)
    job = live.services.store.get(job_id)
    assert job is not None
    assert job.fraction == 0.0995
    assert 10 < job.event_seq < 30


def test_logs_are_read_from_where_one_left_off(live: Live) -> None:
    job_id = live.submit()
    assert live.http.get(f"/jobs/{job_id}/logs").json() == {"lines": [], "next": 0}
    token = run(live, job_id, 0)
    live.services.store.log(job_id, token, ["stage read", "<script>\x1b[31m", "stage track"])
    page = live.http.get(f"/jobs/{job_id}/logs", params={"limit": 2}).json()
    assert [line["text"] for line in page["lines"]] == ["stage read", "<script>[31m"]
    rest = live.http.get(f"/jobs/{job_id}/logs", params={"after": page["next"]}).json()
    assert [(line["text"], line["attempt"]) for line in rest["lines"]] == [("stage track", 1)]
    again = live.http.get(f"/jobs/{job_id}/logs", params={"after": rest["next"]}).json()
    assert again == {"lines": [], "next": rest["next"]}


def test_a_preview_while_it_runs_and_after(live: Live) -> None:
    job_id = live.submit()
    path = f"/jobs/{job_id}/preview"
    problem(live.http.get(path), 404, "preview.none")
    store, storage = live.services.store, live.services.storage
    claim = store.claim(job_id)
    assert claim is not None
    problem(live.http.get(path), 404, "preview.none")
    folder = storage.attempt_dir(job_id, claim.artifact) / "previews"
    folder.mkdir()
    (folder / "live.jpg").write_bytes(b"\xff\xd8 one")
    first = live.http.get(path)
    assert (first.content, first.headers["content-type"]) == (b"\xff\xd8 one", "image/jpeg")
    same = live.http.get(path, headers={"If-None-Match": first.headers["etag"]})
    assert (same.status_code, same.content) == (304, b"")
    (folder / "live.jpg").write_bytes(b"\xff\xd8 two")
    assert live.http.get(path, headers={"If-None-Match": first.headers["etag"]}).content == b"\xff\xd8 two"
    (folder / "live.jpg").unlink()
    (folder / "live.jpg").symlink_to("/etc/passwd")
    problem(live.http.get(path), 404, "preview.none")
    done, _ = live.finished(**{"previews/pose-rest.png": b"\x89PNG rest"})
    assert live.http.get(f"/jobs/{done}/preview").content == b"\x89PNG rest"
