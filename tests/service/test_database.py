"""The same tables, the same behaviour, on SQLite and on a real PostgreSQL server."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy import Engine, inspect, text

from service.database import (
    HEAD,
    DatabaseError,
    alembic_config,
    clock_of,
    connect,
    metadata,
    migrate,
    scrub,
)
from service.jobs.store import JobStore, create_store
from service.settings import Settings
from tests.postgres import PostgresServer
from tests.service.test_store import *  # noqa: F403  (every test of the store again, on PostgreSQL)
from tests.service.test_store import Clock


@pytest.fixture(params=["sqlite", "postgresql"])
def url(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """A new database of each kind."""
    if request.param == "sqlite":
        return f"sqlite:///{tmp_path / 'new.sqlite3'}"
    server: PostgresServer = request.getfixturevalue("postgres")
    return server.database()


@pytest.fixture
def engine(url: str, tmp_path: Path) -> Iterator[Engine]:
    engine = connect(url, tmp_path)
    yield engine
    engine.dispose()


@pytest.fixture  # type: ignore[no-redef]
def store(postgres: PostgresServer, tmp_path: Path, clock: Clock) -> Iterator[JobStore]:
    """The fixture of test_store, for the tests that came from there."""
    store = create_store(Settings(data_dir=tmp_path, max_attempts=2, database_url=postgres.database()), clock)
    yield store
    store.close()


def test_the_migrations_make_what_the_models_describe(engine: Engine) -> None:
    migrate(engine)
    with engine.connect() as connection:
        context = MigrationContext.configure(connection, opts={"compare_type": True})
        assert compare_metadata(context, metadata()) == []  # else: python scripts/migration.py NAME
        assert ScriptDirectory.from_config(alembic_config(connection)).get_current_head() == HEAD


def test_of_processes_that_start_at_once_one_migrates(url: str, tmp_path: Path) -> None:
    engines = [connect(url, tmp_path) for _ in range(6)]
    barrier = threading.Barrier(len(engines))

    def start(engine: Engine) -> None:
        barrier.wait()
        migrate(engine)

    with ThreadPoolExecutor(len(engines)) as threads:
        for done in [threads.submit(start, engine) for engine in engines]:
            done.result()
    with engines[0].connect() as connection:
        assert connection.execute(text("SELECT version_num FROM alembic_version")).all() == [(HEAD,)]
    for engine in engines:
        engine.dispose()


def test_a_database_of_a_newer_program_and_one_of_an_unknown_one_are_refused(engine: Engine) -> None:
    migrate(engine)
    with engine.begin() as connection:
        connection.execute(text("UPDATE alembic_version SET version_num = '9999'"))
    with pytest.raises(DatabaseError, match="newer than this program"):
        migrate(engine)
    with engine.begin() as connection:
        connection.execute(text("DROP TABLE alembic_version"))
    with pytest.raises(DatabaseError, match="before the first release"):
        migrate(engine)


def test_a_failed_migration_leaves_nothing_behind(engine: Engine, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object, **__: object) -> None:
        raise RuntimeError("no")

    with monkeypatch.context() as patch:
        patch.setattr("alembic.op.create_index", broken)
        patch.setattr("alembic.operations.base.BatchOperations.create_index", broken)
        with pytest.raises(RuntimeError):
            migrate(engine)
    assert inspect(engine).get_table_names() in ([], ["alembic_version"])
    migrate(engine)
    assert "jobs" in inspect(engine).get_table_names()


def test_leases_go_by_the_servers_clock(postgres: PostgresServer, tmp_path: Path) -> None:
    engine = connect(postgres.database(), tmp_path)
    clock = clock_of(engine)
    with engine.connect() as connection:
        before = connection.execute(text("SELECT extract(epoch FROM clock_timestamp())")).scalar_one()
    assert float(before) <= clock()
    engine.dispose()


def test_a_video_of_more_than_two_gigabytes_is_counted(engine: Engine) -> None:
    migrate(engine)
    store = JobStore(engine)
    job = store.create({}, "v", video_bytes=5 * 1024**3)
    found = store.get(job.id)
    assert found is not None
    assert found.video_bytes == 5 * 1024**3


def test_of_many_claims_at_once_on_postgresql_exactly_one_wins(
    postgres: PostgresServer, tmp_path: Path
) -> None:
    settings = Settings(data_dir=tmp_path, max_attempts=3, database_url=postgres.database())
    stores = [create_store(settings) for _ in range(6)]
    with ThreadPoolExecutor(len(stores)) as threads:
        for _ in range(20):
            job = stores[0].create({}, "v")
            tries: list[Callable[[str], object]] = [store.claim for store in stores]
            won = [claim for claim in threads.map(lambda take, i=job.id: take(i), tries) if claim]
            assert len(won) == 1
    for store in stores:
        store.close()


def test_a_connection_that_broke_is_replaced(postgres: PostgresServer, tmp_path: Path) -> None:
    store = create_store(Settings(data_dir=tmp_path, database_url=postgres.database()))
    job = store.create({}, "v")
    with store.engine.connect() as connection:
        connection.execute(
            text("SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE pid <> pg_backend_pid()")
        )
    assert store.get(job.id) is not None
    store.close()


def test_nothing_of_a_removed_row_stays_in_sqlites_files(tmp_path: Path) -> None:
    store = create_store(Settings(data_dir=tmp_path))
    job = store.create({}, "v")
    claim = store.claim(job.id)
    assert claim is not None
    canary = "c4n4ry-" + "7" * 40
    store.report_progress(job.id, claim.token, "fit", 0.5, None, canary)
    store.fail(job.id, claim.token, "x", canary, canary)
    assert any(canary.encode() in path.read_bytes() for path in tmp_path.rglob("*") if path.is_file())
    store.delete(job.id)
    assert store.purge(job.id)
    scrub(store.engine)
    assert not [
        path for path in tmp_path.rglob("*") if path.is_file() and canary.encode() in path.read_bytes()
    ]
    store.close()
