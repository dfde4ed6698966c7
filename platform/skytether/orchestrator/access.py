"""Who asks, and what they may.

An operator may everything; a robot may ask for itself, for what it is allowed, and see its own.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

from .errors import ConflictError, ForbiddenError, TooManyError, UnauthenticatedError
from .security import PREFIX_LENGTH, Secrets, TokenHash, new_token
from .store import RobotRow, Store
from .throttle import Throttle

ANY_SERVICE = "*"
_SEEN_EVERY = 10.0
"""Seconds between two notes that a robot was seen: one write per request would be too much."""


@dataclass(frozen=True, slots=True)
class Principal:
    """Who a token belongs to."""

    robot: str | None
    """None: the operator."""
    services: tuple[str, ...] = (ANY_SERVICE,)

    @property
    def owner(self) -> str:
        """Whose idempotency keys these are."""
        return "operator" if self.robot is None else f"robot:{self.robot}"

    def may_use(self, service: str) -> bool:
        return ANY_SERVICE in self.services or service in self.services

    def require_operator(self) -> None:
        """Refuse a robot.

        Raises:
            ForbiddenError: It is one.
        """
        if self.robot is not None:
            raise ForbiddenError(f"robot '{self.robot}' may not do this: it needs the operator's token")

    def require(self, robot: str, service: str) -> None:
        """May it ask for this service for that robot?

        Raises:
            ForbiddenError: It may not.
        """
        if self.robot is not None and robot != self.robot:
            raise ForbiddenError(f"robot '{self.robot}' may ask for itself only, not for '{robot}'")
        if not self.may_use(service):
            allowed = ", ".join(self.services) or "nothing"
            raise ForbiddenError(f"robot '{self.robot}' may not ask for '{service}'; it may ask for: {allowed}")


class Access:
    """Robots and tokens."""

    def __init__(self, store: Store, secrets: Secrets, clock: Callable[[], float], throttle: Throttle) -> None:
        """``clock`` gives seconds since the epoch."""
        self._store = store
        self._secrets = secrets
        self._clock = clock
        self._throttle = throttle
        self._noted: dict[str, float] = {}

    def authenticate(self, token: str | None, address: str = "") -> Principal:
        """Find out who asks.

        Args:
            token: What came with the request.
            address: Where it came from: those without a good token share a budget by it.

        Raises:
            UnauthenticatedError: Nobody we know.
            TooManyError: They asked too often; an operator never does.
        """
        try:
            principal = self._find(token)
        except UnauthenticatedError:
            self._spend(f"address {address}")
            raise
        if principal.robot is not None:
            self._spend(principal.owner)
        return principal

    def _spend(self, caller: str) -> None:
        wait = self._throttle.wait(caller)
        if wait:
            raise TooManyError(wait)

    def _find(self, token: str | None) -> Principal:
        if not token:
            raise UnauthenticatedError("a token is needed: send `Authorization: Bearer TOKEN`")
        if self._secrets.is_operator(token):
            return Principal(None)
        for row in self._store.robots_by_prefix(token[:PREFIX_LENGTH]):
            if row.token.matches(token):
                self._note_seen(row.name)
                return Principal(row.name, row.services)
        raise UnauthenticatedError("this token is not known here: it was revoked, or is another orchestrator's")

    def _note_seen(self, robot: str) -> None:
        now = time.monotonic()
        if now - self._noted.get(robot, -_SEEN_EVERY) >= _SEEN_EVERY:
            self._noted[robot] = now
            self._store.seen(robot, self._clock())

    def register(self, name: str, services: tuple[str, ...]) -> tuple[RobotRow, str]:
        """A new robot and its token, which cannot be shown again.

        Raises:
            ConflictError: There is one of that name.
        """
        token = new_token()
        row = RobotRow(name, services, TokenHash.of(token), self._clock())
        if not self._store.add_robot(row):
            raise ConflictError(f"there is a robot '{name}' already: delete it first if its token is lost")
        return row, token

    def revoke(self, name: str) -> None:
        """Forget a robot: its token is worth nothing from now on. One that is gone already is no error."""
        self._store.delete_robot(name)
        self._noted.pop(name, None)
