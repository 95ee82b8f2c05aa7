"""More than one machine: PostgreSQL, an object store, a broker by URL, and nothing else in common."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from service.jobs.housekeeping import purge_deleted
from service.jobs.retention import enforce
from service.jobs.store import create_store
from service.settings import Settings
from service.storage import Storage, create_storage
from tests.postgres import PostgresServer
from tests.s3 import S3Server
from tests.worker.fake_engine import FILES
from tests.worker.harness import Bench, wait_for

CANARY = "c4n4ry-" + "5" * 40


@pytest.fixture
def cluster(postgres: PostgresServer, s3: S3Server) -> Iterator[Bench]:
    """A bench whose own disk is one machine's; workers may be given another."""
    bench = Bench(database_url=postgres.database(), storage_url=s3.bucket(versions=True))
    yield bench
    bench.close()


def _machine(bench: Bench, name: str) -> dict[str, str]:
    """The environment of a process on another machine."""
    (bench.root / name).mkdir(exist_ok=True)
    return {"MASS_DATA_DIR": str(bench.root / name)}


def _files(folder: Path) -> list[Path]:
    return [path for path in folder.rglob("*") if path.is_file()]


def test_a_job_submitted_on_one_machine_is_done_on_another_and_read_on_a_third(cluster: Bench) -> None:
    job_id = cluster.submit(gated=True)
    assert not (cluster.settings.data_dir / "uploads" / job_id).exists()  # it is in the store
    cluster.worker(**_machine(cluster, "worker-a"))
    cluster.engine(job_id)
    cluster.open_gate(job_id)
    job = cluster.until(job_id, "succeeded")
    assert job.artifact is not None
    third = create_storage(cluster.settings.model_copy(update={"data_dir": cluster.root / "api"}))
    assert {asset.name for asset in third.assets(job_id, job.artifact)} == set(FILES)
    opened = third.open_asset(job_id, job.artifact, "surfels.ply")
    assert opened is not None
    assert opened[1].read_bytes() == FILES["surfels.ply"]
    assert third.open_asset(job_id, job.artifact, "tracks.json") is None
    folder = third.published(job_id, job.artifact)
    assert (folder / "avatar.safetensors").read_bytes() == FILES["avatar.safetensors"]


def test_a_deploy_moves_a_job_to_another_machine_which_goes_on_from_the_checkpoint(cluster: Bench) -> None:
    first = cluster.worker(**_machine(cluster, "worker-a"))
    job_id = cluster.submit("steps", gated=True)
    wait_for("it is halfway", lambda: "halfway" in cluster.words(job_id))
    assert first.end() == 0
    cluster.worker(**_machine(cluster, "worker-b"))
    cluster.until(job_id, "succeeded")
    assert [word for word in cluster.words(job_id) if word in ("begin", "resume")] == ["begin", "resume"]
    steps = [word for word in cluster.words(job_id) if word.startswith("step:")]
    assert steps == [f"step:{number}" for number in range(10)]


def test_kill_9_of_a_whole_machine_loses_nothing(cluster: Bench) -> None:
    first = cluster.worker(**_machine(cluster, "worker-a"))
    job_id = cluster.submit("steps", gated=True)
    wait_for("it is halfway", lambda: "halfway" in cluster.words(job_id))
    first.kill()
    cluster.worker(**_machine(cluster, "worker-b"))
    cluster.engine(job_id, 2)
    cluster.open_gate(job_id)
    assert cluster.until(job_id, "succeeded").attempt == 2


@pytest.mark.parametrize("kind", ["one machine", "several machines"])
def test_delete_leaves_no_byte_of_a_canary(kind: str, postgres: PostgresServer, s3: S3Server) -> None:
    """In the video, in the results, in a checkpoint, and in what the engine said."""
    several = kind == "several machines"
    url = s3.bucket(versions=True)
    more = {"database_url": postgres.database(), "storage_url": url} if several else {}
    bench = Bench(**more)
    try:
        other = {**_machine(bench, "worker-a")} if several else {}
        worker = bench.worker(**other)
        job_id = bench.job("canary", canary=CANARY, gated=True)
        bench.publish(job_id)
        wait_for("it has said it", lambda: CANARY in bench.row(job_id).message)
        assert worker.end() == 0  # so that its checkpoint is kept
        bench.worker(**other)
        bench.engine(job_id, 2)
        bench.open_gate(job_id)
        job = bench.until(job_id, "succeeded")
        assert job.artifact is not None
        reader = create_storage(bench.settings)
        reader.published(job_id, job.artifact)
        places = [bench.settings.data_dir, bench.root / "worker-a"]
        assert [path for place in places for path in _files(place) if CANARY.encode() in path.read_bytes()]
        assert bench.store.delete(job_id)
        purge_deleted(bench.store, bench.storage)
        for folder in places if several else []:
            # What the sweep of each machine does; it waits a while for directories just made.
            _forget(bench, folder)
        wait_for("the row is gone", lambda: not bench.store.known({job_id}))

        def left() -> list[Path]:
            return [
                path for place in places for path in _files(place) if CANARY.encode() in path.read_bytes()
            ]

        wait_for(f"no file has it any more: {left()}", lambda: not left())
        if several:
            assert [key for key, content in s3.contents(url).items() if CANARY.encode() in content] == []
        assert CANARY not in bench.logs()
    finally:
        bench.close()


def _forget(bench: Bench, folder: Path) -> None:
    storage = Storage(folder)
    here = {*storage.local_jobs(-1.0)}
    for job_id in here - bench.store.known(here):
        storage.drop_local(job_id)


def test_each_kind_is_kept_for_its_time(tmp_path: Path) -> None:
    now = [1_000_000.0]
    settings = Settings(
        data_dir=tmp_path, keep_video_seconds=100, keep_checkpoint_seconds=50, keep_job_seconds=1000
    )
    store = create_store(settings, lambda: now[0])
    storage = create_storage(settings)
    ids = {}
    for name in ("done", "failed"):
        job = store.create({}, "later")
        storage.begin_upload(job.id).write_bytes(b"video")
        storage.finish_upload(job.id)
        claim = store.claim(job.id)
        assert claim is not None
        run = storage.attempt_dir(job.id, claim.artifact)
        (run / "checkpoint").mkdir()
        (run / "checkpoint" / "state").write_bytes(b"state")
        if name == "done":
            (run / "report.json").write_text(json.dumps({}))
            storage.publish(job.id, claim.artifact)
            assert store.succeed(job.id, claim.token, claim.artifact)
        else:
            assert store.fail(job.id, claim.token, "x", "y", "z")
        ids[name] = job.id

    def state() -> list[bool]:
        return [bool(_files(tmp_path / kind / ids[name])) for name in ids for kind in ("uploads", "jobs")]

    enforce(settings, store, storage)
    assert state() == [True, True, True, True]
    now[0] += 51
    enforce(settings, store, storage)
    assert state() == [True, True, True, False]  # the failed one's checkpoint
    now[0] += 50
    enforce(settings, store, storage)
    assert state() == [False, True, False, False]  # the videos
    assert store.get(ids["done"]) is not None
    now[0] += 1000
    enforce(settings, store, storage)
    assert store.get(ids["done"]) is None
    purge_deleted(store, storage)
    assert state() == [False, False, False, False]
    assert not store.known({*ids.values()})
    store.close()
