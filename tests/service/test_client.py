"""The client against answers it must survive; its happy path is tested end to end."""

from __future__ import annotations

import hashlib
import io
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import ClassVar

import httpx
import pytest

from service.cli import main
from service.client import AssetInfo, MassClient, ServiceError
from service.transfers import upload
from tests.service.conftest import VIDEO, Live

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


def _too_often(wait: str, code: str = "rate.exceeded") -> httpx.Response:
    return httpx.Response(429, json={"code": code, "detail": "Too often."}, headers={"retry-after": wait})


def test_a_service_asked_too_often_is_left_alone_for_as_long_as_it_says() -> None:
    service, made = script(_too_often("0"), _too_often("0"), httpx.Response(200, json=JOB))
    assert service.job("j").state == "running"
    assert len(made) == 3


@pytest.mark.parametrize(
    "answers",
    [
        [_too_often("0")] * 4,
        [_too_often("9999")],
        [_too_often("soon")],
        [_too_often("0", "quota.exceeded")],
        [httpx.Response(429)],
    ],
)
def test_what_is_not_worth_waiting_for(answers: list[httpx.Response]) -> None:
    service, made = script(*answers)
    with pytest.raises(ServiceError) as error:
        service.job("j")
    assert error.value.status == 429
    assert len(made) == len(answers)


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

    client(answer).submit(video, {"seed": 1}, resumable=False)
    assert b"video bytes" in bodies[0]
    assert b'{"seed": 1}' in bodies[0]
    assert b"holiday" not in bodies[0]


class Flaky(httpx.HTTPTransport):
    """A network on which every third request is lost, or its answer."""

    def __init__(self) -> None:
        super().__init__()
        self.count = 0

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        self.count += 1
        if self.count % 6 == 2:
            raise httpx.ConnectError("lost on the way")
        answer = super().handle_request(request)
        if self.count % 6 == 5:
            answer.close()
            raise httpx.ReadError("the answer was lost")
        return answer


def test_an_upload_gets_through_a_bad_network(live: Live, tmp_path: Path) -> None:
    seen: list[int] = []
    content = VIDEO * 3
    with MassClient(f"http://{live.host}:{live.port}", transport=Flaky()) as service:
        upload_id = upload(
            service._request,
            io.BytesIO(content),
            len(content),
            lambda done, total: seen.append(done),
            part_bytes=1500,
            pause=0.0,
        )
    found = live.services.uploads.get(upload_id)
    assert found is not None
    assert found.complete
    assert (live.services.storage.root / "uploads" / upload_id / "source").read_bytes() == content
    assert seen[-1] == len(content)
    assert seen == sorted(seen)


def test_a_submission_whose_answer_was_lost_makes_one_job(live: Live, tmp_path: Path) -> None:
    class Deaf(httpx.HTTPTransport):
        lost = 0

        def handle_request(self, request: httpx.Request) -> httpx.Response:
            answer = super().handle_request(request)
            if request.url.path == "/jobs" and self.lost < 2:
                self.lost += 1
                answer.close()
                raise httpx.ReadError("the answer was lost")
            return answer

    video = tmp_path / "clip.mp4"
    video.write_bytes(VIDEO)
    before = len(live.http.get("/jobs?limit=100").json()["jobs"])
    with MassClient(f"http://{live.host}:{live.port}", transport=Deaf()) as service:
        job = service.submit(video, {"side": "left"})
        assert job.state == "queued"
        assert len([*service.jobs()]) == before + 1
        again = service.cancel(job.id)
        assert again.finished
        second = service.restart(job.id, {"side": "right"})
        assert second.id != job.id


def test_events_are_taken_up_where_the_connection_broke(live: Live) -> None:
    job_id = live.submit()
    claim = live.services.store.claim(job_id)
    assert claim is not None
    for step in range(1, 6):
        live.services.store.report_progress(job_id, claim.token, "fit", step / 10)
    live.services.store.log(job_id, claim.token, ["one", "two"])
    live.services.store.fail(job_id, claim.token, "c", "m", "a")

    class Cutting(httpx.HTTPTransport):
        asked: ClassVar[list[str]] = []

        def handle_request(self, request: httpx.Request) -> httpx.Response:
            answer = super().handle_request(request)
            if "/events" not in request.url.path:
                return answer
            self.asked.append(request.headers["Last-Event-ID"])
            return httpx.Response(200, stream=_Cut(answer.read().split(b"\n\n")[:4]))

    with MassClient(f"http://{live.host}:{live.port}", transport=Cutting()) as service:
        seen = [*service.events(job_id)]
        assert [*service.logs(job_id)] == ["one", "two"]
    assert [event.id for event in seen] == [*range(1, 9)]
    assert seen[-1].data["state"] == "failed"
    assert Cutting.asked == ["0", "3", "6"]


class _Cut(httpx.SyncByteStream):
    """Some events, then a broken connection."""

    def __init__(self, events: list[bytes]) -> None:
        self._events = events

    def __iter__(self) -> Iterator[bytes]:
        for event in self._events:
            yield event + b"\n\n"
        raise httpx.ReadError("cut")


def test_the_key_comes_from_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    sent: list[str] = []

    def answer(request: httpx.Request) -> httpx.Response:
        sent.append(request.headers.get("Authorization", ""))
        return httpx.Response(200, json=JOB)

    monkeypatch.setenv("MASS_KEY", "mass_x_y")
    client(answer).job("j")
    monkeypatch.delenv("MASS_KEY")
    client(answer).job("j")
    assert sent == ["Bearer mass_x_y", ""]


def test_the_command_line_animates(live: Live, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A worker that makes the motion at once stands in for the real one."""
    parent, _ = live.finished()
    stop = threading.Event()

    def work() -> None:
        store, storage = live.services.store, live.services.storage
        while not stop.wait(0.02):
            for job in store.page(parent=parent)[0]:
                claim = store.claim(job.id)
                if claim is not None:
                    assert claim.options["poses"] == ["rest", "fist"]
                    name = f"motion.{claim.options['format']}"
                    (storage.attempt_dir(job.id, claim.artifact) / name).write_bytes(b"a motion")
                    storage.publish(job.id, claim.artifact)
                    store.succeed(job.id, claim.token, claim.artifact)

    thread = threading.Thread(target=work)
    thread.start()
    try:
        out = tmp_path / "hand.webp"
        url = f"http://{live.host}:{live.port}"
        command = ["animate", parent, "--url", url, "--poses", "rest;fist", "--out", str(out)]
        assert main(command) == 0
    finally:
        stop.set()
        thread.join()
    assert out.read_bytes() == b"a motion"
    assert [path.name for path in tmp_path.iterdir()] == ["hand.webp"]
    assert live.services.store.page(parent=parent)[0] == []
