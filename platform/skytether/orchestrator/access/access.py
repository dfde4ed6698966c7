"""Who asks, and what they may.

A robot may ask for itself, for what it is allowed, and see its own. An operator's token may what its scopes say; the
one in the state folder may everything.
"""

from __future__ import annotations

import contextlib
import hashlib
import math
import secrets as random
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

from skytether.api.rest import SCOPES, Scope

from ..domain.errors import (
    ConflictError,
    Fault,
    ForbiddenError,
    InvalidError,
    NotFoundError,
    TooManyError,
    UnauthenticatedError,
    UnknownTokenError,
)
from ..domain.rate_limit import RateLimiter
from ..domain.security import PREFIX_LENGTH, Secrets, TokenHash, new_token
from ..store.database import RobotRow, TokenRow
from ..store.store import Store

ANY_SERVICE = "*"
OWN = "self"
"""In the place of a token's id: the one that the request came with."""
_SEEN_EVERY = 10.0
"""Seconds between two notes that a robot was seen: one write per request would be too much."""

_RECENT = 10.0
"""Seconds for which a token that was good is good enough to measure a round trip, and to read a renewal."""
_UNKNOWN = 2.0
"""Seconds for which a token that nobody knew is refused without another look into the database."""
MOST_RECENT = 4096
"""Tokens that are remembered so, of those that were good and of those that nobody knew."""
_NO_TOKEN = "a token is needed: send `Authorization: Bearer TOKEN`"  # noqa: S105 - none
_PER_REQUEST = 8192
"""Bytes of a body that count as another request: a renewal with a report on twenty topics."""


