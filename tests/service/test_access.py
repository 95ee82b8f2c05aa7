"""Who may: keys, scopes, owners, quotas, signed links, each over the whole API."""

from __future__ import annotations

import json
import stat
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import httpx
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.access.gate import asks_for_keys, is_public
from service.access.keys import KeyStore, Scope
from service.access.links import Signer, is_signed, service_secret
from service.cli import main
from service.jobs.model import new_job_id
from service.jobs.store import create_store
from service.openapi import document
from service.settings import Settings
from tests.service.conftest import VIDEO, Live, problem, serve

OPERATIONS = [
    (method.upper(), path) for path, methods in json.loads(document())["paths"].items() for method in methods
]
PRIVATE = [(method, path) for method, path in OPERATIONS if not is_public(path)]


@dataclass
class Keyed:
    """A service that asks for keys, and one key of each kind."""

    live: Live
    keys: dict[str, str]
    job: str
    upload: str
    webhook: str

    def send(self, who: str, method: str, path: str, **arguments: object) -> httpx.Response:
        headers = {"Tus-Resumable": "1.0.0"}
        if who != "anonymous":
            headers["Authorization"] = f"Bearer {self.keys[who]}"
        return self.live.http.request(method, path, headers=headers, **arguments)  # type: ignore[arg-type]

    def at(self, path: str) -> str:
        """The path with its names filled in: Ann's finished job, and things that exist in it."""
        names = {
            "webhook_id": self.webhook,
            "upload_id": self.upload,
            "job_id": self.job,
            "name": "report.json",
            "code": "video.empty",
        }
        return path.replace(":path", "").format_map(_Names(names))


class _Names(dict[str, str]):
    def __missing__(self, key: str) -> str:
        return new_job_id()


@pytest.fixture(scope="module")
def keyed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Keyed]:
    settings = Settings(
        data_dir=tmp_path_factory.mktemp("keyed"),
        auth="keys",
        min_free_bytes=0,
        quota_jobs=3,
        quota_bytes=100_000,
    )
    with serve(settings) as live:
        engine = live.services.store.engine
        now = KeyStore(engine)
        keys = {
            "owner": now.create("ann", [Scope.WRITE]),
            "reader": now.create("ann", [Scope.READ]),
            "other": now.create("bob", [Scope.WRITE]),
            "admin": now.create("root", [Scope.ADMIN]),
            "revoked": now.create("ann", [Scope.WRITE]),
            "expired": KeyStore(engine, lambda: time.time() - 90_000).create("ann", [Scope.WRITE], days=1),
        }
        assert now.revoke(keys["revoked"].split("_")[1])
        keys["altered"] = keys["owner"][:-1] + ("A" if keys["owner"][-1] != "A" else "B")
        keys["garbage"] = "mass_not_a_key"
        live.http.headers["Authorization"] = f"Bearer {keys['owner']}"
        job, _ = live.finished()
        upload = live.http.post("/uploads", headers={"Tus-Resumable": "1.0.0", "Upload-Length": "9"})
        hook = live.http.post("/webhooks", json={"url": "https://example.com/hook"}).json()["id"]
        del live.http.headers["Authorization"]
        yield Keyed(live, keys, job, upload.headers["Location"].rpartition("/")[2], hook)


def test_there_is_something_to_test() -> None:
    assert len(PRIVATE) > 9
    assert {path for _, path in OPERATIONS if is_public(path)} >= {"/healthz", "/capabilities"}


@pytest.mark.parametrize("who", ["anonymous", "garbage", "altered", "revoked", "expired"])
@pytest.mark.parametrize(("method", "path"), PRIVATE)
def test_without_a_good_key_nothing_is_answered(keyed: Keyed, who: str, method: str, path: str) -> None:
    before = keyed.live.files()
    answer = keyed.send(who, method, keyed.at(path), content=b"x" * 1000)
    if method == "HEAD":
        assert (answer.status_code, answer.content) == (401, b"")
    else:
        problem(answer, 401, "access.key")
    assert answer.headers["WWW-Authenticate"].startswith("Bearer")
    assert keyed.live.files() == before


@pytest.mark.parametrize(
    ("method", "path"), [(m, p) for m, p in PRIVATE if m not in ("GET", "HEAD", "OPTIONS")]
)
def test_a_reading_key_changes_nothing(keyed: Keyed, method: str, path: str) -> None:
    problem(keyed.send("reader", method, keyed.at(path)), 403, "access.scope")


