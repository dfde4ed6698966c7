"""Says to the other orchestrators over a database that this one is there, and where it is reached."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable

from sqlalchemy.exc import SQLAlchemyError

from ..store.database import Database

PERIOD_S = 3.0
"""Between two beats."""
SILENT_S = 10.0
"""One that was not heard for so long is gone."""


class Heartbeat:
    """One orchestrator's; one over SQLite is alone, and has none.

    Args:
        store: The database.
        address: Where it is reached; None: it does not say.
        clock: Seconds since the epoch, the same for all over the database.
    """

    def __init__(self, store: Database, address: str | None, clock: Callable[[], float]) -> None:
        self._store = store
        self._address = address if store.served else None
        self._clock = clock
        self._beaten_at = -math.inf

    def beat(self) -> None:
        """If it is time for it."""
        now = self._clock()
        if self._address is not None and not 0 <= now - self._beaten_at < PERIOD_S:
            self._store.announce(self._address, now, SILENT_S)
            self._beaten_at = now

    def end(self) -> None:
        """It is gone from now on; where the database does not answer, a little later."""
        if self._address is not None:
            with contextlib.suppress(SQLAlchemyError):
                self._store.withdraw(self._address)

    def addresses(self) -> list[str]:
        """Of all that are there."""
        return self._store.announced(self._clock() - SILENT_S) if self._store.served else []
