"""Webhooks: signed, sent until they arrive, never into a private network, never in a job's way."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest
from standardwebhooks import Webhook, WebhookVerificationError

from service.jobs.store import JobStore, create_store
from service.settings import Settings
from service.webhooks.outbox import EVENTS, MAX_ENDPOINTS, PAUSES, TAKEN_SECONDS, Outbox
from service.webhooks.sender import Sender, check_url, is_public
from tests.service.conftest import Live, problem, serve


@dataclass
class Receiver:
    """An HTTP server that answers what it is told to and remembers what it got."""

    port: int
    answers: list[int] = field(default_factory=list)
    got: list[tuple[dict[str, str], bytes]] = field(default_factory=list)
    arrived: threading.Condition = field(default_factory=threading.Condition)

    def wait(self, count: int) -> None:
        with self.arrived:
            assert self.arrived.wait_for(lambda: len(self.got) >= count, 30), self.got


@pytest.fixture
def receiver() -> Iterator[Receiver]:
    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers["content-length"]))
            with found.arrived:
                status = found.answers.pop(0) if found.answers else 204
                found.got.append(({k.lower(): v for k, v in self.headers.items()}, body))
                self.send_response(status)
                if status == 302:
                    self.send_header("Location", "http://169.254.169.254/latest/meta-data")
                self.send_header("Content-Length", "0")
                self.end_headers()
                found.arrived.notify_all()

        def log_message(self, *_: Any) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    found = Receiver(server.server_port)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.05})
    thread.start()
    yield found
    server.shutdown()
    thread.join()
    server.server_close()


class Clock:
    def __init__(self) -> None:
        self.now = 1_700_000_000.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def store(tmp_path: Path, clock: Clock) -> Iterator[JobStore]:
    store = create_store(Settings(data_dir=tmp_path), clock)
    yield store
    store.close()


def test_a_jobs_changes_are_told_signed_and_in_full(receiver: Receiver, tmp_path: Path) -> None:
    with serve(Settings(data_dir=tmp_path, min_free_bytes=0, webhook_private=True)) as live:
        url = f"http://127.0.0.1:{receiver.port}/hook"
        made = live.http.post("/webhooks", json={"url": url, "events": ["job.running", "job.failed"]})
        assert made.status_code == 201, made.text
        secret = made.json()["secret"]
        job_id = live.submit()
        claim = live.services.store.claim(job_id)
        assert claim is not None
        live.services.store.fail(job_id, claim.token, "video.no_hand", "No hand.", "Show one.")
        receiver.wait(2)
        by_type = {}
        for headers, body in receiver.got:
            said = Webhook(secret).verify(body, headers)  # the standard's own library
            by_type[said["type"]] = said
            with pytest.raises(WebhookVerificationError):
                Webhook(secret).verify(body + b" ", headers)
        assert set(by_type) == {"job.running", "job.failed"}
        assert by_type["job.failed"]["data"]["id"] == job_id
        assert by_type["job.failed"]["data"]["error"]["code"] == "video.no_hand"
        hook = live.http.get(made.headers["Location"]).json()
        assert "secret" not in hook
        assert secret not in live.http.get("/webhooks").text
        assert live.http.post(f"{made.headers['Location']}/ping").status_code == 202
        receiver.wait(3)
        assert json.loads(receiver.got[2][1])["type"] == "ping"
        assert live.http.delete(made.headers["Location"]).status_code == 204
        problem(live.http.get(made.headers["Location"]), 404, "webhook.not_found")


def test_it_is_sent_again_under_one_id_until_it_arrives(
    receiver: Receiver, store: JobStore, clock: Clock
) -> None:
    outbox = Outbox(store.engine, clock)
    hook = outbox.create("local", f"http://127.0.0.1:{receiver.port}/", ["job.queued"])
    sender = Sender(outbox, private=True, clock=clock)
    receiver.answers = [500, 302, 429]
    store.create({}, "v")
    for attempt in range(3):
        assert sender.send_next()
        assert not sender.send_next()  # not before its time
        clock.now += PAUSES[attempt] * 1.11
    assert sender.send_next()
    assert len({headers["webhook-id"] for headers, _ in receiver.got}) == 1
    assert len({body for _, body in receiver.got}) == 1
    assert len({headers["webhook-timestamp"] for headers, _ in receiver.got}) == 4
    assert [headers["host"].split(":")[0] for headers, _ in receiver.got] == ["127.0.0.1"] * 4  # no redirect
    (message,) = outbox.messages(hook.id)
    assert (message.delivered, message.attempts, message.outcome) == (True, 4, "204")
    clock.now += 8 * 86400
    outbox.sweep()
    assert outbox.messages(hook.id) == []


def test_it_is_given_up_in_the_end(store: JobStore, clock: Clock) -> None:
    outbox = Outbox(store.engine, clock)
    hook = outbox.create("local", "http://127.0.0.1:1/", ["job.queued"])
    sender = Sender(outbox, private=True, clock=clock)
    store.create({}, "v")
    for _ in range(len(PAUSES) + 1):
        assert sender.send_next()
        clock.now += PAUSES[-1] * 1.2
    assert not sender.send_next()
    (message,) = outbox.messages(hook.id)
    assert (message.delivered, message.attempts) == (False, len(PAUSES) + 1)
    assert message.outcome == "not reached (ConnectError)"


def test_who_is_gone_is_told_nothing_more(receiver: Receiver, store: JobStore, clock: Clock) -> None:
    outbox = Outbox(store.engine, clock)
    hook = outbox.create("local", f"http://127.0.0.1:{receiver.port}/", ["job.queued"])
    receiver.answers = [410]
    store.create({}, "v")
    store.create({}, "v")
    sender = Sender(outbox, private=True, clock=clock)
    while sender.send_next():
        clock.now += 1
    store.create({}, "v")
    while outbox.take() is not None:
        pass
    assert len(receiver.got) == 1
    found = outbox.get(hook.id, "local")
    assert found is not None
    assert found.disabled_at is not None
    assert all(message.finished_at for message in outbox.messages(hook.id))


def test_a_message_survives_its_sender_and_goes_to_one_at_a_time(store: JobStore, clock: Clock) -> None:
    outbox = Outbox(store.engine, clock)
    outbox.create("local", "https://example.com/", ["job.queued"])
    store.create({}, "v")
    first = outbox.take()
    assert first is not None
    assert outbox.take() is None
    clock.now += TAKEN_SECONDS + 1  # the sender was killed
    second = outbox.take()
    assert second is not None
    assert (second.message_id, second.attempt) == (first.message_id, 2)
    outbox.failed(first, "late")  # changes nothing any more
    outbox.delivered(second, "200")
    assert outbox.take() is None


def test_only_ones_own_jobs_and_chosen_events_are_told(store: JobStore, clock: Clock) -> None:
    outbox = Outbox(store.engine, clock)
    ann = outbox.create("ann", "https://example.com/", ["job.cancelled"])
    bob = outbox.create("bob", "https://example.com/", list(EVENTS))
    job = store.create({}, "v", owner="ann")
    store.request_cancel(job.id)
    assert [message.event for message in outbox.messages(ann.id)] == ["job.cancelled"]
    assert outbox.messages(bob.id) == []


def test_a_receiver_that_hangs_holds_up_no_job(live: Live) -> None:
    """Messages are rows: nothing but the sender's thread ever waits for a receiver."""
    made = live.http.post("/webhooks", json={"url": "https://192.0.2.1/"})
    problem(made, 422, "webhook.url")
    live.services.outbox.create("local", "https://hanging.invalid/", list(EVENTS))
    job_id = live.submit()
    assert live.http.post(f"/jobs/{job_id}/cancel").json()["state"] == "cancelled"