@pytest.mark.parametrize(("method", "path"), [(m, p) for m, p in PRIVATE if "{" in p])
def test_what_is_anothers_does_not_exist(keyed: Keyed, method: str, path: str) -> None:
    body: dict[str, object] = {"json": {"target": "render"}} if path.endswith("/links") else {}
    answer = keyed.send("other", method, keyed.at(path), **body)
    assert answer.status_code == 404, (method, path, answer.text)
    assert keyed.send("owner", "GET", f"/jobs/{keyed.job}").json()["state"] == "succeeded"


@pytest.mark.parametrize("who", ["owner", "reader", "admin"])
@pytest.mark.parametrize(
    ("method", "path"), [(m, p) for m, p in PRIVATE if m in ("GET", "HEAD") and "{" in p]
)
def test_the_owner_and_the_administrator_see_it(keyed: Keyed, who: str, method: str, path: str) -> None:
    answer = keyed.send(who, method, keyed.at(path))
    assert answer.status_code not in (401, 403), answer.text
    if answer.status_code == 404:
        assert method == "GET"
        assert answer.json()["code"] != "job.not_found"


def test_lists_hold_only_ones_own(keyed: Keyed) -> None:
    def ids(who: str) -> set[str]:
        return {job["id"] for job in keyed.send(who, "GET", "/jobs").json()["jobs"]}

    assert keyed.job in ids("owner") & ids("reader") & ids("admin")
    assert ids("other") == set()


@pytest.mark.parametrize("header", ["", "Bearer", "Basic abc", "Bearer \xff", "bearer mass__", "Bearer ''--"])
def test_odd_authorization_headers(keyed: Keyed, header: str) -> None:
    answer = keyed.live.http.get("/jobs", headers={b"Authorization": header.encode("latin-1")})
    assert answer.status_code in (400, 401)


def test_a_key_in_the_query_counts_for_nothing(keyed: Keyed) -> None:
    query = dict.fromkeys(("token", "key", "access_token", "api_key"), keyed.keys["owner"])
    problem(keyed.live.http.get("/jobs", params=query), 401, "access.key")


def test_an_upload_is_refused_before_a_byte_of_it_is_kept(keyed: Keyed) -> None:
    before = keyed.live.files()
    problem(keyed.send("anonymous", "POST", "/jobs", files={"video": VIDEO * 50}), 401, "access.key")
    problem(keyed.send("reader", "POST", "/jobs", files={"video": VIDEO * 50}), 403, "access.scope")
    assert keyed.live.files() == before


