"""One contract, every kind of object store."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from service.blobs import BlobError, BlobMissingError, BlobStore, LocalBlobs, S3Blobs, open_blobs
from tests.s3 import S3Server


@pytest.fixture(params=["file", "s3", "s3 with versions"])
def url(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    if request.param == "file":
        return f"file://{tmp_path}/shared%20folder"
    server: S3Server = request.getfixturevalue("s3")
    return server.bucket(versions="versions" in request.param)


@pytest.fixture
def blobs(url: str) -> BlobStore:
    return open_blobs(url)


def _put(blobs: BlobStore, key: str, content: bytes, folder: Path) -> None:
    source = folder / "source"
    source.write_bytes(content)
    blobs.put(key, source)


def _get(blobs: BlobStore, key: str, folder: Path) -> bytes:
    blobs.get(key, folder / "target")
    return (folder / "target").read_bytes()


@pytest.mark.parametrize("size", [0, 1, 9 * 1024**2])  # the last one goes to S3 in two parts
def test_what_goes_in_comes_out(blobs: BlobStore, tmp_path: Path, size: int) -> None:
    content = os.urandom(size)
    _put(blobs, "jobs/a/report.json", content, tmp_path)
    assert _get(blobs, "jobs/a/report.json", tmp_path) == content
    assert [(blob.key, blob.bytes) for blob in blobs.listing("jobs/")] == [("jobs/a/report.json", size)]


def test_a_second_object_replaces_the_first(blobs: BlobStore, tmp_path: Path) -> None:
    _put(blobs, "a/b", b"first", tmp_path)
    _put(blobs, "a/b", b"second", tmp_path)
    assert _get(blobs, "a/b", tmp_path) == b"second"


def test_what_is_not_there_is_missing_and_leaves_the_target_alone(blobs: BlobStore, tmp_path: Path) -> None:
    (tmp_path / "target").write_bytes(b"before")
    with pytest.raises(BlobMissingError):
        blobs.get("no/such", tmp_path / "target")
    assert (tmp_path / "target").read_bytes() == b"before"
    assert sorted(path.name for path in tmp_path.iterdir() if path.is_file()) == ["target"]
    assert [*blobs.listing("no/")] == []
    assert blobs.delete("no/") == 0


def test_deleting_a_prefix_removes_that_and_no_other(blobs: BlobStore, tmp_path: Path) -> None:
    for key in ("jobs/a/1", "jobs/a/sub/2", "jobs/ab/3", "uploads/a/4"):
        _put(blobs, key, key.encode(), tmp_path)
    assert blobs.delete("jobs/a/") == 2
    left = [blob.key for prefix in ("jobs/", "uploads/") for blob in blobs.listing(prefix)]
    assert left == ["jobs/ab/3", "uploads/a/4"]
    assert blobs.delete("jobs/a/") == 0


def test_more_than_a_page_of_objects_is_listed_and_deleted(blobs: BlobStore, tmp_path: Path) -> None:
    source = tmp_path / "source"
    source.write_bytes(b"x")
    with ThreadPoolExecutor(8) as threads:
        [*threads.map(lambda number: blobs.put(f"many/{number:04d}", source), range(1010))]
    assert [blob.key for blob in blobs.listing("many/")] == [f"many/{number:04d}" for number in range(1010)]
    assert blobs.delete("many/") == 1010
    assert [*blobs.listing("many/")] == []


@pytest.mark.parametrize(
    "key", ["", "/a", "../a", "a/../b", "a//b", "a/", ".hidden", "a/.b", "a\x00", "ä", "a b"]
)
def test_what_is_no_key_is_refused(blobs: BlobStore, tmp_path: Path, key: str) -> None:
    with pytest.raises(ValueError, match="not a key"):
        _put(blobs, key, b"", tmp_path)
    with pytest.raises(ValueError, match="not a key"):
        blobs.get(key, tmp_path / "target")


@pytest.mark.parametrize("prefix", ["", "a", "../", "a/../"])
def test_what_is_no_prefix_is_refused(blobs: BlobStore, prefix: str) -> None:
    with pytest.raises(ValueError, match=r"not a (key|prefix)"):
        blobs.delete(prefix)
    with pytest.raises(ValueError, match=r"not a (key|prefix)"):
        [*blobs.listing(prefix)]


def test_a_bucket_that_is_not_there_and_a_server_that_is_not_are_errors_of_ours(
    s3: S3Server, tmp_path: Path
) -> None:
    (tmp_path / "source").write_bytes(b"x")
    for blobs in (
        S3Blobs("nobody-made-it", endpoint=s3.endpoint),
        S3Blobs("b", endpoint="http://127.0.0.1:9"),
    ):
        with pytest.raises(BlobError):
            blobs.put("a/b", tmp_path / "source")
        with pytest.raises(BlobError):
            [*blobs.listing("a/")]


def test_an_object_removed_from_a_bucket_with_versions_is_gone_with_all_of_them(
    s3: S3Server, tmp_path: Path
) -> None:
    url = s3.bucket(versions=True)
    blobs = open_blobs(url)
    for content in (b"canary one", b"canary two"):
        _put(blobs, "jobs/a/secret", content, tmp_path)
    assert len(s3.contents(url)) == 2
    blobs.delete("jobs/a/")
    assert s3.contents(url) == {}


def test_a_full_disk_leaves_no_part(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    blobs = LocalBlobs(tmp_path / "shared")
    (tmp_path / "source").write_bytes(b"x")

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("service.blobs.os.fsync", full)
    with pytest.raises(BlobError) as caught:
        blobs.put("a/b", tmp_path / "source")
    assert caught.value.errno == 28
    assert [path for path in (tmp_path / "shared").rglob("*") if path.is_file()] == []


@pytest.mark.parametrize(
    "url", ["", "/folder", "file://host/folder", "ftp://x/y", "s3:///prefix", "gs://bucket"]
)
def test_an_unknown_place_is_refused(url: str) -> None:
    with pytest.raises(BlobError):
        open_blobs(url)
