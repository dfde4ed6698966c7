"""A PostgreSQL server that hangs: its connections stay open, and whoever waits for an answer would wait for ever.

Keepalives and ``tcp_user_timeout`` (see ``engine.py``) notice a machine or a network that is gone. A server that is
frozen, or waits for its disk, is not noticed so: its kernel goes on acknowledging.
"""

from __future__ import annotations

import threading
from typing import Any

import psycopg
from psycopg.abc import RV, PQGen
from psycopg.errors import ConnectionTimeout, IdleInTransactionSessionTimeout, ReadOnlySqlTransaction, _WaitTimeout
from sqlalchemy.engine import ExceptionContext
from sqlalchemy.exc import OperationalError
from typing_extensions import override


class Server:
    """Makes the connections to one server; while that hangs one at a time, and refuses others at once."""

    def __init__(self, patience_s: float) -> None:
        """``patience_s``: for an answer."""
        self._patience_s = patience_s
        self._trying = threading.Lock()
        self.hangs = False

    def connect(self, _dialect: Any, _record: Any, arguments: Any, parameters: Any) -> Connection:
        """For SQLAlchemy's event ``do_connect``.

        Raises:
            psycopg.OperationalError: There is no connection to be had now.
        """
        if not self.hangs:
            return self._connect(*arguments, **parameters)
        if not self._trying.acquire(blocking=False):
            raise psycopg.OperationalError("the server does not answer")
        try:
            return self._connect(*arguments, **parameters)
        finally:
            self._trying.release()

    def _connect(self, *arguments: Any, **parameters: Any) -> Connection:
        try:
            made = Connection.connect(*arguments, **parameters)
        except ConnectionTimeout:
            self.hangs = True
            raise
        self.hangs = False
        made.server, made.patience_s = self, self._patience_s
        return made


def gone(context: ExceptionContext) -> OperationalError | None:
    """For SQLAlchemy's event ``handle_error``: what the driver files under mistakes, and is a database that is away.

    The server ended a transaction of a program that was frozen meanwhile; or it takes no changes, as one that another
    was promoted over, or is to be soon: whoever connects anew may find that one.
    """
    error = context.original_exception
    if isinstance(error, ReadOnlySqlTransaction):
        context.is_disconnect = True
    elif not isinstance(error, IdleInTransactionSessionTimeout):
        return None
    return OperationalError(context.statement, context.parameters, error)


class Connection(psycopg.Connection[Any]):
    """One whose server has to answer in time."""

    server: Server | None = None
    patience_s: float | None = None
    """None: it may take its time."""

    @override
    def wait(self, gen: PQGen[RV], interval: float = 0.1, timeout: float | None = None) -> RV:
        try:
            return super().wait(gen, interval, self.patience_s if timeout is None else timeout)
        except _WaitTimeout:
            if timeout is not None:
                raise
            if self.server is not None:
                self.server.hangs = True
            self.close()  # nobody knows what it would answer, or to what
            raise psycopg.OperationalError(f"the server has not answered for {self.patience_s:g} s") from None
