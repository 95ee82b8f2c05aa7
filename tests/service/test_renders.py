"""Pictures through HTTP, and the pool of processes behind them."""

from __future__ import annotations

import os
import signal
import socket
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from functools import partial
from pathlib import Path
from typing import get_args

import cv2
import httpx
import numpy as np
import psutil
import pytest
from numpy.typing import NDArray

import mass_engine.channels
from service.pictures import Channel, View
from service.rendering import RenderPool, RenderRefusedError, load_avatar
from service.storage import OUTPUTS, missing_outputs
from tests.engine.avatars import small_avatar
from tests.service.conftest import Live, problem
from tests.service.fakes import load
from tests.worker.harness import wait_for

CHANNELS = get_args(Channel)


@pytest.fixture(scope="module")
def job(live: Live) -> tuple[str, Path]:
    return live.finished()


def get(live: Live, job_id: str, **query: str | int) -> httpx.Response:
    return live.http.get(f"/jobs/{job_id}/render", params=query)


def pixels(answer: httpx.Response) -> NDArray[np.uint8]:
    assert answer.status_code == 200, answer.text
    image = cv2.imdecode(np.frombuffer(answer.content, np.uint8), cv2.IMREAD_UNCHANGED)
    assert image is not None
    return image.astype(np.uint8)


def loads(folder: Path) -> list[str]:
    return (folder / "loads").read_text().split()


def test_the_picture_depends_on_pose_camera_and_size(live: Live, job: tuple[str, Path]) -> None:
    rest = pixels(get(live, job[0], pose="rest", width=64, height=48))
    fist = pixels(get(live, job[0], pose="fist", width=64, height=48))
    turned = pixels(get(live, job[0], pose="rest", camera="orbit:30,10,0.5", width=64, height=48))
    assert rest.shape == fist.shape == turned.shape == (48, 64, 4)
    assert not np.array_equal(rest, fist)
    assert not np.array_equal(rest, turned)
    assert (rest[:, :32, 3] == 0).all()
    assert (rest[:, 32:, 3] == 255).all()
    assert pixels(get(live, job[0])).shape == (512, 512, 4)


def test_the_picture_depends_on_the_channel(live: Live, job: tuple[str, Path]) -> None:
    pictures = {name: pixels(get(live, job[0], width=64, height=48, channel=name)) for name in CHANNELS}
    assert len({picture.tobytes() for picture in pictures.values()}) == len(CHANNELS) == 6
    assert np.array_equal(pixels(get(live, job[0], width=64, height=48)), pictures["rgb"])
    plain, depth = (get(live, job[0], channel=name).headers["etag"] for name in ("rgb", "depth"))
    assert plain != depth
    assert get(live, job[0]).headers["etag"] == plain


def test_either_hand_of_a_job_for_both(live: Live, job: tuple[str, Path]) -> None:
    both, _ = live.finished(
        **{f"{hand}/{name}": b"x" + hand.encode() for hand in ("left", "right") for name in OUTPUTS}
    )
    pictures = {hand: get(live, both, hand=hand).content for hand in ("left", "right")}
    assert len(set(pictures.values())) == 2
    assert get(live, both).content == pictures["right"]
    names = {asset["name"] for asset in live.http.get(f"/jobs/{both}/assets").json()["assets"]}
    assert {"left/avatar.safetensors", "right/surfels.ply"} < names
    assert live.http.get(f"/jobs/{both}/assets/left/surfels.ply").content == b"xleft"
    problem(get(live, job[0], hand="left"), 404, "render.no_hand")


def test_what_an_attempt_for_both_hands_must_leave(tmp_path: Path) -> None:
    assert missing_outputs(tmp_path) == [*OUTPUTS, "report.json"]
    (tmp_path / "right").mkdir()
    for name in OUTPUTS:
        (tmp_path / "right" / name).touch()
    assert missing_outputs(tmp_path) == ["report.json"]
    (tmp_path / "left").mkdir()
    assert missing_outputs(tmp_path) == [*(f"left/{name}" for name in OUTPUTS), "report.json"]