@dataclass(frozen=True, slots=True)
class Principal:
    """Who a token belongs to."""

    robot: str | None
    """None: an operator."""
    services: tuple[str, ...] = (ANY_SERVICE,)
    scopes: frozenset[str] = frozenset()
    """Of an operator's token."""
    token: TokenRow | None = None
    """None: a token in a file beside the secret key."""
    measures: bool = False
    """Whether that is ``metrics.token``, and not the operator's."""

    @property
    def owner(self) -> str:
        """Whose idempotency keys these are, and who it was in the audit."""
        if self.robot is not None:
            return f"robot:{self.robot}"
        return f"operator:{self.token.name}" if self.token else "metrics.token" if self.measures else "operator"

    @property
    def owns_state(self) -> bool:
        """Whether this is the operator of the state folder, who has the orchestrator's secrets anyway."""
        return self.robot is None and self.token is None and not self.measures

    def may_use(self, service: str) -> bool:
        return ANY_SERVICE in self.services or service in self.services

    def require_scope(self, scope: Scope, *, robots: bool = False) -> None:
        """Refuse a token without a scope, and robots unless they may.

        Raises:
            ForbiddenError: It has not.
        """
        if self.robot is not None:
            if not robots:
                raise ForbiddenError(f"robot '{self.robot}' may not do this: it needs an operator's token")
        elif scope not in self.scopes:
            has = ", ".join(sorted(self.scopes)) or "none"
            raise ForbiddenError(f"this token may not do this: it needs the scope '{scope}'; its scopes are: {has}")

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

    def __init__(self, store: Store, secrets: Secrets, clock: Callable[[], float], throttle: RateLimiter) -> None:
        """``clock`` gives seconds since the epoch."""
        self._store = store
        self._secrets = secrets
        self._clock = clock
        self._throttle = throttle
        self._noted: OrderedDict[str, float] = OrderedDict()
        """When the use of a token was noted last, by its id; older ones are of no use, and a robot makes any number."""
        self._noting = threading.Lock()
        self._recent: OrderedDict[str, tuple[Principal, float]] = OrderedDict()
        """Who showed a token, by its SHA-256, and the monotonic time when the database knew it last."""
        self._unknown: OrderedDict[str, tuple[str, float]] = OrderedDict()
        """Why a token that nobody knew was refused, likewise. One that expired is asked about each time: the clock may
        be set back."""

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
            principal = self.verify(token)
        except UnauthenticatedError:
            self._spend_of(address)
            raise
        self.spend(principal)
        return principal

    def verify(self, token: str | None) -> Principal:
        """The same without taking a request.

        Raises:
            UnauthenticatedError: Nobody we know.
        """
        digest = _digest(token or "")
        try:
            principal = self._find(token)
        except UnauthenticatedError as error:
            self._recent.pop(digest, None)
            if isinstance(error, UnknownTokenError):
                _keep(self._unknown, digest, str(error))
            raise
        self._unknown.pop(digest, None)
        _keep(self._recent, digest, principal)
        return principal

    def spend(self, principal: Principal) -> None:
        """Take a request; an operator's are free.

        Raises:
            TooManyError: They asked too often.
        """
        if principal.robot is not None and (wait := self._throttle.wait(principal.owner)):
            raise TooManyError(wait, who=principal.owner)

    def _spend_of(self, address: str) -> None:
        """Take a request of all who come from an address without a good token."""
        if wait := self._throttle.wait(f"address {address}"):
            raise TooManyError(wait) from None

    def recent(self, token: str | None, address: str = "") -> Principal | None:
        """Who showed this token in the last seconds, at once: for what tells nothing that matters, takes no request.

        Raises:
            UnauthenticatedError: Nobody knew it a moment ago, or there is none: likewise without a wait.
            TooManyError: They asked too often; those who do are to cost as little as can be.
        """
        digest, now = _digest(token or ""), time.monotonic()
        why, at = self._unknown.get(digest, ("", 0.0)) if token else (_NO_TOKEN, now)
        if why and now - at <= _UNKNOWN:
            self._spend_of(address)
            raise UnauthenticatedError(why)
        principal, at = self._recent.get(digest, (None, 0.0))
        if principal is None or now - at > _RECENT:
            return None
        if principal.robot is not None and (wait := self._throttle.empty(principal.owner)):
            raise TooManyError(wait, who=principal.owner)
        return principal

    def charge(self, principal: Principal, length: int) -> None:
        """Reckon a body's length [bytes]: a robot's large request is as much work as several small ones."""
        if principal.robot is not None:
            self._throttle.charge(principal.owner, length / _PER_REQUEST)

    def _find(self, token: str | None) -> Principal:
        if not token:
            raise UnauthenticatedError(_NO_TOKEN)
        if self._secrets.is_operator(token):
            return Principal(None, scopes=frozenset(SCOPES))
        if self._secrets.may_measure(token):
            return Principal(None, scopes=frozenset({"metrics"}), measures=True)
        for row, robot in self._store.holders(token[:PREFIX_LENGTH]):
            if row.hash.matches(token):
                return self._principal(row, robot)
        raise UnknownTokenError("this token is not known here: it was revoked, or is another orchestrator's")

    def _principal(self, row: TokenRow, robot: RobotRow | None) -> Principal:
        now = self._clock()
        if row.expires_at is not None and now >= row.expires_at:
            when = datetime.fromtimestamp(row.expires_at, UTC).isoformat(timespec="seconds")
            raise UnauthenticatedError(f"this token expired at {when}: ask the operator for another")
        self._note_used(row, now)
        if robot is None:
            return Principal(None, scopes=frozenset(row.scopes), token=row)
        return Principal(robot.name, robot.services, token=row)

    def _note_used(self, row: TokenRow, now: float) -> None:
        with self._noting:
            at = time.monotonic()
            while self._noted and at - next(iter(self._noted.values())) >= _SEEN_EVERY:
                self._noted.popitem(last=False)
            noted = self._noted.setdefault(row.id, at) != at
        if not noted:
            self._store.change_token(row.id, last_used_at=now)
            if row.robot is not None:
                self._store.seen(row.robot, now)

    def register(
        self, name: str, services: tuple[str, ...], ttl_s: float | None, group: str | None = None
    ) -> tuple[RobotRow, str]:
        """A new robot and its token, which cannot be shown again.

        Raises:
            ConflictError: There is one of that name.
        """
        row, token = self._new(name, name, (), ttl_s)
        robot = RobotRow(name, services, row.created_at, group=group)
        if not self._store.add_robot(robot, row):
            raise ConflictError(f"there is a robot '{name}' already: give it another token, or delete it first")
        return robot, token

    def revoke(self, name: str) -> None:
        """Forget a robot: its tokens are worth nothing from now on. One that is gone already is no error."""
        self._store.delete_robot(name)

    def create(
        self, by: Principal, name: str, robot: str | None, scopes: Iterable[Scope], ttl_s: float | None
    ) -> tuple[TokenRow, str]:
        """Another token of a robot, or an operator's with some scopes; it cannot be shown again.

        Raises:
            ForbiddenError: It would have a scope that the one who asks has not.
            ConflictError: There is one of that name.
            InvalidError: Scopes for a robot, or none for an operator.
            NotFoundError: There is no such robot.
        """
        scopes = tuple(sorted(set(scopes)))
        if (robot is None) != bool(scopes):
            text = (
                "an operator's token needs at least one"
                if robot is None
                else "a robot's token has none: leave them out"
            )
            raise InvalidError([Fault("scopes", f"{text}; there are: {', '.join(SCOPES)}")])
        _require_all(by, robot, scopes)
        row, token = self._new(name, robot, scopes, ttl_s)
        if not self._store.add_token(row):
            if robot is not None and self._store.robot(robot) is None:
                raise NotFoundError(f"there is no robot '{robot}': register it first")
            whose = "there is a token" if robot is None else f"robot '{robot}' has a token"
            raise ConflictError(f"{whose} '{name}' already: give another name, or delete it first")
        return row, token

    def rotate(self, by: Principal, id_: str, grace_s: float, ttl_s: float | None = None) -> tuple[TokenRow, str]:
        """Another token with the same rights and the same end; the old one is good for a while longer.

        Each has one successor: as long as that was not used, for its answer may have been lost, another one takes its
        place. No more than these two are good at a time, and all end with each of them.

        Args:
            by: Who asks.
            id_: Which; ``OWN`` for their own.
            grace_s: How long the old one is good for still, at most until its end.
            ttl_s: How long the new one is good for, for who may make such tokens; None: until the end of the old one.

        Raises:
            ConflictError: It was renewed already, and the new one is in use.
            ForbiddenError: Not for this token.
            NotFoundError: There is none of that id.
        """
        own = id_ == OWN or (by.token is not None and id_ == by.token.id)
        if own and by.token is None:
            raise NotFoundError(
                "the operator's token of the state folder is renewed there: "
                "skytether orchestrator rotate operator-token"
            )
        if not own or ttl_s is not None:
            by.require_scope("tokens")
        old = by.token if own else self._store.token(id_)
        if old is None:
            raise NotFoundError(f"there is no token '{id_}'")
        if not own or ttl_s is not None:
            _require_all(by, old.robot, old.scopes)
        successor = self._store.token(old.successor) if old.successor else None
        row, token = self._new(old.name, old.robot, old.scopes, ttl_s, old)
        expires = min(row.created_at + grace_s, math.inf if old.expires_at is None else old.expires_at)
        if (successor and successor.last_used_at is not None) or not self._store.renew_token(old, row, expires):
            raise ConflictError(
                f"token '{old.name}' ({old.id}) was renewed already, and the new one is in use: use that one; "
                "if nobody of yours has it, delete it and make another"
            )
        return row, token

    def forget(self, by: Principal, id_: str) -> None:
        """A token, and those that it was renewed by or renewed, are worth nothing from now on.

        One that is gone already is no error. The first of them names them all, also when only later ones are left: its
        id is what an operator has noted, while a thief may have renewed it since.

        Raises:
            ForbiddenError: It may more than the one who asks.
        """
        row = next((row for row in self._store.tokens() if id_ in (row.id, row.family)), None)
        if row is not None:
            _require_all(by, row.robot, row.scopes)
            self._store.delete_family(row.family)

    def _new(
        self,
        name: str,
        robot: str | None,
        scopes: tuple[Scope, ...],
        ttl_s: float | None,
        renews: TokenRow | None = None,
    ) -> tuple[TokenRow, str]:
        """A token; without ``ttl_s`` it ends with the one that it renews, or never."""
        token, id_, now = new_token(), random.token_hex(8), self._clock()
        ends = now + ttl_s if ttl_s is not None else renews.ends_at if renews is not None else None
        family = renews.family if renews is not None else id_
        return TokenRow(id_, name, robot, scopes, TokenHash.of(token), now, ends, family=family, ends_at=ends), token


def _keep(cache: OrderedDict[str, tuple[Any, float]], digest: str, what: Any) -> None:
    """As the newest; the oldest goes."""
    cache.pop(digest, None)
    cache[digest] = what, time.monotonic()
    while len(cache) > MOST_RECENT:
        with contextlib.suppress(KeyError):  # another thread did
            cache.popitem(last=False)


def _digest(token: str) -> str:
    return hashlib.sha256(token.encode()).hexdigest()


def _require_all(by: Principal, robot: str | None, scopes: Iterable[Scope]) -> None:
    """Nobody makes, renews or revokes a token that may more than his own."""
    for scope in ("robots",) if robot is not None else scopes:
        by.require_scope(scope)
