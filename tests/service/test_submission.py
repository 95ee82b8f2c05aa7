"""The same request twice, and a job made from another one."""

from __future__ import annotations

import pytest

from service.jobs.idempotency import Reservation
from service.jobs.model import LOCAL, new_job_id
from tests.service.conftest import VIDEO, Live, problem


def post(live: Live, key: str, video: bytes = VIDEO, options: str = "{}"):  # type: ignore[no-untyped-def]
    files = {"video": ("v", video)}
    return live.http.post("/jobs", files=files, data={"options": options}, headers={"Idempotency-Key": key})


def test_a_repeated_request_makes_no_second_job(live: Live) -> None:
    key = new_job_id()
    first = post(live, key, options='{"side": "left"}')
    assert first.status_code == 202
    assert "Idempotency-Replayed" not in first.headers
    files = live.files()
    again = post(live, f'"{key}"', options='{ "side":"left", "seed": 0 }')
    assert (again.status_code, again.json()["id"]) == (202, first.json()["id"])
    assert again.headers["Idempotency-Replayed"] == "true"
    assert again.headers["Location"] == first.headers["Location"]
    assert live.files() == files


@pytest.mark.parametrize(("video", "options"), [(VIDEO + b"x", "{}"), (VIDEO, '{"seed": 1}')])
def test_a_key_used_for_another_request_is_refused(live: Live, video: bytes, options: str) -> None:
    key = new_job_id()
    assert post(live, key).status_code == 202
    files = live.files()
    problem(post(live, key, video, options), 422, "idempotency.mismatch")
    assert live.files() == files


def test_a_key_in_use_is_refused_until_its_request_ends(live: Live) -> None:
    key = new_job_id()
    held = live.services.keys.reserve(LOCAL, key)
    assert isinstance(held, Reservation)
    answer = post(live, key)
    problem(answer, 409, "idempotency.in_progress")
    assert int(answer.headers["Retry-After"]) > 0
    live.services.keys.release(held)
    assert post(live, key).status_code == 202


def test_a_failed_request_leaves_its_key_free(live: Live) -> None:
    key = new_job_id()
    problem(post(live, key, b"not a video at all"), 415, "video.unsupported_container")
    assert post(live, key).status_code == 202


def test_the_key_of_a_deleted_job_makes_no_new_one(live: Live) -> None:
    key = new_job_id()
    job_id = post(live, key).json()["id"]
    live.http.delete(f"/jobs/{job_id}")
    problem(post(live, key), 404, "job.not_found")


@pytest.mark.parametrize("key", ["", "a b", "x" * 200])
def test_bad_keys(live: Live, key: str) -> None:
    problem(post(live, key), 422, "request.invalid")


def test_a_restart_uses_the_video_again_with_other_options(live: Live) -> None:
    first = live.http.post(
        "/jobs", files={"video": VIDEO}, data={"options": '{"seed": 5, "max_frames": 50, "side": "both"}'}
    ).json()
    problem(live.http.post(f"/jobs/{first['id']}/restart"), 409, "job.unfinished")
    live.http.post(f"/jobs/{first['id']}/cancel")
    wish = {"from_stage": "fit", "options": {"preset": "draft", "max_frames": None}}
    answer = live.http.post(f"/jobs/{first['id']}/restart", json=wish)
    assert answer.status_code == 202, answer.text
    second = answer.json()
    assert second["id"] != first["id"]
    assert second["restarted_from"] == first["id"]
    assert (second["options"]["seed"], second["options"]["preset"]) == (5, "draft")
    assert (second["options"]["max_frames"], second["options"]["side"]) == (None, "both")
    # Either can be removed; the other keeps its bytes.
    assert live.http.delete(f"/jobs/{first['id']}").status_code == 204
    claim = live.services.store.claim(second["id"])
    assert claim is not None
    assert (claim.restarted_from, claim.from_stage) == (first["id"], "fit")
    assert live.services.storage.source(claim.video).read_bytes() == VIDEO


def test_a_restart_from_a_stage_takes_the_checkpoint_along(live: Live) -> None:
    job_id = live.submit()
    store, storage = live.services.store, live.services.storage
    claim = store.claim(job_id)
    assert claim is not None
    checkpoint = storage.attempt_dir(job_id, claim.artifact) / "checkpoint"
    (checkpoint / "deep").mkdir(parents=True)
    (checkpoint / "deep" / "state").write_bytes(b"how far it was")
    (checkpoint / "link").symlink_to("/etc/passwd")
    store.fail(job_id, claim.token, "c", "m", "a")
    plain = live.http.post(f"/jobs/{job_id}/restart").json()["id"]
    assert not [file for file in live.files() if plain in file and "checkpoint" in file]
    headers = {"Idempotency-Key": new_job_id()}
    wish = {"from_stage": "fit"}
    again = live.http.post(f"/jobs/{job_id}/restart", json=wish, headers=headers).json()["id"]
    files = live.files()
    copied = [file for file in files if again in file and "checkpoint" in file]
    assert copied == [f"jobs/{again}/0-restart/checkpoint/deep/state"]
    live.http.post(f"/jobs/{job_id}/restart", json=wish, headers=headers)
    assert live.files() == files  # a repeated request leaves nothing behind
    for each in (plain, again, job_id):
        live.http.delete(f"/jobs/{each}")
    assert not [file for file in live.files() if again in file]


def test_a_restart_is_idempotent_and_checked(live: Live) -> None:
    job_id = live.submit()
    live.http.post(f"/jobs/{job_id}/cancel")
    headers = {"Idempotency-Key": new_job_id()}
    path = f"/jobs/{job_id}/restart"
    ids = {live.http.post(path, headers=headers).json()["id"] for _ in range(2)}
    assert len(ids) == 1
    problem(live.http.post(path, headers=headers, json={"options": {"seed": 1}}), 422, "idempotency.mismatch")
    problem(live.http.post(path, json={"options": {"sede": 1}}), 422, "options.invalid")
    problem(live.http.post(path, json={"options": {"side": "none"}}), 422, "options.invalid")
    problem(live.http.post(path, json={"from_stage": "lunch"}), 422, "request.invalid")
    problem(live.http.post(path, json={"from": "fit"}), 422, "request.invalid")


def test_a_restart_without_the_video_is_refused(live: Live) -> None:
    job_id = live.submit()
    live.http.post(f"/jobs/{job_id}/cancel")
    live.services.storage.discard_upload(job_id)
    files = live.files()
    problem(live.http.post(f"/jobs/{job_id}/restart"), 409, "job.no_video")
    assert live.files() == files


def test_the_trace_of_the_request_goes_with_the_job(live: Live) -> None:
    trace = "00-4bf92f3577b34da6a3ce929d0e0e4736-00f067aa0ba902b7-01"
    sent = live.http.post("/jobs", files={"video": VIDEO}, headers={"traceparent": trace}).json()
    claim = live.services.store.claim(sent["id"])
    assert claim is not None
    assert claim.traceparent == trace
    claim = live.services.store.claim(live.submit())
    assert claim is not None
    assert claim.traceparent is not None
    assert len(claim.traceparent) == len(trace)