def test_the_engine_makes_every_channel(tmp_path: Path) -> None:
    """The names here are the engine's, and its pictures are what comes out."""
    assert CHANNELS == mass_engine.channels.CHANNELS
    avatar = small_avatar()
    avatar.save(tmp_path / "avatar.safetensors")
    loaded = load_avatar(tmp_path / "avatar.safetensors")
    for name in CHANNELS:
        picture = loaded.render("fist", "orbit:20,0", 40, 32, name)
        levels = picture.astype(int) - avatar.render("fist", "orbit:20,0", 40, 32, name)
        assert np.abs(levels).max() <= 3  # the last bit of a sum in a loaded avatar is not promised
    with pytest.raises(RenderRefusedError) as refused:
        loaded.render("fist", "orbit:20,0", 40, 32, "glow")
    assert (refused.value.code, refused.value.argument) == ("channel.invalid", True)


def test_encodings(live: Live, job: tuple[str, Path]) -> None:
    png = get(live, job[0], format="png")
    jpeg = get(live, job[0], format="jpeg")
    webp = get(live, job[0], format="webp")
    assert png.content[:8] == b"\x89PNG\r\n\x1a\n"
    assert jpeg.content[:2] == b"\xff\xd8"
    assert webp.content[8:12] == b"WEBP"
    for answer, name in ((png, "png"), (jpeg, "jpeg"), (webp, "webp")):
        assert answer.headers["content-type"] == f"image/{name}"
        assert answer.headers["cache-control"] == "private, no-cache"
    assert pixels(webp).shape == (512, 512, 4)
    flat = pixels(jpeg)
    assert flat.shape == (512, 512, 3)
    assert (flat[:, :240] > 250).all()  # the transparent half is white
    assert np.abs(flat[:, 300:].astype(int) - pixels(png)[:, 300:, :3]).max() < 6


def test_a_picture_held_by_the_client_is_not_sent_again(live: Live, job: tuple[str, Path]) -> None:
    first = get(live, job[0], pose="rest", camera="orbit:10,0,0.5")
    assert first.headers["etag"].startswith('W/"')
    query = {"pose": " REST ", "camera": "orbit:370,0.0,5e-1"}
    path = f"/jobs/{job[0]}/render"
    again = live.http.get(path, params=query, headers={"If-None-Match": first.headers["etag"]})
    assert (again.status_code, again.content) == (304, b"")
    other = live.http.get(path, params={"pose": "fist"}, headers={"If-None-Match": first.headers["etag"]})
    assert other.status_code == 200


