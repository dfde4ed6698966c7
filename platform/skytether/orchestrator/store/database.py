"""The database, and what people registered in it: services, sites, robots and tokens."""

from __future__ import annotations

import threading
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from typing import Any

from sqlalchemy import Connection, Row, bindparam, delete, insert, select, text, update
from sqlalchemy.exc import IntegrityError

from skytether.api.rest import GateReport, Scope, SiteCreate

from ..domain.security import TokenHash
from .engine import ADMITTING, SQLITE_PATIENCE, make_engine, migrate, reading
from .leader import LEAD_PATIENCE_S, Lock, check_fence, lock_of
from .models import facts, gates, orchestrators, robots, services, shared, sites, stops, tokens
from .node_rows import NodeRows


@dataclass(frozen=True, slots=True)
class RobotRow:
    """A registered robot."""

    name: str
    services: tuple[str, ...]
    created_at: float
    last_seen_at: float | None = None
    group: str | None = None
    """With whom its services share what they see."""


@dataclass(frozen=True, slots=True)
class SharedRow:
    """What a robot's service told the others of its group last."""

    robot: str
    service: str
    group: str
    """To which it was told."""
    at: float
    text: str


@dataclass(frozen=True, slots=True)
class StopRow:
    """The last order to a robot to stop."""

    robot: str
    id: str
    at: float
    reason: str
    by: str
    acknowledged_at: float | None = None


@dataclass(frozen=True, slots=True)
class GateRow:
    """What a robot said last of its gate."""

    robot: str
    at: float
    report: GateReport | None
    """None: it is too long ago to be so still."""


@dataclass(frozen=True, slots=True)
class TokenRow:
    """What is kept of a token, of a robot or of an operator."""

    id: str
    name: str
    """For people; of a robot's first token: the robot's."""
    robot: str | None
    """None: an operator's."""
    scopes: tuple[Scope, ...]
    """What an operator's may do; a robot's has none, for what it may is the robot's."""
    hash: TokenHash
    created_at: float
    expires_at: float | None = None
    last_used_at: float | None = None
    family: str = ""
    """Id of the first of those that were made from one another."""
    ends_at: float | None = None
    """When it would end if nobody renewed it: what is made from it by itself ends then, too. ``expires_at`` is earlier
    once it was renewed."""
    successor: str | None = None
    """Id of the one that it was renewed by."""


_HOLDERS = (
    select(
        tokens, robots.c.services.label("may_use"), robots.c.created_at.label("registered_at"), robots.c.last_seen_at
    )
    .outerjoin(robots, tokens.c.robot == robots.c.name)
    .where(tokens.c.prefix == bindparam("prefix"))
)
"""Made once: every request asks it."""
_STATE_OF_SITES = (sites.c.draining, sites.c.evacuating)
_SITES = select(*(column for column in sites.c if column not in set(_STATE_OF_SITES))).order_by(sites.c.name)
_HEAR_GATE = text(
    "INSERT INTO gates (robot, at, report) SELECT name, :at, :report FROM robots WHERE name = :of_robot"
    " ON CONFLICT (robot) DO UPDATE SET at = excluded.at, report = excluded.report"
).bindparams(bindparam("report", type_=gates.c.report.type))
"""Nothing for a robot that was deleted meanwhile."""
_ANNOUNCE = text(
    "INSERT INTO orchestrators (address, seen_at) VALUES (:address, :seen_at)"
    " ON CONFLICT (address) DO UPDATE SET seen_at = excluded.seen_at"
)
_HEAR_SHARED = text(
    "INSERT INTO shared (robot, service, share_group, at, text)"
    " SELECT name, :service, :in_group, :at, :text FROM robots WHERE name = :of_robot"
    " ON CONFLICT (robot, service)"
    " DO UPDATE SET share_group = excluded.share_group, at = excluded.at, text = excluded.text"
)
"""Likewise."""


