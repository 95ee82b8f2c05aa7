"""How often one may ask: the buckets, and a real service that a proxy tells whom it speaks for."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.access import rates
from service.access.keys import KeyStore, Scope
from service.access.rates import RateLimiter, network
from service.settings import Settings
from tests.service.conftest import VIDEO, Live, problem, serve


def test_a_burst_then_the_rate() -> None:
    now = [100.0]
    limiter = RateLimiter(2.0, 5.0, lambda: now[0])
    assert [limiter.take("ann") for _ in range(5)] == [0] * 5
    assert limiter.take("ann") == 1
    assert limiter.take("bob") == 0
    now[0] += 0.5
    assert [limiter.take("ann") for _ in range(2)] == [0, 1]
    now[0] += 1000
    assert [limiter.take("ann") for _ in range(6)] == [0] * 5 + [1]


def test_the_wait_that_is_named_is_enough() -> None:
    now = [0.0]
    limiter = RateLimiter(1 / 60, 1.0, lambda: now[0])
    assert limiter.take("ann") == 0
    now[0] += 10
    assert limiter.take("ann") == 50
    now[0] += 50
    assert limiter.take("ann") == 0


@given(st.lists(st.floats(0, 10), max_size=200), st.floats(0.5, 20), st.floats(1, 50))
def test_never_more_than_a_burst_and_the_rate(pauses: list[float], rate: float, burst: float) -> None:
    now = [0.0]
    limiter = RateLimiter(rate, burst, lambda: now[0])
    passed = 0
    for pause in pauses:
        now[0] += pause
        passed += limiter.take("ann") == 0
    assert passed <= burst + rate * now[0] + 1e-6


def test_no_rate_is_no_limit_and_the_memory_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    assert not any(RateLimiter(0.0, 0.0).take("ann") for _ in range(1000))
    monkeypatch.setattr(rates, "_MOST", 10)
    limiter = RateLimiter(1.0, 1.0, lambda: 0.0)
    for number in range(1000):
        limiter.take(str(number))
    assert len(limiter) == 10
    assert limiter.take("999") == 1


@pytest.mark.parametrize(
    ("host", "who"),
    [
        ("203.0.113.5", "203.0.113.5"),
        ("::ffff:203.0.113.5", "203.0.113.5"),
        ("2001:db8:1:2:3:4:5:6", "2001:db8:1:2::/64"),
        ("fe80::1%eth0", "fe80::/64"),
        ("127.0.0.9", None),
        ("::1", None),
        ("::ffff:127.0.0.1", None),
        ("testclient", None),
        ("", None),
        (None, None),
    ],
)
def test_what_counts_as_one_address(host: str | None, who: str | None) -> None:
    assert network(host) == who


@pytest.fixture(scope="module")
def slow(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Live]:
    """A burst of four for an owner, of eight for an address, and practically nothing after that."""
    settings = Settings(
        data_dir=tmp_path_factory.mktemp("slow"),
        auth="keys",
        min_free_bytes=0,
        rate_owner=0.004,
        rate_address=0.008,
        rate_burst_seconds=1000.0,
    )
    with serve(settings) as live:
        yield live


def _key(live: Live, owner: str) -> dict[str, str]:
    key = KeyStore(live.services.store.engine).create(owner, [Scope.WRITE])
    return {"Authorization": f"Bearer {key}"}


def _refused(answer: httpx.Response) -> None:
    problem(answer, 429, "rate.exceeded")
    assert 100 <= int(answer.headers["Retry-After"]) <= 250


def test_an_owner_who_asks_too_often_is_told_to_wait_whatever_the_key(slow: Live) -> None:
    first, second = _key(slow, "ann"), _key(slow, "ann")
    for headers in (first, second, first, second):
        assert slow.http.get("/jobs", headers=headers).status_code == 200
    for headers in (first, second):
        _refused(slow.http.get("/jobs", headers=headers))
    before = slow.files()
    _refused(slow.http.post("/jobs", headers=first, files={"video": VIDEO}))
    assert slow.files() == before
    assert slow.http.get("/jobs", headers=_key(slow, "bob")).status_code == 200


def test_an_address_that_asks_too_often_is_told_to_wait_with_a_key_or_without(slow: Live) -> None:
    def ask(address: str, path: str = "/jobs", **headers: str) -> httpx.Response:
        return slow.http.get(path, headers={"X-Forwarded-For": address, **headers})

    for _ in range(8):
        problem(ask("203.0.113.5"), 401, "access.key")
    _refused(ask("203.0.113.5"))
    _refused(ask("203.0.113.5", "/capabilities"))
    _refused(ask("203.0.113.5", **_key(slow, "carol")))
    assert ask("203.0.113.6", **_key(slow, "carol")).status_code == 200
    # Those that belong to one subscriber count as one.
    for last in range(8):
        assert ask(f"2001:db8::{last}", "/healthz").status_code == 200
    _refused(ask("2001:db8::ffff", "/healthz"))
    assert slow.http.get("/healthz").status_code == 200  # this machine itself


def test_what_is_usual_is_far_below_the_defaults(tmp_path: Path) -> None:
    """An upload in many parts and a film of pictures, as fast as they go."""
    with serve(Settings(data_dir=tmp_path, auth="keys", min_free_bytes=0)) as live:
        live.http.headers.update({**_key(live, "ann"), "X-Forwarded-For": "203.0.113.5"})
        job_id, _ = live.finished()
        for frame in range(120):
            query = f"pose=frame:{frame}&width=16&height=16"
            assert live.http.get(f"/jobs/{job_id}/render?{query}").status_code == 200
        tus = {"Tus-Resumable": "1.0.0"}
        data = VIDEO[:12] + bytes(1000)
        made = live.http.post("/uploads", headers={**tus, "Upload-Length": str(len(data))})
        part = {**tus, "Content-Type": "application/offset+octet-stream"}
        offset = 0
        while offset < len(data):
            sent = data[offset : offset + 12]
            where = {"Upload-Offset": str(offset)}
            answer = live.http.patch(made.headers["Location"], headers={**part, **where}, content=sent)
            assert answer.status_code == 204, answer.text
            offset += len(sent)