def test_a_picture_made_lately_needs_no_process(
    live: Live, job: tuple[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    first = get(live, job[0], pose="frame:7")
    monkeypatch.setattr(live.services.pool.__class__, "render", None)
    assert get(live, job[0], pose="frame:007").content == first.content


def test_an_avatar_is_loaded_once_and_the_least_used_is_dropped(live: Live) -> None:
    (one, first), (two, _), (three, _) = live.finished(), live.finished(), live.finished()
    for pose in ("rest", "fist", "frame:1"):
        get(live, one, pose=pose).raise_for_status()
    assert len(loads(first)) == 1
    for other in (two, three):  # two avatars are kept
        get(live, other).raise_for_status()
    get(live, one, pose="frame:2").raise_for_status()
    assert len(loads(first)) == 2


POSE48 = ",".join(["0.1"] * 48)


def test_48_angles_are_a_pose(live: Live, job: tuple[str, Path]) -> None:
    assert get(live, job[0], pose=POSE48).status_code == 200


@pytest.mark.parametrize(
    ("query", "code"),
    [
        ({"pose": ""}, "pose.invalid"),
        ({"pose": "../../etc/passwd"}, "pose.invalid"),
        ({"pose": "fist;rm"}, "pose.invalid"),
        ({"pose": "frame:"}, "pose.invalid"),
        ({"pose": "frame:-1"}, "pose.invalid"),
        ({"pose": "1,2,3"}, "pose.invalid"),
        ({"pose": POSE48 + ",0"}, "pose.invalid"),
        ({"pose": POSE48.replace("0.1", "nan", 1)}, "pose.invalid"),
        ({"pose": POSE48.replace("0.1", "inf", 1)}, "pose.invalid"),
        ({"pose": POSE48.replace("0.1", "1e308", 1)}, "pose.invalid"),
        ({"pose": "x" * 3000}, "request.invalid"),
        ({"pose": "unknown"}, "pose.unknown"),
        ({"camera": ""}, "camera.invalid"),
        ({"camera": "camera.json"}, "camera.invalid"),
        ({"camera": "/etc/passwd"}, "camera.invalid"),
        ({"camera": "orbit:"}, "camera.invalid"),
        ({"camera": "orbit:1"}, "camera.invalid"),
        ({"camera": "orbit:1,2,3,4"}, "camera.invalid"),
        ({"camera": "orbit:0,91"}, "camera.invalid"),
        ({"camera": "orbit:0,0,0.001"}, "camera.invalid"),
        ({"camera": "orbit:0,0,0"}, "camera.invalid"),
        ({"camera": "orbit:0,0,1e9"}, "camera.invalid"),
        ({"camera": "orbit:nan,0,1"}, "camera.invalid"),
        ({"width": 0}, "request.invalid"),
        ({"width": -5}, "request.invalid"),
        ({"height": 65535}, "request.invalid"),
        ({"height": "tall"}, "request.invalid"),
        ({"width": 601, "height": 600}, "render.too_large"),
        ({"format": "gif"}, "request.invalid"),
        ({"channel": "glow"}, "request.invalid"),
        ({"channel": ""}, "request.invalid"),
        ({"channel": "DEPTH"}, "request.invalid"),
    ],
)
def test_bad_requests(live: Live, job: tuple[str, Path], query: dict[str, str | int], code: str) -> None:
    problem(get(live, job[0], **query), 422, code)


def test_unfinished_and_failed_jobs_have_no_picture(live: Live) -> None:
    job_id = live.submit()
    problem(get(live, job_id), 409, "job.not_ready")
    claim = live.services.store.claim(job_id)
    assert claim is not None
    problem(get(live, job_id), 409, "job.not_ready")
    live.services.store.fail(job_id, claim.token, "video.no_hand", "m", "a")
    problem(get(live, job_id), 409, "job.no_result")


def test_a_crash_costs_one_answer(live: Live, job: tuple[str, Path]) -> None:
    before = live.services.pool.pids()
    problem(get(live, job[0], pose="die"), 500, "render.failed")
    assert get(live, job[0], pose="rest", width=100).status_code == 200
    after = live.services.pool.pids()
    assert len(after) == len(before) == 1
    assert after != before


def test_a_process_killed_while_idle_costs_one_answer(live: Live, job: tuple[str, Path]) -> None:
    get(live, job[0], pose="rest", width=101).raise_for_status()
    (pid,) = live.services.pool.pids()
    process = psutil.Process(pid)
    os.kill(pid, signal.SIGKILL)
    psutil.wait_procs([process], timeout=10)
    problem(get(live, job[0], pose="rest", width=102), 500, "render.failed")
    assert get(live, job[0], pose="rest", width=102).status_code == 200


def test_a_picture_that_takes_too_long_is_given_up(live: Live, job: tuple[str, Path]) -> None:
    get(live, job[0], pose="rest", width=103).raise_for_status()
    (pid,) = live.services.pool.pids()
    answer = get(live, job[0], pose="hang")
    problem(answer, 503, "render.timeout")
    assert answer.headers["retry-after"]
    assert not psutil.pid_exists(pid)
    assert get(live, job[0], pose="rest", width=104).status_code == 200


def test_bugs_and_broken_avatars(live: Live, job: tuple[str, Path]) -> None:
    body = problem(get(live, job[0], pose="bug"), 500, "render.failed")
    assert "renderer" not in str(body["detail"])
    (pid,) = live.services.pool.pids()
    assert psutil.pid_exists(pid)  # a bug is no reason to lose the process
    broken, _ = live.finished(**{"avatar.safetensors": b"broken"})
    problem(get(live, broken), 500, "avatar.corrupt")
    missing, folder = live.finished()
    (folder / "avatar.safetensors").unlink()
    problem(get(live, missing), 500, "render.failed")


def test_a_picture_asked_for_by_many_at_once_is_drawn_once(live: Live) -> None:
    def shared() -> float:
        found = live.services.metrics.registry.get_sample_value("mass_renders_total", {"outcome": "shared"})
        return found or 0.0

    job_id, folder = live.finished()
    os.mkfifo(folder / "gate")
    before = shared()
    # More than may wait: the others wait for this picture, not for a process.
    with ThreadPoolExecutor(6) as threads:
        asked = [threads.submit(get, live, job_id, pose="wait") for _ in range(6)]
        gate = (folder / "gate").open("wb")
        wait_for("all have asked", lambda: shared() == before + 5)
        gate.close()
        answers = [one.result() for one in asked]
    assert {answer.status_code for answer in answers} == {200}
    assert len({answer.content for answer in answers}) == 1
    assert len(loads(folder)) == 1


def test_a_client_that_goes_away_takes_nobody_elses_picture_along(live: Live) -> None:
    job_id, folder = live.finished()
    os.mkfifo(folder / "gate")
    with socket.create_connection((live.host, live.port)) as first:
        first.sendall(f"GET /jobs/{job_id}/render?pose=wait HTTP/1.1\r\nHost: localhost\r\n\r\n".encode())
        gate = (folder / "gate").open("wb")
    with ThreadPoolExecutor(1) as threads:
        second = threads.submit(get, live, job_id, pose="wait")
        key = next(iter(live.services.drawing._under_way))
        gate.close()
        assert second.result().status_code == 200
    assert key[0] == job_id
    assert len(loads(folder)) == 1


def test_who_waits_longest_is_served_first(tmp_path: Path) -> None:
    path = tmp_path / "avatar.safetensors"
    path.write_bytes(b"an avatar")
    os.mkfifo(tmp_path / "gate")
    pool = RenderPool(load, workers=1, queue=10)
    pool.start()

    def stands(number: int) -> bool:
        return len(pool._line) == number

    try:
        with ThreadPoolExecutor(7) as threads:
            held = threads.submit(pool.render, path, View("wait", "source", 16, 16, "png"))
            gate = (tmp_path / "gate").open("wb")
            for number in range(6):
                threads.submit(pool.render, path, View("rest", "source", 20 + number, 16, "png"))
                wait_for("it stands in the line", partial(stands, number + 1))
            gate.close()
            held.result()
    finally:
        pool.close()
    assert (tmp_path / "drawn").read_text().split() == ["16", "20", "21", "22", "23", "24", "25"]


def test_more_requests_than_may_wait_are_turned_away(live: Live) -> None:
    job_id, folder = live.finished()
    get(live, job_id).raise_for_status()  # loaded
    os.mkfifo(folder / "gate")
    with ThreadPoolExecutor(3) as threads:
        held = threads.submit(get, live, job_id, pose="wait")
        # Opening the FIFO for writing returns once the render process has opened it for reading.
        gate = (folder / "gate").open("wb")
        # One of these may wait (render_queue=1), whichever comes second is turned away at once.
        more = [threads.submit(get, live, job_id, pose="rest", width=width) for width in (98, 99)]
        done, waiting = wait(more, timeout=2.5, return_when=FIRST_COMPLETED)
        assert (len(done), len(waiting)) == (1, 1)
        answer = done.pop().result()
        problem(answer, 503, "render.busy")
        assert answer.headers["retry-after"]
        gate.close()
        assert held.result().status_code == 200
        assert waiting.pop().result().status_code == 200
    for width in (98, 99):
        assert get(live, job_id, pose="rest", width=width).status_code == 200