def test_secrets_of_keys_are_nowhere_on_disk_nor_in_the_log(
    keyed: Keyed, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level("DEBUG"):
        keyed.send("owner", "GET", "/jobs")
        keyed.send("altered", "GET", "/jobs")
    for key in keyed.keys.values():
        secret = key.split("_", 2)[-1]
        assert secret not in caplog.text
        for path in keyed.live.services.storage.root.rglob("*"):
            assert not path.is_file() or secret.encode() not in path.read_bytes()


def test_quotas_of_jobs_and_bytes(keyed: Keyed) -> None:
    made = []
    for _ in range(3):
        answer = keyed.send("other", "POST", "/jobs", files={"video": VIDEO})
        assert answer.status_code == 202, answer.text
        made.append(answer.json()["id"])
    before = keyed.live.files()
    answer = keyed.send("other", "POST", "/jobs", files={"video": VIDEO})
    body = problem(answer, 429, "quota.exceeded")
    assert "3 unfinished jobs" in str(body["detail"])
    assert int(answer.headers["Retry-After"]) > 0
    assert keyed.send("owner", "POST", "/jobs", files={"video": VIDEO}).status_code == 202
    for job_id in made:
        assert keyed.send("other", "DELETE", f"/jobs/{job_id}").status_code == 204
    body = problem(keyed.send("other", "POST", "/jobs", files={"video": VIDEO * 10}), 429, "quota.exceeded")
    assert "bytes" in str(body["detail"])
    assert keyed.live.files() != before
    # A body that does not say how long it is reaches the disk, then the check with the row.
    boundary = b'--b\r\nContent-Disposition: form-data; name="video"\r\n\r\n' + VIDEO * 10 + b"\r\n--b--\r\n"
    pieces = keyed.live.http.post(
        "/jobs",
        content=iter([boundary]),
        headers={
            "Authorization": f"Bearer {keyed.keys['other']}",
            "Content-Type": "multipart/form-data; boundary=b",
        },
    )
    problem(pieces, 429, "quota.exceeded")
    assert keyed.send("other", "GET", "/jobs").json()["jobs"] == []


def test_the_quota_of_minutes(tmp_path: Path) -> None:
    settings = Settings(data_dir=tmp_path, auth="keys", min_free_bytes=0, quota_minutes=10)
    with serve(settings) as live:
        key = KeyStore(live.services.store.engine).create("ann", [Scope.WRITE])
        live.http.headers["Authorization"] = f"Bearer {key}"
        job_id = live.submit()
        clock = time.time() - 700
        store = create_store(settings, lambda: clock)
        claim = store.claim(job_id)
        store.close()
        assert claim is not None
        answer = live.http.post("/jobs", files={"video": VIDEO})
        problem(answer, 429, "quota.exceeded")
        live.services.store.finish_cancel(job_id, claim.token)


def test_a_signed_link_opens_one_thing_for_a_while(keyed: Keyed) -> None:
    def link(target: str, seconds: int = 60) -> str:
        body = {"target": target, "seconds": seconds}
        answer = keyed.send("owner", "POST", f"/jobs/{keyed.job}/links", json=body)
        assert answer.status_code == 200, answer.text
        return str(answer.json()["href"])

    http = keyed.live.http
    asset, picture = link("assets/report.json"), link("render?pose=fist&width=64&height=64")
    assert http.get(asset).content == b'{"psnr": 30.0}'
    assert http.get(picture).headers["content-type"] == "image/png"
    problem(http.get(asset.replace("report.json", "surfels.ply")), 403, "access.link")
    problem(http.get(picture.replace("fist", "rest")), 403, "access.link")
    problem(http.get(picture + "&width=1000"), 403, "access.link")
    problem(http.get(asset.replace("expires=1", "expires=2")), 403, "access.link")
    problem(http.get(asset[:-1] + "!"), 403, "access.link")
    problem(http.delete(asset), 401, "access.key")
    problem(http.get(f"/jobs/{keyed.job}?{asset.partition('?')[2]}"), 403, "access.link")


@pytest.mark.parametrize(
    "target", ["", "../x", "cancel", "assets/\x00", "assets/", "https://evil.example", "//x"]
)
def test_what_cannot_be_linked_to(keyed: Keyed, target: str) -> None:
    answer = keyed.send("owner", "POST", f"/jobs/{keyed.job}/links", json={"target": target})
    problem(answer, 422, "request.invalid")


@given(path=st.text(), query=st.text(), now=st.integers(0, 10**9), seconds=st.integers(1, 3600))
def test_links_work_until_they_run_out(path: str, query: str, now: int, seconds: int) -> None:
    signer = Signer(b"secret", lambda: now)
    href, until = signer.sign("/p", query.encode("utf-8", "replace").decode(), seconds)
    signed = href.partition("?")[2]
    assert is_signed(signed)
    assert signer.check("/p", signed)
    assert not Signer(b"other", lambda: now).check("/p", signed)
    assert not Signer(b"secret", lambda: until + 1).check("/p", signed)
    assert not signer.check("/p" + path + "x", signed)


def test_the_secret_is_made_once_and_nobody_else_can_read_it(tmp_path: Path) -> None:
    secret = service_secret("", tmp_path)
    assert len(secret) == 32
    assert service_secret("", tmp_path) == secret
    assert stat.S_IMODE((tmp_path / "run" / "secret").stat().st_mode) == 0o600
    assert service_secret("given", tmp_path) == b"given"


@pytest.mark.parametrize(
    ("auth", "host", "asked"),
    [
        ("auto", "127.0.0.1", False),
        ("auto", "::1", False),
        ("auto", "localhost", False),
        ("auto", "0.0.0.0", True),
        ("auto", "192.168.1.2", True),
        ("auto", "hands.example", True),
        ("keys", "127.0.0.1", True),
        ("open", "0.0.0.0", False),
    ],
)
def test_open_on_loopback_only(auth: str, host: str, asked: bool) -> None:
    assert asks_for_keys(auth, host) is asked  # type: ignore[arg-type]


def test_keys_from_the_command_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("MASS_DATA_DIR", str(tmp_path))
    assert main(["keys", "create", "ann", "--scope", "read", "--days", "2"]) == 0
    key = capsys.readouterr().out.strip()
    assert main(["keys", "list"]) == 0
    listed = capsys.readouterr().out
    assert key.split("_")[1] in listed
    assert key.split("_", 2)[2] not in listed
    store = create_store(Settings(data_dir=tmp_path))
    caller = KeyStore(store.engine).check(key)
    assert caller is not None
    assert (caller.owner, caller.scopes) == ("ann", frozenset({Scope.READ}))
    assert main(["keys", "revoke", key.split("_")[1]]) == 0
    assert KeyStore(store.engine).check(key) is None
    store.close()
    assert main(["keys", "revoke", "nope"]) == 1
    assert main(["keys", "create", "../ann"]) == 2