PRIVATE = [
    *("127.0.0.1", "10.1.2.3", "172.16.0.1", "192.168.1.1", "169.254.169.254", "100.64.0.1", "0.0.0.0"),
    *("224.0.0.1", "255.255.255.255", "192.0.2.1", "::1", "::", "fe80::1", "fe80::1%eth0", "fc00::1"),
    *("::ffff:127.0.0.1", "::ffff:a00:1", "64:ff9b::7f00:1", "2002:7f00:1::", "ff02::1", "not an address"),
]


@pytest.mark.parametrize("address", PRIVATE)
def test_private_addresses_are_known_in_every_disguise(address: str) -> None:
    assert not is_public(address)
    assert is_public("8.8.8.8")
    assert is_public("2606:4700:4700::1111")
    assert is_public("::ffff:8.8.8.8")


@pytest.mark.parametrize(
    "url",
    [
        *("http://example.com/", "ftp://example.com/", "//example.com", "", "https://", "https://:443/"),
        *("https://localhost/", "https://intern/", "https://user:pw@example.com/", "https://example.com:0/"),
        *("https://127.0.0.1/", "https://[::1]/", "https://[::ffff:10.0.0.1]/", "https://169.254.169.254/"),
        *(
            "https://2130706433/",
            "https://0x7f.1/",
            "https://127.1/",
            "https://0177.0.0.1/",
            "https://1.2.3/",
        ),
        *("https://exa mple.com/", "https://example.com/\n", "https://ex\u00e4mple.com/", "https://e.com:x/"),
    ],
)
def test_addresses_that_are_refused_at_once(live: Live, url: str) -> None:
    assert check_url(url) is not None
    problem(live.http.post("/webhooks", json={"url": url}), 422, "webhook.url")