class Database:
    """The database as such. Safe from any thread."""

    def __init__(self, url: str) -> None:
        self._engine = make_engine(url)
        apart = make_engine(url, tried=False, patience_s=LEAD_PATIENCE_S) if self.served else self._engine
        self._apart = reading(apart)
        """Connections of its own for who leads: a crowd of requests keeps those of the other waiting. Each statement is
        one round trip, for the lead is lost where a few of them take longer than it lasts."""
        self._reader = reading(self._engine)
        self._writer = self._engine.execution_options(immediate=True)
        self._turn = threading.Lock()
        self._schema = ""
        self.nodes = NodeRows(self._writing, self._reader)

    @contextmanager
    def _writing(self, *, alone: bool = False) -> Iterator[Connection]:
        """A transaction that changes something; ``alone``: for one statement, which needs none around it.

        SQLite has one writer at a time, and lets the others ask again and again after growing pauses, in no order: here
        they queue. One that waits for another program's lock does not keep the queue for longer than that may take.
        """
        turn = self._engine.dialect.name == "sqlite" and self._turn.acquire(timeout=SQLITE_PATIENCE)
        try:
            with self._reader.connect() if alone else self._writer.begin() as connection:
                check_fence(connection)
                yield connection
        finally:
            if turn:
                self._turn.release()

    def migrate(self) -> None:
        """Bring the database to the schema of this code."""
        self._schema = migrate(self._engine)

    def outdated(self) -> bool:
        """Whether a newer orchestrator has brought the database to a schema that this one does not know."""
        with self._apart.connect() as connection:
            return bool(connection.scalar(text("SELECT version_num FROM alembic_version")) != self._schema)

    def lock(self) -> Lock:
        """The lock of whoever leads over this database."""
        return lock_of(self._apart if self.served else self._engine)

    @contextmanager
    def admitting(self) -> Iterator[None]:
        """Around counting and adding: other orchestrators over this database wait. With SQLite there are none."""
        if not self.served:
            yield
            return
        with self._engine.begin() as connection:
            connection.execute(text(f"SELECT pg_advisory_xact_lock({ADMITTING})"))
            yield

    @property
    def served(self) -> bool:
        """Whether a server has it, for orchestrators on several machines."""
        return self._engine.dialect.name == "postgresql"

    def now(self) -> float:
        """Seconds since the epoch, by the server's clock."""
        with self._apart.connect() as connection:
            return float(connection.scalar(text("SELECT extract(epoch FROM clock_timestamp())")) or 0.0)

    def announce(self, address: str, now: float, silent_s: float) -> None:
        """Note that an orchestrator is there; those that were not for so many seconds are forgotten."""
        row = {"address": address, "seen_at": now}
        with self._writing() as connection:
            connection.execute(_ANNOUNCE, row)
            connection.execute(delete(orchestrators).where(orchestrators.c.seen_at < now - silent_s))

    def withdraw(self, address: str) -> None:
        """An orchestrator ends."""
        with self._writing() as connection:
            connection.execute(delete(orchestrators).where(orchestrators.c.address == address))

    def announced(self, since: float) -> list[str]:
        """Addresses of the orchestrators that were there since then."""
        with self._reader.connect() as connection:
            return list(connection.scalars(select(orchestrators.c.address).where(orchestrators.c.seen_at >= since)))

    def agree(self, name: str, value: str, earlier: Sequence[str] = ()) -> bool:
        """Note a fact at first, or when it was one of the earlier ones; and then say whether it is still the same."""
        if self._insert(facts, {"name": name, "value": value}):
            return True
        if earlier:
            with self._writing() as connection:
                changed = update(facts).where(facts.c.name == name, facts.c.value.in_(earlier)).values(value=value)
                connection.execute(changed)
        with self._reader.connect() as connection:
            return connection.scalar(select(facts.c.value).where(facts.c.name == name)) == value

    def close(self) -> None:
        self._apart.dispose()
        self._engine.dispose()

    def ping(self) -> None:
        """Raise what the database raises, if it does not answer."""
        with self._reader.connect() as connection:
            connection.execute(text("SELECT 1"))

    # Catalog

    def services(self) -> dict[str, dict[str, Any]]:
        """Manifests that were put, by name."""
        with self._reader.connect() as connection:
            return {row.name: row.manifest for row in connection.execute(select(services))}

    def put_service(self, name: str, manifest: dict[str, Any]) -> None:
        with self._writing() as connection:
            connection.execute(delete(services).where(services.c.name == name))
            connection.execute(insert(services).values(name=name, manifest=manifest))

    def delete_service(self, name: str) -> None:
        with self._writing() as connection:
            connection.execute(delete(services).where(services.c.name == name))

    # Sites

    def sites(self) -> list[SiteCreate]:
        with self._reader.connect() as connection:
            rows = connection.execute(_SITES).mappings()
            return [SiteCreate.model_validate(dict(row)) for row in rows]

    def draining_sites(self) -> set[str]:
        """Those that are to be deleted with their last instance."""
        with self._reader.connect() as connection:
            return set(connection.scalars(select(sites.c.name).where(sites.c.draining)))

    def evacuating_sites(self) -> set[str]:
        """Those that take no more, and whose instances are moved elsewhere."""
        with self._reader.connect() as connection:
            return set(connection.scalars(select(sites.c.name).where(sites.c.evacuating)))

    def evacuate_site(self, name: str, evacuating: bool) -> None:
        """From now on, or not any more."""
        with self._writing() as connection:
            connection.execute(update(sites).where(sites.c.name == name).values(evacuating=evacuating))

    def drain_site(self, name: str) -> None:
        """From now on; it cannot be taken back."""
        with self._writing() as connection:
            connection.execute(update(sites).where(sites.c.name == name).values(draining=True))

    def add_site(self, site: SiteCreate) -> bool:
        """False if there is one of that name."""
        return self._insert(sites, site.model_dump())

    def change_site(self, site: SiteCreate) -> None:
        """Have one of that name be as this one."""
        with self._writing() as connection:
            connection.execute(update(sites).where(sites.c.name == site.name).values(**site.model_dump()))

    def delete_site(self, name: str) -> None:
        with self._writing() as connection:
            connection.execute(delete(sites).where(sites.c.name == name))

    # Robots

    def robots(self) -> list[RobotRow]:
        with self._reader.connect() as connection:
            return [_robot(row) for row in connection.execute(select(robots).order_by(robots.c.name))]

    def robot(self, name: str) -> RobotRow | None:
        with self._reader.connect() as connection:
            row = connection.execute(select(robots).where(robots.c.name == name)).one_or_none()
        return _robot(row) if row else None

    def add_robot(self, robot: RobotRow, token: TokenRow) -> bool:
        """With its first token; False if there is one of that name."""
        row = {
            "name": robot.name,
            "services": list(robot.services),
            "created_at": robot.created_at,
            "share_group": robot.group,
        }
        try:
            with self._writing() as connection:
                connection.execute(insert(robots).values(**row))
                connection.execute(insert(tokens).values(**_token_values(token)))
        except IntegrityError:
            return False
        return True

    def delete_robot(self, name: str) -> None:
        with self._writing() as connection:
            connection.execute(delete(robots).where(robots.c.name == name))

    def seen(self, robot: str, now: float) -> None:
        with self._writing() as connection:
            connection.execute(update(robots).where(robots.c.name == robot).values(last_seen_at=now))

    def set_group(self, name: str, group: str | None) -> bool:
        """False: there is no such robot."""
        with self._writing() as connection:
            changed = connection.execute(update(robots).where(robots.c.name == name).values(share_group=group))
        return changed.rowcount > 0

    def groups(self) -> dict[str, str]:
        """By robot, of those that are in one."""
        with self._reader.connect() as connection:
            found = connection.execute(
                select(robots.c.name, robots.c.share_group).where(robots.c.share_group.is_not(None))
            )
            return {row.name: row.share_group for row in found}

    def shared(self) -> list[SharedRow]:
        """What robots told those of their groups."""
        with self._reader.connect() as connection:
            return [SharedRow(*row) for row in connection.execute(select(shared)).all()]

    def save_shared(self, heard: Iterable[SharedRow], before: float) -> None:
        """Instead of what they told before, in order, as gates; what was told before a time is forgotten."""
        ordered = sorted(heard, key=lambda row: (row.robot, row.service))
        rows = [
            {"of_robot": row.robot, "service": row.service, "in_group": row.group, "at": row.at, "text": row.text}
            for row in ordered
        ]
        with self._writing() as connection:
            if rows:
                connection.execute(_HEAR_SHARED, rows)
            connection.execute(delete(shared).where(shared.c.at < before))

    def stops(self) -> dict[str, StopRow]:
        """The last order to each robot to stop."""
        with self._reader.connect() as connection:
            return {row.robot: _stop(row) for row in connection.execute(select(stops))}

    def stop(self, robot: str) -> StopRow | None:
        with self._reader.connect() as connection:
            row = connection.execute(select(stops).where(stops.c.robot == robot)).one_or_none()
        return _stop(row) if row else None

    def order_stops(self, orders: Iterable[StopRow]) -> None:
        """An order that was not acknowledged stays instead of a new one; robots that are gone are left out."""
        with self._writing() as connection:
            known = set(connection.scalars(select(robots.c.name)))
            for order in orders:
                if order.robot not in known:
                    continue
                connection.execute(
                    delete(stops).where(stops.c.robot == order.robot, stops.c.acknowledged_at.is_not(None))
                )
                waits = select(stops.c.robot).where(stops.c.robot == order.robot)
                if connection.execute(waits).one_or_none() is None:
                    connection.execute(insert(stops).values(**asdict(order)))

    def acknowledge_stop(self, robot: str, id_: str, now: float) -> StopRow | None:
        """The first time counts; None: that is not the robot's last order."""
        mine = (stops.c.robot == robot) & (stops.c.id == id_)
        with self._writing() as connection:
            connection.execute(update(stops).where(mine, stops.c.acknowledged_at.is_(None)).values(acknowledged_at=now))
            row = connection.execute(select(stops).where(mine)).one_or_none()
        return _stop(row) if row else None

    def gates(self) -> dict[str, GateRow]:
        """What each robot said last of its gate."""
        with self._reader.connect() as connection:
            rows = connection.execute(select(gates)).all()
        return {row.robot: GateRow(row.robot, row.at, GateReport.model_validate(row.report)) for row in rows}

    def save_gates(self, heard: Iterable[GateRow]) -> None:
        """Instead of what they said before; in order, lest two orchestrators wait for each other."""
        ordered = sorted(heard, key=lambda row: row.robot)
        rows = [
            {"of_robot": row.robot, "at": row.at, "report": row.report.model_dump(mode="json")}
            for row in ordered
            if row.report is not None
        ]
        with self._writing() as connection:
            connection.execute(_HEAR_GATE, rows)

    # Tokens

    def tokens(self) -> list[TokenRow]:
        with self._reader.connect() as connection:
            return [_token(row) for row in connection.execute(select(tokens).order_by(tokens.c.created_at))]

    def token(self, id_: str) -> TokenRow | None:
        with self._reader.connect() as connection:
            row = connection.execute(select(tokens).where(tokens.c.id == id_)).one_or_none()
        return _token(row) if row else None

    def holders(self, prefix: str) -> list[tuple[TokenRow, RobotRow | None]]:
        """Tokens that begin so, at most one but for a freak of chance, each with the robot whose it is."""
        with self._reader.connect() as connection:
            rows = connection.execute(_HOLDERS, {"prefix": prefix}).all()
        robots_ = (
            RobotRow(row.robot, tuple(row.may_use), row.registered_at, row.last_seen_at) if row.robot else None
            for row in rows
        )
        return [(_token(row), robot) for row, robot in zip(rows, robots_, strict=True)]

    def add_token(self, token: TokenRow) -> bool:
        """False if its robot is gone, or there is one of that name."""
        return self._insert(tokens, _token_values(token))

    def renew_token(self, old: TokenRow, new: TokenRow, expires_at: float | None) -> bool:
        """Put a successor in the place of the one that there was, and end all of the family but these two.

        Args:
            old: As it was seen.
            new: The successor.
            expires_at: When the old one ends.

        Returns:
            False if somebody else was quicker.
        """
        seen = tokens.c.successor.is_(None) if old.successor is None else tokens.c.successor == old.successor
        renewed = {"successor": new.id, "expires_at": expires_at, "handle": None}
        with self._writing() as connection:
            changed = connection.execute(update(tokens).where(tokens.c.id == old.id, seen).values(**renewed))
            if changed.rowcount == 0:
                return False
            connection.execute(delete(tokens).where(tokens.c.family == old.family, tokens.c.id != old.id))
            connection.execute(insert(tokens).values(**_token_values(new)))
        return True

    def change_token(self, id_: str, **values: float | None) -> None:
        """Set when it expires, or when it was last used."""
        with self._writing() as connection:
            connection.execute(update(tokens).where(tokens.c.id == id_).values(**values))

    def delete_family(self, family: str) -> None:
        """Of tokens that were made from one another."""
        with self._writing() as connection:
            connection.execute(delete(tokens).where(tokens.c.family == family))

    def _insert(self, table: Any, values: dict[str, Any]) -> bool:
        try:
            with self._writing() as connection:
                connection.execute(insert(table).values(**values))
        except IntegrityError:
            return False
        return True


def _robot(row: Row[Any]) -> RobotRow:
    return RobotRow(row.name, tuple(row.services), row.created_at, row.last_seen_at, row.share_group)


def _stop(row: Row[Any]) -> StopRow:
    return StopRow(row.robot, row.id, row.at, row.reason, row.by, row.acknowledged_at)


def _token(row: Row[Any]) -> TokenRow:
    kept = TokenHash(row.prefix, row.sha256)
    times = row.created_at, row.expires_at, row.last_used_at
    kin = row.family, row.ends_at, row.successor
    return TokenRow(row.id, row.name, row.robot, tuple(row.scopes), kept, *times, *kin)


def _token_values(token: TokenRow) -> dict[str, Any]:
    plain = {"id": token.id, "name": token.name, "robot": token.robot, "scopes": list(token.scopes)}
    times = {"created_at": token.created_at, "expires_at": token.expires_at, "ends_at": token.ends_at}
    kin = {"family": token.family or token.id, "handle": f"{token.robot or ''}/{token.name}"}
    return {**plain, **times, **kin, "prefix": token.hash.prefix, "sha256": token.hash.digest}
