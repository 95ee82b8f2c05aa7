"""A PostgreSQL server of a test session's own: Debian's, on a unix socket, never synchronised to disk."""

from __future__ import annotations

import os
import pwd
import shutil
import subprocess
import tempfile
from pathlib import Path

from sqlalchemy import create_engine, text

from tests.worker.harness import wait_for


def find_program(name: str) -> str:
    """``initdb`` or ``postgres``: from PATH, else where Debian keeps them. Fails when there is none."""
    found = shutil.which(name)
    if found is not None:
        return found
    installed = sorted(Path("/usr/lib/postgresql").glob(f"*/bin/{name}"), reverse=True)
    assert installed, "these tests need PostgreSQL: apt-get install postgresql"
    return str(installed[0])


class PostgresServer:
    """Started empty; every test gets a database of its own."""

    def __init__(self) -> None:
        self.root = Path(tempfile.mkdtemp(prefix="mass-pg-", dir="/tmp"))
        # The server refuses to run as root.
        self._user = "postgres" if os.geteuid() == 0 else None
        if self._user is not None:
            entry = pwd.getpwnam(self._user)
            os.chown(self.root, entry.pw_uid, entry.pw_gid)
        self.root.chmod(0o700)
        self._count = 0
        options = ["-D", str(self.root / "data"), "-U", "mass", "-A", "trust", "--no-sync", "-E", "UTF8"]
        subprocess.run(
            [find_program("initdb"), *options],
            user=self._user,
            cwd="/",
            check=True,
            capture_output=True,
            timeout=300,
        )
        log = (self.root / "server.log").open("wb")
        self._process = subprocess.Popen(
            [
                *(find_program("postgres"), "-D", str(self.root / "data"), "-k", str(self.root)),
                *("-c", "listen_addresses=", "-c", "fsync=off", "-c", "max_connections=200"),
            ],
            user=self._user,
            cwd="/",
            stdout=log,
            stderr=subprocess.STDOUT,
        )
        log.close()
        wait_for("PostgreSQL answers", self._answers, 120.0)

    def _answers(self) -> bool:
        assert self._process.poll() is None, (self.root / "server.log").read_text(errors="replace")
        try:
            self._run("SELECT 1")
        except Exception:
            return False
        return True

    def _run(self, statement: str) -> None:
        url = f"postgresql+psycopg://mass@/postgres?host={self.root}"
        engine = create_engine(url, isolation_level="AUTOCOMMIT")
        try:
            with engine.connect() as connection:
                connection.execute(text(statement))
        finally:
            engine.dispose()

    def database(self) -> str:
        """The URL of a new, empty database."""
        self._count += 1
        name = f"test{self._count}"
        self._run(f"CREATE DATABASE {name}")
        return f"postgresql://mass@/{name}?host={self.root}"

    def close(self) -> None:
        self._process.terminate()
        try:
            self._process.wait(30)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        shutil.rmtree(self.root, ignore_errors=True)
