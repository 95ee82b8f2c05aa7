"""Looking at jobs, cancelling and deleting them."""

from __future__ import annotations

from pathlib import Path

import pytest

from service.jobs.housekeeping import purge_deleted, sweep_uploads
from service.jobs.leases import Heartbeat
from service.jobs.model import new_job_id
from tests.service.conftest import VIDEO, Live, problem, serve

NOT_IDS = ["nope", "%2e%2e", "..%2f..", "0" * 36, "%00", "\u2603", new_job_id(), "x" * 60]


def test_a_job_is_followed_from_queue_to_failure(live: Live) -> None:
    job_id = live.submit()
    seen = live.http.get(f"/jobs/{job_id}").json()
    assert seen["links"] == {
        "self": f"/jobs/{job_id}",
        "cancel": f"/jobs/{job_id}/cancel",
        "upload": None,
        "restart": None,
        **{name: f"/jobs/{job_id}/{name}" for name in ("events", "logs", "preview")},
        "render": None,
        "renders": None,
        "assets": None,
    }
    claim = live.services.store.claim(job_id)
    assert claim is not None
    live.services.store.report_progress(job_id, claim.token, "track", 0.25, 90.0, "frame 3 of 12")
    seen = live.http.get(f"/jobs/{job_id}").json()
    assert (seen["state"], seen["stage"], seen["fraction"]) == ("running", "track", 0.25)
    assert (seen["time_left"], seen["message"], seen["attempt"]) == (90.0, "frame 3 of 12", 1)
    live.services.store.fail(job_id, claim.token, "video.no_hand", "No hand was found.", "Show one hand.")
    seen = live.http.get(f"/jobs/{job_id}").json()
    assert seen["state"] == "failed"
    assert seen["error"] == {
        "code": "video.no_hand",
        "message": "No hand was found.",
        "advice": "Show one hand.",
        "stage": "track",
    }
    assert seen["links"]["cancel"] is None
    assert seen["finished_at"] >= seen["started_at"] >= seen["created_at"]
    assert claim.token not in str(seen)


def test_polling_with_the_etag_costs_nothing_until_something_changes(live: Live) -> None:
    job_id = live.submit()
    first = live.http.get(f"/jobs/{job_id}")
    held = {"If-None-Match": f'"other", {first.headers["etag"]}'}
    again = live.http.get(f"/jobs/{job_id}", headers=held)
    assert (again.status_code, again.content) == (304, b"")
    live.http.post(f"/jobs/{job_id}/cancel")
    changed = live.http.get(f"/jobs/{job_id}", headers=held)
    assert changed.status_code == 200
    assert changed.json()["state"] == "cancelled"


@pytest.mark.parametrize("job_id", NOT_IDS)
def test_an_unknown_job_is_404_everywhere(live: Live, job_id: str) -> None:
    for method, path in (
        ("GET", ""),
        ("DELETE", ""),
        ("POST", "/cancel"),
        ("POST", "/restart"),
        ("GET", "/render?pose=fist"),
        ("GET", "/assets"),
        ("GET", "/assets/report.json"),
    ):
        answer = live.http.request(method, f"/jobs/{job_id}{path}")
        assert answer.status_code == 404, (method, path, answer.text)
        assert answer.headers["content-type"] == "application/problem+json"


def test_lists_are_paged_newest_first(tmp_path: Path, live: Live) -> None:
    ids = [live.submit() for _ in range(3)]
    page = live.http.get("/jobs", params={"limit": 2}).json()
    assert [job["id"] for job in page["jobs"]] == ids[:0:-1]
    assert page["next"] == ids[1]
    page = live.http.get("/jobs", params={"limit": 1, "cursor": page["next"]}).json()
    assert [job["id"] for job in page["jobs"]] == ids[:1]


def test_lists_by_state(live: Live) -> None:
    job_id = live.submit()
    live.http.post(f"/jobs/{job_id}/cancel")
    newest = live.http.get("/jobs", params={"limit": 1, "state": ["cancelled", "failed"]}).json()["jobs"]
    assert [job["id"] for job in newest] == [job_id]
    queued = live.http.get("/jobs", params={"limit": 100, "state": "queued"}).json()["jobs"]
    assert {job["state"] for job in queued} <= {"queued"}


