"""The database: SQLite beside the files, or PostgreSQL by URL; opened, and brought to its newest form.

The form is that of the migrations (service/migrations), for both kinds alike. Any number of processes may
start at once: one of them migrates while the others wait. A database that a newer version of the program has
already changed is refused.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any

from sqlalchemy import Connection, Engine, MetaData, create_engine, event, inspect, text

from service.settings import Settings

#: The newest migration.
HEAD = "0001"
#: The modules that define tables.
_TABLES = (
    "service.access.keys",
    "service.jobs.figures",
    "service.jobs.idempotency",
    "service.jobs.journal",
    "service.jobs.model",
    "service.tus.rows",
    "service.webhooks.outbox",
)
_MIGRATIONS = Path(__file__).parent / "migrations"
#: Any number will do, so long as everyone uses the same.
_LOCK = 0x4D415353


class DatabaseError(Exception):
    """The database is not one this program can work with. ``advice`` says what to do about it."""

    def __init__(self, message: str, advice: str) -> None:
        super().__init__(f"{message} {advice}")
        self.message = message
        self.advice = advice


def open_database(settings: Settings) -> Engine:
    """Connect and migrate. Raises DatabaseError, and SQLAlchemyError when it cannot be reached."""
    engine = connect(settings.database, settings.data_dir)
    migrate(engine)
    return engine


def connect(url: str, data_dir: Path) -> Engine:
    """An engine for ``url``; ``postgresql://`` means the driver we bring along."""
    if url.startswith("sqlite"):
        data_dir.mkdir(parents=True, exist_ok=True)
        engine = create_engine(url, connect_args={"timeout": 30.0})
        event.listen(engine, "connect", _prepare_sqlite)
        return engine
    for short in ("postgres://", "postgresql://"):
        if url.startswith(short):
            url = "postgresql+psycopg://" + url.removeprefix(short)
    # Tested before use, because a server restarts while clients keep their connections.
    return create_engine(url, pool_pre_ping=True, connect_args={"connect_timeout": 10})


def clock_of(engine: Engine) -> Callable[[], float]:
    """The clock that leases go by: the server's, where several machines share one; else this machine's."""
    if engine.dialect.name == "sqlite":
        return time.time
    statement = text("SELECT extract(epoch FROM clock_timestamp())")

    def now() -> float:
        with engine.connect() as connection:
            return float(connection.execute(statement).scalar_one())

    return now


def metadata() -> MetaData:
    """All tables of the program."""
    for name in _TABLES:
        import_module(name)
    from service.jobs.model import Base

    return Base.metadata


def migrate(engine: Engine) -> None:
    """Bring the database to :data:`HEAD`. Raises DatabaseError when it is not one of ours, or newer."""
    with engine.connect() as connection:
        if _revision(connection) == HEAD:
            return
    with _alone(engine) as connection:
        found = _revision(connection)
        if found == HEAD:
            return  # another process was faster
        # Slow to import, and needed once.
        from alembic import command
        from alembic.script import ScriptDirectory
        from alembic.util.exc import CommandError

        config = alembic_config(connection)
        if found is None and "jobs" in inspect(connection).get_table_names():
            raise DatabaseError(
                "The database was made by a version before the first release.",
                "Move it away, or choose another with MASS_DATABASE_URL or --data-dir.",
            )
        try:
            if found is not None:
                ScriptDirectory.from_config(config).get_revision(found)
        except CommandError as error:
            raise DatabaseError(
                f"The database has form {found}, which is newer than this program.", "Update the program."
            ) from error
        command.upgrade(config, HEAD)


def alembic_config(connection: Connection) -> Any:
    """Alembic's configuration, working through ``connection``."""
    from alembic.config import Config

    config = Config()
    config.set_main_option("script_location", str(_MIGRATIONS).replace("%", "%%"))
    config.attributes["connection"] = connection
    return config


def scrub(engine: Engine) -> None:
    """Leave nothing of removed rows in SQLite's log; PostgreSQL overwrites them in its own time (VACUUM)."""
    if engine.dialect.name == "sqlite":
        with engine.connect() as connection:
            connection.exec_driver_sql("PRAGMA wal_checkpoint(TRUNCATE)")


def _revision(connection: Connection) -> str | None:
    if "alembic_version" not in inspect(connection).get_table_names():
        return None
    return connection.execute(text("SELECT version_num FROM alembic_version")).scalar()


@contextmanager
def _alone(engine: Engine) -> Iterator[Connection]:
    """A transaction that no other process migrates beside."""
    if engine.dialect.name == "sqlite":
        with engine.connect().execution_options(isolation_level="AUTOCOMMIT") as connection:
            # SQLAlchemy would begin later, with the first write.
            connection.exec_driver_sql("BEGIN IMMEDIATE")
            try:
                yield connection
            except BaseException:
                connection.exec_driver_sql("ROLLBACK")
                raise
            connection.exec_driver_sql("COMMIT")
        return
    with engine.begin() as connection:
        connection.execute(text("SELECT pg_advisory_xact_lock(:key)"), {"key": _LOCK})
        yield connection


def _prepare_sqlite(connection: Any, _record: Any) -> None:
    cursor = connection.cursor()
    # synchronous=FULL: a job answered with 202 must survive a power cut; writes are few. secure_delete: what
    # is removed is overwritten.
    for pragma in (
        *("journal_mode=WAL", "synchronous=FULL", "foreign_keys=ON", "busy_timeout=30000"),
        "secure_delete=ON",
    ):
        cursor.execute(f"PRAGMA {pragma}")
    cursor.close()
