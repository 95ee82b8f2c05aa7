"""Downloads: what is listed, what is served, ranges, and names that must not work."""

from __future__ import annotations

import hashlib
from pathlib import Path

import pytest

from service.storage import Storage, media_type
from tests.service.conftest import ASSETS, Live, problem


@pytest.fixture(scope="module")
def job(live: Live) -> tuple[str, Path]:
    return live.finished(**{"secret.txt": b"not an asset", "avatar.bin": b"neither"})


PLY = ASSETS["surfels.ply"]


def test_the_list_names_size_and_hash(live: Live, job: tuple[str, Path]) -> None:
    listed = live.http.get(f"/jobs/{job[0]}/assets").json()["assets"]
    assert {asset["name"] for asset in listed} == set(ASSETS)
    for asset in listed:
        content = ASSETS[asset["name"]]
        assert (asset["bytes"], asset["sha256"]) == (len(content), hashlib.sha256(content).hexdigest())
        answer = live.http.get(asset["href"])
        assert answer.content == content
        assert answer.headers["content-type"] == asset["media_type"]
        assert answer.headers["etag"] == f'"{asset["sha256"]}"'
        assert answer.headers["content-disposition"].startswith("attachment;")
        assert answer.headers["x-content-type-options"] == "nosniff"


@pytest.mark.parametrize(
    ("header", "start", "end"),
    [
        ("bytes=0-0", 0, 1),
        ("bytes=100-199", 100, 200),
        ("bytes=300000-", 300_000, None),
        ("bytes=-7", -7, None),
        ("bytes=-9999999", 0, None),
        ("bytes=5-99999999", 5, None),
    ],
)
def test_one_range(live: Live, job: tuple[str, Path], header: str, start: int, end: int | None) -> None:
    answer = live.http.get(f"/jobs/{job[0]}/assets/surfels.ply", headers={"Range": header})
    assert answer.status_code == 206
    assert answer.content == PLY[start:end]
    first = start % len(PLY)
    last = first + len(answer.content) - 1
    assert answer.headers["content-range"] == f"bytes {first}-{last}/{len(PLY)}"


@pytest.mark.parametrize("header", ["bytes=0-1,5-6", "bytes=9-3", "bytes=-", "lines=0-3", "bytes=a-b", "x"])
def test_a_range_that_cannot_be_read_is_ignored(live: Live, job: tuple[str, Path], header: str) -> None:
    answer = live.http.get(f"/jobs/{job[0]}/assets/surfels.ply", headers={"Range": header})
    assert (answer.status_code, answer.content) == (200, PLY)


@pytest.mark.parametrize("header", [f"bytes={len(PLY)}-", "bytes=999999999-", "bytes=-0"])
def test_a_range_outside_the_file_is_416(live: Live, job: tuple[str, Path], header: str) -> None:
    answer = live.http.get(f"/jobs/{job[0]}/assets/surfels.ply", headers={"Range": header})
    problem(answer, 416, "asset.range")
    assert answer.headers["content-range"] == f"bytes */{len(PLY)}"


def test_conditions(live: Live, job: tuple[str, Path]) -> None:
    path = f"/jobs/{job[0]}/assets/surfels.ply"
    etag = live.http.get(path).headers["etag"]
    same = live.http.get(path, headers={"If-None-Match": etag})
    assert (same.status_code, same.content) == (304, b"")
    assert live.http.get(path, headers={"If-None-Match": '"other"'}).status_code == 200
    resumed = live.http.get(path, headers={"Range": "bytes=10-", "If-Range": etag})
    assert (resumed.status_code, resumed.content) == (206, PLY[10:])
    changed = live.http.get(path, headers={"Range": "bytes=10-", "If-Range": '"other"'})
    assert (changed.status_code, changed.content) == (200, PLY)


@pytest.mark.parametrize(
    "name",
    [
        "secret.txt",
        "avatar.bin",
        "assets.json",
        "previews",
        "previews/",
        "previews/none.png",
        "previews/..%2freport.json",
        "..%2f..%2f..%2fmass.sqlite3",
        "%2e%2e/%2e%2e/mass.sqlite3",
        "%2fetc%2fpasswd",
        "report.json%00",
        "report.json%00.png",
        "REPORT.JSON",
        "tracks.json",
        "\u2603" * 100,
    ],
)
def test_other_names_do_not_exist(live: Live, job: tuple[str, Path], name: str) -> None:
    answer = live.http.get(f"/jobs/{job[0]}/assets/{name}")
    assert answer.status_code == 404
    assert answer.headers["content-type"] == "application/problem+json"


def test_links_are_neither_published_nor_followed(live: Live, tmp_path: Path) -> None:
    secret = tmp_path / "secret"
    secret.write_bytes(b"canary")
    job_id, folder = live.finished()
    (folder / "tracks.json").symlink_to(secret)
    (folder / "previews" / "link.png").symlink_to(secret)
    listed = live.services.storage.publish(job_id, folder.name)
    assert {asset.name for asset in listed} == set(ASSETS)
    # A link put in the place of a published file.
    (folder / "report.json").unlink()
    (folder / "report.json").symlink_to(secret)
    problem(live.http.get(f"/jobs/{job_id}/assets/report.json"), 404, "asset.not_found")
    (folder / "previews").rename(tmp_path / "moved")
    (folder / "previews").symlink_to(tmp_path / "moved")
    problem(live.http.get(f"/jobs/{job_id}/assets/previews/rest.png"), 404, "asset.not_found")


def test_an_unfinished_job_has_no_assets(live: Live) -> None:
    job_id = live.submit()
    for path in ("assets", "assets/report.json"):
        problem(live.http.get(f"/jobs/{job_id}/{path}"), 409, "job.not_ready")
    live.http.post(f"/jobs/{job_id}/cancel")
    problem(live.http.get(f"/jobs/{job_id}/assets"), 409, "job.no_result")


def test_storage_refuses_names_it_did_not_make(tmp_path: Path) -> None:
    storage = Storage(tmp_path)
    for job_id in ("..", "a/b", "", "x" * 36):
        with pytest.raises(ValueError, match="not a job id"):
            storage.begin_upload(job_id)
        with pytest.raises(ValueError, match="not a job id"):
            storage.delete_job(job_id)
    good = "01a20419-9ae5-7b66-b781-54fb77f696a8"
    for artifact in ("..", "1-../..", "1", ""):
        with pytest.raises(ValueError, match="not an artifact"):
            storage.attempt_dir(good, artifact)
    for reference in ("../source", f"uploads/{good}/../../x", "/etc/passwd", f"jobs/{good}/source"):
        with pytest.raises(ValueError, match="not an upload"):
            storage.source(reference)
    assert media_type("previews/a/b.png") is None
    assert media_type("previews/.png") is None


def test_dropping_attempts_keeps_the_one_that_counts(tmp_path: Path) -> None:
    storage = Storage(tmp_path)
    job_id = "01a20419-9ae5-7b66-b781-54fb77f696a8"
    for artifact in ("1-a", "2-b"):
        (storage.attempt_dir(job_id, artifact) / "report.json").write_text("{}")
    storage.drop_attempts(job_id, keep="2-b")
    assert [path.name for path in (tmp_path / "jobs" / job_id).iterdir()] == ["2-b"]
    storage.drop_attempts(job_id)
    assert [*(tmp_path / "jobs" / job_id).iterdir()] == []
