"""Motions of a finished hand: small jobs of their own that go when the hand goes."""

from __future__ import annotations

from typing import Any

import pytest

from service.jobs.housekeeping import purge_deleted
from service.jobs.model import JobKind, new_job_id
from service.storage import OUTPUTS
from tests.service.conftest import Live, problem


def test_a_motion_is_a_job_of_its_own(live: Live) -> None:
    parent, _ = live.finished(**{"avatar.safetensors": b"the avatar"})
    wish = {"kind": "poses", "poses": [" REST ", "frame:007"], "camera": "orbit:370,0", "format": "webp"}
    answer = live.http.post(f"/jobs/{parent}/renders", json=wish)
    assert answer.status_code == 202, answer.text
    body = answer.json()
    assert answer.headers["location"] == body["links"]["self"]
    assert (body["kind"], body["parent"], body["state"], body["options"]) == (
        "render",
        parent,
        "queued",
        None,
    )
    assert (body["motion"]["poses"], body["motion"]["camera"]) == (["rest", "frame:7"], "orbit:10,0")
    assert body["links"]["render"] is body["links"]["restart"] is None
    store, storage = live.services.store, live.services.storage
    claim = store.claim(body["id"])
    assert claim is not None
    assert (claim.kind, claim.options["poses"]) == (JobKind.RENDER, ["rest", "frame:7"])
    assert storage.source(claim.video).read_bytes() == b"the avatar"
    (storage.attempt_dir(body["id"], claim.artifact) / "motion.webp").write_bytes(b"RIFF")
    storage.publish(body["id"], claim.artifact)
    assert store.succeed(body["id"], claim.token, claim.artifact)
    file = live.http.get(f"/jobs/{body['id']}/assets/motion.webp")
    assert (file.content, file.headers["content-type"]) == (b"RIFF", "image/webp")
    problem(live.http.get(f"/jobs/{body['id']}/render"), 409, "job.no_result")
    problem(live.http.post(f"/jobs/{body['id']}/renders"), 409, "job.no_result")
    problem(live.http.post(f"/jobs/{body['id']}/restart"), 409, "job.no_video")
    listed = live.http.get(f"/jobs/{parent}/renders").json()["jobs"]
    assert [job["id"] for job in listed] == [body["id"]]
    assert body["id"] not in {job["id"] for job in live.http.get("/jobs?limit=100").json()["jobs"]}


def test_motions_go_with_their_hand(live: Live) -> None:
    before = live.files()
    parent, _ = live.finished()
    running = live.http.post(f"/jobs/{parent}/renders").json()["id"]
    claim = live.services.store.claim(running)
    assert claim is not None
    queued = live.http.post(f"/jobs/{parent}/renders", json={"poses": ["fist"]}).json()["id"]
    assert live.http.delete(f"/jobs/{parent}").status_code == 204
    for job_id in (running, queued):
        problem(live.http.get(f"/jobs/{job_id}"), 404, "job.not_found")
    assert live.services.store.finish_cancel(running, claim.token)
    assert purge_deleted(live.services.store, live.services.storage) == [running]
    assert live.files() == before


def test_the_same_request_makes_one_motion(live: Live) -> None:
    parent, _ = live.finished()
    headers, path = {"Idempotency-Key": new_job_id()}, f"/jobs/{parent}/renders"
    ids = {live.http.post(path, headers=headers).json()["id"] for _ in range(2)}
    assert len(ids) == 1
    problem(live.http.post(path, headers=headers, json={"fps": 10}), 422, "idempotency.mismatch")


def test_either_hand_can_move(live: Live) -> None:
    both, _ = live.finished(
        **{f"{hand}/{name}": b"x" + hand.encode() for hand in ("left", "right") for name in OUTPUTS}
    )
    made = live.http.post(f"/jobs/{both}/renders?hand=left").json()["id"]
    claim = live.services.store.claim(made)
    assert claim is not None
    assert live.services.storage.source(claim.video).read_bytes() == b"xleft"
    problem(live.http.post(f"/jobs/{made}/renders?hand=left"), 409, "job.no_result")


@pytest.mark.parametrize(
    ("wish", "code"),
    [
        ({"speed": 1}, "request.invalid"),
        ({"poses": []}, "request.invalid"),
        ({"poses": ["rest"] * 201}, "request.invalid"),
        ({"poses": ["../x"]}, "pose.invalid"),
        ({"poses": ["1,2"]}, "pose.invalid"),
        ({"camera": "/etc/passwd"}, "camera.invalid"),
        ({"camera": "source"}, "camera.invalid"),
        ({"width": 600, "height": 601}, "render.too_large"),
        ({"seconds": 30, "fps": 60}, "render.too_large"),
        ({"kind": "poses", "poses": ["rest"] * 20, "between": 100}, "render.too_large"),
        ({"width": 1e9}, "request.invalid"),
        ({"fps": 0}, "request.invalid"),
    ],
)
def test_bad_motions(live: Live, wish: dict[str, Any], code: str) -> None:
    parent, _ = live.finished()
    before = live.files()
    problem(live.http.post(f"/jobs/{parent}/renders", json=wish), 422, code)
    assert live.files() == before


def test_a_job_without_a_hand_has_no_motions(live: Live) -> None:
    job_id = live.submit()
    problem(live.http.post(f"/jobs/{job_id}/renders"), 409, "job.not_ready")
    live.http.post(f"/jobs/{job_id}/cancel")
    problem(live.http.post(f"/jobs/{job_id}/renders"), 409, "job.no_result")