@pytest.mark.parametrize(
    "query", ["state=done", "limit=0", "limit=101", "limit=x", "cursor=x", "cursor=" + "x" * 70]
)
def test_bad_list_parameters(live: Live, query: str) -> None:
    body = problem(live.http.get(f"/jobs?{query}"), 422, "request.invalid")
    assert body["errors"]


def test_cancel_queued_then_again(live: Live) -> None:
    job_id = live.submit()
    for _ in range(2):
        answer = live.http.post(f"/jobs/{job_id}/cancel")
        assert (answer.status_code, answer.json()["state"]) == (200, "cancelled")
    done, _ = live.finished()
    problem(live.http.post(f"/jobs/{done}/cancel"), 409, "job.finished")


def test_cancel_running_tells_the_worker(live: Live) -> None:
    job_id = live.submit()
    claim = live.services.store.claim(job_id)
    assert claim is not None
    for _ in range(2):
        answer = live.http.post(f"/jobs/{job_id}/cancel")
        assert answer.status_code == 202
        assert answer.json()["state"] == "cancelling"
    assert live.services.store.heartbeat(job_id, claim.token) == Heartbeat.CANCEL
    live.services.store.finish_cancel(job_id, claim.token)
    assert live.http.get(f"/jobs/{job_id}").json()["state"] == "cancelled"


def test_delete_removes_every_byte(live: Live) -> None:
    before = live.files()
    job_id, _ = live.finished()
    live.http.get(f"/jobs/{job_id}/render").raise_for_status()
    assert live.files() != before
    answer = live.http.delete(f"/jobs/{job_id}")
    assert (answer.status_code, answer.content) == (204, b"")
    assert live.files() == before
    root = live.services.storage.root
    assert not (root / "uploads" / job_id).exists()
    assert not (root / "jobs" / job_id).exists()
    problem(live.http.get(f"/jobs/{job_id}"), 404, "job.not_found")
    problem(live.http.get(f"/jobs/{job_id}/render"), 404, "job.not_found")
    problem(live.http.delete(f"/jobs/{job_id}"), 404, "job.not_found")


def test_delete_while_running_hides_it_and_frees_the_disk_when_the_worker_stops(live: Live) -> None:
    before = live.files()
    job_id = live.submit()
    store, storage = live.services.store, live.services.storage
    claim = store.claim(job_id)
    assert claim is not None
    assert live.http.delete(f"/jobs/{job_id}").status_code == 204
    problem(live.http.get(f"/jobs/{job_id}"), 404, "job.not_found")
    # The worker still writes until it looks at its lease.
    (storage.attempt_dir(job_id, claim.artifact) / "report.json").write_text("late")
    assert purge_deleted(store, storage) == []
    assert store.heartbeat(job_id, claim.token) == Heartbeat.CANCEL
    assert not store.succeed(job_id, claim.token, claim.artifact)
    assert store.finish_cancel(job_id, claim.token)
    assert purge_deleted(store, storage) == [job_id]
    assert live.files() == before


def test_uploads_without_a_job_are_swept_and_others_are_not(live: Live) -> None:
    job_id = live.submit()
    store, storage = live.services.store, live.services.storage
    orphan = new_job_id()
    storage.begin_upload(orphan).write_bytes(VIDEO)
    assert sweep_uploads(store, storage, older_than=3600) == []
    assert sweep_uploads(store, storage, older_than=-60) == [orphan]
    assert live.http.get(f"/jobs/{job_id}").status_code == 200
    assert f"uploads/{job_id}/source" in live.files()


def test_a_restart_finishes_what_a_crash_left_and_keeps_the_jobs(live: Live, tmp_path: Path) -> None:
    settings = live.services.settings.model_copy(update={"data_dir": tmp_path, "orphan_upload_seconds": 1e-9})
    with serve(settings) as first:
        kept, deleted = first.submit(), first.submit()
        # As if the process had died between hiding the job and removing its files, and during an upload.
        first.services.store.delete(deleted)
        first.services.storage.begin_upload(new_job_id()).write_bytes(VIDEO)
        assert len(first.files()) == 3
    with serve(settings) as second:
        assert second.files() == [f"uploads/{kept}/source"]
        assert [job["id"] for job in second.http.get("/jobs").json()["jobs"]] == [kept]
