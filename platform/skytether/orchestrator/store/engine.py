"""The engine, and bringing a database to the present schema."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Any, cast

from pydantic_core import from_json, to_json
from sqlalchemy import URL, Connection, Engine, create_engine, event, make_url, text
from sqlalchemy.exc import InterfaceError, OperationalError, SQLAlchemyError
from sqlalchemy.exc import TimeoutError as NoConnectionError

from ..domain.errors import OutdatedError

if TYPE_CHECKING:
    from alembic.config import Config

GONE = (OperationalError, InterfaceError, NoConnectionError)
"""What is raised when the database does not answer (or, SQLite, its disk is full), or all connections wait for it."""

_LOCK_MS = 120_000
"""How long a migration waits for a table, or for another migration."""
MIGRATING = 0x736B7901
"""Key of PostgreSQL's advisory lock of who migrates."""
ADMITTING = 0x736B7902
"""Of who counts what there is, to add to it."""
STATEMENT_S = 10
"""Seconds that PostgreSQL gives a statement before it ends it."""
_PATIENCE_S = STATEMENT_S + 2.0
"""Seconds without an answer after which a server hangs, or is gone without a word: it would have ended a statement."""
_POSTGRES = {
    "client_encoding": "utf8",
    "connect_timeout": 5,
    "keepalives_idle": 5,
    "keepalives_interval": 2,
    "keepalives_count": 3,
    "tcp_user_timeout": 10_000,
    "options": f"-c statement_timeout={STATEMENT_S * 1000} -c idle_in_transaction_session_timeout=5000"
    " -c tcp_keepalives_idle=5 -c tcp_keepalives_interval=2 -c tcp_keepalives_count=3"
    " -c tcp_user_timeout=10000",
}
"""A server that is gone is noticed within seconds, and by a server a leader that is gone; for one that hangs see
``postgres.py``. In a database without an encoding (``SQL_ASCII``) text would come back as bytes."""


_DRIVERS = {"postgresql": "postgresql+psycopg", "postgres": "postgresql+psycopg", "sqlite": "sqlite"}
"""By the schemes that people write; ``postgres`` is libpq's other name."""
SQLITE_PATIENCE = 10
"""Seconds that a statement waits for another program that writes."""


def _json(document: Any) -> str:
    return to_json(document).decode()


_JSON: dict[str, Any] = {"json_serializer": _json, "json_deserializer": from_json}
"""Pydantic's reader and writer take half and a quarter of the time of Python's, and each renewal needs both. What they
refuse (half a character, hundreds of levels) was refused before it was stored."""


class AddressError(Exception):
    """Where the database is said to be, none can be; one sentence with what to write, without passwords."""


def _address(url: str) -> URL:
    try:
        address = make_url(url)
        if "@" in (address.host or ""):  # of a password, which would be told as part of a host's name
            raise AddressError("the database address cannot be used: write an @ of its password as %40")
        return address.set(drivername=_DRIVERS[address.get_backend_name()])
    except (SQLAlchemyError, ValueError, KeyError) as error:
        raise AddressError(
            "the database address cannot be used: write postgresql://USER@HOST/NAME or sqlite:///PATH"
        ) from error


def make_engine(url: str, *, tried: bool = True, patience_s: float | None = None) -> Engine:
    """An engine for SQLite or PostgreSQL.

    SQLite: write-ahead log, so that readers and the one writer do not wait for each other, and a commit that needs no
    sync to disk (a power cut may lose the last moments, a crash of the program does not). Transactions on an engine
    with the execution option ``immediate`` take the write lock at their begin: taking it later can fail at once.

    PostgreSQL: a connection is tried before it is used, for the server may have been restarted since; the server lists
    it as ``skytether``. Not ``tried``, a statement is answered sooner, and fails where the server was restarted. A
    connection without an answer for ``patience_s`` seconds is given up; None: after as long as a statement may take.

    Raises:
        AddressError: It is neither's address, or the driver is not installed.
    """
    address = _address(url)
    if address.get_backend_name() == "postgresql":
        connect_args = {**_POSTGRES, "application_name": "skytether"}
        try:
            made = create_engine(address, pool_pre_ping=tried, connect_args=connect_args, **_JSON)
            from .postgres import Server, gone  # its driver is an extra
        except ImportError as error:
            raise AddressError(
                f"PostgreSQL's driver cannot be loaded ({error}): pip install 'skytether[postgres]', or use SQLite"
            ) from error

        event.listen(made, "do_connect", Server(patience_s or _PATIENCE_S).connect)
        event.listen(made, "handle_error", gone)
        return made
    engine = create_engine(address, **_JSON)
    if engine.dialect.name == "sqlite":
        event.listen(engine, "connect", _set_up_sqlite)
        event.listen(engine, "begin", _begin_sqlite)
    return engine


def _set_up_sqlite(connection: Any, _: Any) -> None:
    connection.isolation_level = None  # the driver's own idea of transactions off; _begin_sqlite says when
    for pragma in (
        "journal_mode=WAL",
        "synchronous=NORMAL",
        "foreign_keys=ON",
        f"busy_timeout={SQLITE_PATIENCE * 1000}",
    ):
        connection.execute(f"PRAGMA {pragma}")


def _begin_sqlite(connection: Connection) -> None:
    options = connection.get_execution_options()
    if not options.get("reading", False):
        connection.exec_driver_sql("BEGIN IMMEDIATE" if options.get("immediate", False) else "BEGIN")


def reading(engine: Engine) -> Engine:
    """The same database for statements that only read, each by itself: with no transaction around it."""
    if engine.dialect.name == "postgresql":
        return engine.execution_options(isolation_level="AUTOCOMMIT")
    return engine.execution_options(reading=True)


def migrate(engine: Engine, to: str = "head") -> str:
    """Bring the database to the newest schema; does nothing to one that has it. One at a time, where several start.

    Returns:
        The newest schema that this code knows.

    Raises:
        OutdatedError: The database has one that it does not know.
    """
    from alembic import command  # Alembic is slow to import, and only needed here
    from alembic.runtime.migration import MigrationContext
    from alembic.script.revision import ResolutionError
    from alembic.util import CommandError

    config, newest = _alembic(), _newest()
    with engine.execution_options(immediate=True).begin() as connection:
        if engine.dialect.name == "postgresql":
            # A large table takes its time; requests of others that run still are waited for, but not for ever.
            cast(Any, connection.connection.driver_connection).patience_s = None
            connection.detach()  # closed at the end, and not used for what has to be quick
            connection.execute(text(f"SET LOCAL statement_timeout = 0; SET LOCAL lock_timeout = {_LOCK_MS}"))
            connection.execute(text(f"SELECT pg_advisory_xact_lock({MIGRATING})"))
        if to == "head" and MigrationContext.configure(connection).get_current_heads() == (newest,):
            return newest
        config.attributes["connection"] = connection
        try:
            command.upgrade(config, to)
        except CommandError as error:
            if isinstance(error.__cause__, ResolutionError):  # the database's revision: ours are all known
                raise OutdatedError from error
            raise
    return newest


@cache
def _newest() -> str:
    """The newest schema that this code knows."""
    from alembic.script import ScriptDirectory

    return str(ScriptDirectory.from_config(_alembic()).get_current_head())


def _alembic() -> Config:
    from alembic.config import Config

    config = Config()
    config.set_main_option("script_location", "skytether.orchestrator.store:migrations")
    config.set_main_option("path_separator", "os")
    return config
