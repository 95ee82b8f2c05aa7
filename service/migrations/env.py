"""Runs the migrations through the connection that service/database.py (or scripts/migration.py) gives."""

from __future__ import annotations

from alembic import context

from service.database import metadata

connection = context.config.attributes["connection"]
context.configure(
    connection=connection,
    target_metadata=metadata(),
    # SQLite cannot change a column: the table is copied.
    render_as_batch=connection.dialect.name == "sqlite",
    # Who opened the connection began the transaction, and ends it.
    transactional_ddl=False,
)
context.run_migrations()