def test_addresses_that_will_do() -> None:
    for url in (
        "https://example.com/hook?x=1",
        "https://8.8.8.8/",
        "https://example.com:8443/",
        "https://a.b",
    ):
        assert check_url(url) is None
    assert check_url("http://localhost:9/", private=True) is None


def test_a_name_is_looked_up_once_and_all_its_addresses_must_be_public(
    receiver: Receiver, store: JobStore, clock: Clock
) -> None:
    outbox = Outbox(store.engine, clock)
    hook = outbox.create("local", f"http://rebinding.example:{receiver.port}/", ["job.queued"])
    answers = [["8.8.8.8", "127.0.0.1"], ["127.0.0.1"], ["::ffff:127.0.0.1"], []]
    asked: list[str] = []

    def resolver(host: str, port: int) -> list[str]:
        asked.append(host)
        return answers[len(asked) - 1]

    store.create({}, "v")
    for _ in answers:
        assert Sender(outbox, resolver=resolver, clock=clock).send_next()
        (message,) = outbox.messages(hook.id)
        assert message.outcome == "the address is in a private network"
        clock.now += PAUSES[-1]
    assert asked == ["rebinding.example"] * 4
    assert receiver.got == []
    # The address that was checked is the one connected to: the name is never looked up again.
    local = Sender(outbox, private=True, resolver=lambda *_: ["127.0.0.1"], clock=clock)
    assert local.send_next()
    assert receiver.got[0][0]["host"] == f"rebinding.example:{receiver.port}"


def test_there_is_a_limit(live: Live) -> None:
    made = [
        live.http.post("/webhooks", json={"url": "https://example.com/"}) for _ in range(MAX_ENDPOINTS + 1)
    ]
    problem(made[-1], 429, "quota.exceeded")
    for answer in made:
        if answer.status_code == 201:
            live.http.delete(answer.headers["Location"])


@pytest.mark.parametrize(
    "body", [{}, {"url": "https://a.b", "events": []}, {"url": "https://a.b", "events": ["x"]}]
)
def test_bad_requests(live: Live, body: dict[str, Any]) -> None:
    problem(live.http.post("/webhooks", json=body), 422, "request.invalid")
