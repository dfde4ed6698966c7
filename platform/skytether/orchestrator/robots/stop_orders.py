"""Orders to robots to stop. One way: nothing here, and nothing in the API, resets a robot."""

from __future__ import annotations

import secrets
from collections.abc import Callable, Iterable

from ..access.access import Principal
from ..domain.errors import ForbiddenError, NotFoundError
from ..store.database import StopRow
from ..store.store import Store


class StopOrders:
    """The last order to each robot; kept until the next, over restarts too.

    Args:
        store: Where they are kept.
        clock: Seconds since the epoch.
    """

    def __init__(self, store: Store, clock: Callable[[], float]) -> None:
        self._store = store
        self._clock = clock

    def order(self, by: Principal, robots: Iterable[str], reason: str) -> dict[str, StopRow]:
        """Order robots to stop. One that has not acknowledged an order yet keeps that: asking again changes nothing.

        Returns:
            The orders that are in force, by robot.

        Raises:
            NotFoundError: None of them is registered.
        """
        now, names = self._clock(), set(robots)
        self._store.order_stops(StopRow(robot, secrets.token_hex(8), now, reason, by.owner) for robot in sorted(names))
        found = {robot: row for robot, row in self._store.stops().items() if robot in names}
        if names and not found:
            raise NotFoundError(f"there is no robot '{min(names)}': register it first")
        return found

    def last(self, by: Principal, robot: str) -> StopRow | None:
        """The last order to a robot; None: there was none.

        Raises:
            ForbiddenError: A robot asks for another's.
        """
        if by.robot not in (None, robot):
            raise ForbiddenError(f"robot '{by.robot}' may ask for orders to itself only, not for those to '{robot}'")
        return self._store.stop(robot)

    def acknowledge(self, by: Principal, robot: str, order: str) -> StopRow:
        """A robot says that it stands; the first time counts.

        Raises:
            ForbiddenError: It is somebody else.
            NotFoundError: That is not its last order.
        """
        if by.robot != robot:
            raise ForbiddenError(f"only robot '{robot}' itself can acknowledge an order to stop")
        row = self._store.acknowledge_stop(robot, order, self._clock())
        if row is None:
            raise NotFoundError(f"'{order}' is not the last order to robot '{robot}' to stop")
        return row
