"""Write the next migration: ``python scripts/migration.py NAME``, from what the models have and it lacks.

``--initial`` writes the first one anew, which is right only before a release. Look at what was written, and
set HEAD in service/database.py.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

from alembic import command
from alembic.script import ScriptDirectory

from service.database import alembic_config, connect


def main() -> None:
    """Compare with an empty SQLite database that has all migrations, and write the difference."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("name")
    parser.add_argument("--initial", action="store_true")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        engine = connect(f"sqlite:///{folder}/empty.sqlite3", Path(folder))
        with engine.begin() as connection:
            config = alembic_config(connection)
            scripts = ScriptDirectory.from_config(config)
            if options.initial:
                for path in Path(scripts.versions).glob("0*.py"):
                    path.unlink()
            else:
                command.upgrade(config, "head")
            number = f"{len([*Path(scripts.versions).glob('0*.py')]) + 1:04d}"
            command.revision(config, options.name, autogenerate=True, rev_id=number)
        engine.dispose()


if __name__ == "__main__":
    main()
