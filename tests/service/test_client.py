"""The client against answers it must survive; its happy path is tested end to end."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from pathlib import Path

import httpx
import pytest

from service.cli import main
from service.client import AssetInfo, MassClient, ServiceError

JOB = {
    "id": "j",
    "state": "running",
    "stage": "fit",
    "fraction": 0.5,
    "time_left": 3.0,
    "message": "",
    "attempt": 1,
    "error": None,
    "created_at": "2026-01-01T00:00:00Z",
}
DONE = {**JOB, "state": "failed", "error": {"code": "video.no_hand", "message": "None.", "advice": "Film."}}

Answer = httpx.Response | Exception


def client(answer: Callable[[httpx.Request], httpx.Response]) -> MassClient:
    return MassClient("http://service", transport=httpx.MockTransport(answer))


def script(*answers: Answer) -> tuple[MassClient, list[httpx.Request]]:
    """A client whose requests get these answers in turn, and the requests it made."""
    waiting: Iterator[Answer] = iter(answers)
    made: list[httpx.Request] = []

    def answer(request: httpx.Request) -> httpx.Response:
        made.append(request)
        one = next(waiting)
        if isinstance(one, Exception):
            raise one
        return one

    return client(answer), made


def test_a_problem_becomes_an_error_with_its_code_advice_and_faults() -> None:
    body = {
        "title": "No",
        "detail": "The options are wrong.",
        "code": "options.invalid",
        "advice": "Correct them.",
        "errors": [{"field": "seed", "message": "too small"}],
    }
    service, _ = script(httpx.Response(422, json=body))
    with pytest.raises(ServiceError) as error:
        service.job("j")
    assert (error.value.status, error.value.code) == (422, "options.invalid")
    assert str(error.value) == "The options are wrong.; seed: too small Correct them."


@pytest.mark.parametrize("body", [b"<html>Bad gateway</html>", b"[]", b"null"])
def test_an_error_that_is_no_problem_is_still_an_error(body: bytes) -> None:
    service, _ = script(httpx.Response(502, content=body))
    with pytest.raises(ServiceError) as error:
        service.job("j")
    assert (error.value.code, error.value.message) == ("http.502", "The service answered 502.")


def test_waiting_survives_a_service_that_goes_away_for_a_while() -> None:
    service, made = script(
        httpx.Response(200, json=JOB, headers={"etag": '"1"'}),
        httpx.ConnectError("refused"),
        httpx.Response(503),
        httpx.Response(304),
        httpx.Response(200, json=DONE),
    )
    seen: list[str] = []
    job = service.wait("j", lambda job: seen.append(job.state), poll_seconds=0.0)
    assert seen == ["running", "failed"]
    assert job.error is not None
    assert job.error.code == "video.no_hand"
    assert [request.headers.get("if-none-match") for request in made] == [None, '"1"', '"1"', '"1"', '"1"']


def test_waiting_ends_when_patience_does_and_at_once_for_a_job_that_is_gone() -> None:
    service, _ = script(httpx.Response(200, json=JOB), httpx.ConnectError("refused"))
    with pytest.raises(ServiceError, match="does not answer"):
        service.wait("j", poll_seconds=0.0, patience=0.0)
    service, _ = script(httpx.Response(200, json=JOB), httpx.Response(404, json={"code": "job.not_found"}))
    with pytest.raises(ServiceError) as error:
        service.wait("j", poll_seconds=0.0)
    assert error.value.code == "job.not_found"


def test_ids_are_quoted() -> None:
    service, made = script(httpx.Response(404))
    with pytest.raises(ServiceError):
        service.job("../capabilities?x=1#")
    assert made[0].url.raw_path == b"/jobs/..%2Fcapabilities%3Fx%3D1%23"


def test_a_render_asks_for_what_was_asked() -> None:
    service, made = script(httpx.Response(200, content=b"a"), httpx.Response(200, content=b"b"))
    assert service.render("j", "fist", channel="depth") == b"a"
    assert made[0].url.params["channel"] == "depth"
    assert made[0].url.params["pose"] == "fist"
    service.render("j")
    assert made[1].url.params["channel"] == "rgb"


def test_the_command_line_hands_the_channel_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    service, made = script(httpx.Response(200, content=b"picture"))
    monkeypatch.setattr("service.cli.MassClient", lambda url: service)
    out = tmp_path / "a.webp"
    assert main(["render", "j", "--channel", "surfels", "--out", str(out)]) == 0
    assert out.read_bytes() == b"picture"
    assert (made[0].url.params["channel"], made[0].url.params["format"]) == ("surfels", "webp")


def test_a_damaged_download_is_refused_and_removed(tmp_path: Path) -> None:
    asset = AssetInfo("surfels.ply", 3, hashlib.sha256(b"abc").hexdigest())
    service, _ = script(httpx.Response(200, content=b"abd"), httpx.Response(200, content=b"abc"))
    with pytest.raises(ServiceError) as error:
        service.download("j", asset, tmp_path)
    assert error.value.code == "client.checksum"
    assert [*tmp_path.iterdir()] == []
    assert service.download("j", asset, tmp_path).read_bytes() == b"abc"


@pytest.mark.parametrize("name", ["../evil", "/etc/evil", "previews/../../evil"])
def test_a_service_cannot_choose_where_files_go(tmp_path: Path, name: str) -> None:
    service, made = script(httpx.Response(200, content=b"abc"))
    with pytest.raises(ServiceError) as error:
        service.download("j", AssetInfo(name, 3, ""), tmp_path / "out")
    assert error.value.code == "client.name"
    assert made == []
    assert not (tmp_path / "evil").exists()


def test_all_pages_of_jobs_are_read() -> None:
    service, made = script(
        httpx.Response(200, json={"jobs": [JOB], "next": "c1"}),
        httpx.Response(200, json={"jobs": [DONE], "next": None}),
    )
    assert [job.state for job in service.jobs()] == ["running", "failed"]
    assert made[1].url.params["cursor"] == "c1"


def test_the_local_file_name_is_not_sent(tmp_path: Path) -> None:
    video = tmp_path / "my secret holiday.mp4"
    video.write_bytes(b"video bytes")
    bodies: list[bytes] = []

    def answer(request: httpx.Request) -> httpx.Response:
        bodies.append(request.read())
        return httpx.Response(202, json=JOB)

    client(answer).submit(video, {"seed": 1})
    assert b"video bytes" in bodies[0]
    assert b'{"seed": 1}' in bodies[0]
    assert b"holiday" not in bodies[0]
