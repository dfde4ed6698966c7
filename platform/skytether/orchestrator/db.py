"""The engine, and bringing a database to the present schema."""

from __future__ import annotations

from typing import Any

from sqlalchemy import Connection, Engine, create_engine, event


def make_engine(url: str) -> Engine:
    """An engine for SQLite or PostgreSQL.

    SQLite: write-ahead log, so that readers and the one writer do not wait for each other, and a commit that needs no
    sync to disk (a power cut may lose the last moments, a crash of the program does not). Transactions on an engine
    with the execution option ``immediate`` take the write lock at their begin: taking it later can fail at once.
    """
    engine = create_engine(url)
    if engine.dialect.name == "sqlite":
        event.listen(engine, "connect", _set_up_sqlite)
        event.listen(engine, "begin", _begin_sqlite)
    return engine


def _set_up_sqlite(connection: Any, _: Any) -> None:
    connection.isolation_level = None  # the driver's own idea of transactions off; _begin_sqlite says when
    for pragma in ("journal_mode=WAL", "synchronous=NORMAL", "foreign_keys=ON", "busy_timeout=10000"):
        connection.execute(f"PRAGMA {pragma}")


def _begin_sqlite(connection: Connection) -> None:
    immediate = connection.get_execution_options().get("immediate", False)
    connection.exec_driver_sql("BEGIN IMMEDIATE" if immediate else "BEGIN")


def migrate(engine: Engine) -> None:
    """Bring the database to the newest schema; does nothing to one that has it."""
    from alembic import command  # Alembic is slow to import, and only needed here
    from alembic.config import Config

    config = Config()
    config.set_main_option("script_location", "skytether.orchestrator:migrations")
    config.set_main_option("path_separator", "os")
    with engine.begin() as connection:
        config.attributes["connection"] = connection
        command.upgrade(config, "head")
