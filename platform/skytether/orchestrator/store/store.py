"""Instances in the database, their events, reports and sums.

Changes of instances are compare-and-set on the record's version: load, work outside any transaction, apply; who has not
seen the last change gets None and looks again. Each change of state or reason leaves an event, and so does what a
service reports.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import (
    ColumnElement,
    Connection,
    case,
    delete,
    exists,
    func,
    insert,
    select,
    update,
)
from sqlalchemy.exc import IntegrityError

from skytether.api.report_metrics import Counts, Owner
from skytether.api.rest import State
from skytether.api.service_report import ServiceReport

from ..domain.counter_totals import MOST_NAMES, CounterTotals, merge
from ..domain.records import Change, Record
from . import statements as sql
from .group_store import GroupStore
from .models import accounts, events, idempotency, instances, reports

_SEEN = 65_536
"""Records that are remembered, of what has not ended, so that looking at many again and again reads only those that
changed."""
_FETCHED = 500
"""Rows that one query names at most."""
_REPORTS = 100
"""Events of what one instance's service reported that are kept, the newest: a service that talks all day must not push
out what happened to others."""


@dataclass(frozen=True, slots=True)
class EventRow:
    """One change of an instance, or what it reported."""

    id: int
    instance: str
    at: float
    state: State
    reason: str
    code: str
    """Of a report; empty: a change."""
    pull: dict[str, Any] | None
    """:class:`skytether.api.pull_progress.PullProgress` as JSON."""


@dataclass(frozen=True, slots=True)
class Renewed:
    """An instance whose lease was renewed."""

    record: Record
    successor: str | None
    """The id of the one that replaces it and has not ended."""


class _ChangedMeanwhileError(Exception):
    """Somebody else has changed what was to be changed."""


class KeyReusedError(Exception):
    """An idempotency key came again with another body."""


class Store(GroupStore):
    """The database with its instances. Safe from any thread."""

    def __init__(
        self,
        url: str,
        robot_names: int = MOST_NAMES,
        *,
        key_id: Callable[[], str] = lambda: "",
        on_change: Callable[[str], None] = lambda _: None,
    ) -> None:
        """Open it.

        Args:
            url: SQLAlchemy's.
            robot_names: Names that one robot may make up in all that it reports.
            key_id: Fingerprint of the secret key with which sessions begin now.
            on_change: Called with an instance's id after each of its events is stored; must return at once.
        """
        super().__init__(url)
        self._robot_names = robot_names
        self.on_change = on_change
        self.key_id = key_id
        self._seen: dict[str, Record] = {}

    # Instances

    def add(self, record: Record, owner: str, key: str | None, body_sha256: str) -> Record:
        """Store a new instance; if another request with the same idempotency key was quicker, give back its one.

        So it is with a successor, if another one of the same instance serves by now.

        Raises:
            KeyReusedError: The key was used with another body.
        """
        record = record.after({"key_id": self.key_id()})
        try:
            with self._writing() as connection:
                if (coming := self._coming(connection, record.replaces)) is not None:
                    return sql.record(connection.execute(sql.INSTANCE, {"instance": coming}).mappings().one())
                connection.execute(insert(instances).values(**sql.values(record)))
                if key is not None:
                    row = {"owner": owner, "key": key, "body_sha256": body_sha256, "instance": record.id}
                    connection.execute(insert(idempotency).values(created_at=record.created_at, **row))
                sql.add_event(connection, record)
        except IntegrityError:
            earlier = self.made_with(owner, key, body_sha256) if key is not None else None
            if earlier is None:
                raise
            return earlier
        self._remember(record)
        self.on_change(record.id)
        return record

    def keys_in_use(self) -> set[str]:
        """Fingerprints of the secret keys of all instances that have not ended."""
        with self._reader.connect() as connection:
            return set(connection.scalars(select(instances.c.key_id).where(sql.LIVE).distinct()))

    def made_with(self, owner: str, key: str, body_sha256: str) -> Record | None:
        """The instance that was made with an idempotency key; None if the key is new.

        Raises:
            KeyReusedError: The key was used with another body.
        """
        mine = (idempotency.c.owner == owner) & (idempotency.c.key == key)
        query = select(instances, idempotency.c.body_sha256).join(idempotency).where(mine)
        with self._reader.connect() as connection:
            row = connection.execute(query).mappings().one_or_none()
        if row is None:
            return None
        if row["body_sha256"] != body_sha256:
            raise KeyReusedError
        return sql.record(row)

    def get(self, instance: str) -> Record | None:
        with self._reader.connect() as connection:
            row = connection.execute(sql.INSTANCE, {"instance": instance}).mappings().one_or_none()
        return None if row is None else sql.record(row)

    def all(self, robot: str | None = None) -> list[Record]:
        """Newest first; of one robot, or of all."""
        if robot is None:
            return sorted(self._select(sql.EVERY), key=lambda record: -record.created_at)
        query = select(instances).where(instances.c.robot == robot)
        return self._records(query.order_by(instances.c.created_at.desc(), instances.c.id))

    def live(self) -> list[Record]:
        """All that has not ended, oldest first."""
        return self._select(sql.ALL_LIVE)

    def live_of(self, robot: str) -> list[Record]:
        """All of one robot that has not ended, oldest first."""
        return self._select(sql.LIVE_OF, robot=robot)

    def count_live(self, service: str) -> int:
        """How many instances of a service have not ended."""
        with self._reader.connect() as connection:
            return connection.scalar(sql.COUNT_LIVE, {"service": service}) or 0

    def live_at(self, site: str, *, changing: bool = False) -> list[Record]:
        """All at one site that has not ended, oldest first; with ``changing`` only what is starting or stopping."""
        return self._select(sql.CHANGING_AT if changing else sql.LIVE_AT, site=site)

    def waiting(self) -> list[Record]:
        """All that has no site yet, oldest first."""
        return self._select(sql.WAITING)

    def live_standbys(self) -> list[Record]:
        """Those that are nobody's and have not ended, oldest first."""
        return self._select(sql.LIVE_STANDBYS)

    def standbys(self, service: str) -> list[Record]:
        """Those of a service that run and are nobody's, oldest first."""
        return self._select(sql.STANDBYS, service=service)

    def robots_at(self, site: str) -> frozenset[str]:
        """Robots of all instances at a site of which the store has a row, ended or not."""
        asked = select(instances.c.robot).where(instances.c.site == site).distinct()
        with self._reader.connect() as connection:
            return frozenset(connection.scalars(asked))

    def known(self, ids: Iterable[str]) -> set[str]:
        """Those that the store has a row of, ended or not."""
        with self._reader.connect() as connection:
            return set(connection.scalars(select(instances.c.id).where(instances.c.id.in_(list(ids)))))

    def change(self, asked: Change, now: float) -> Record | None:
        """Change an instance if it is still as it was seen.

        Args:
            asked: What is to become of it; see ``domain.transitions``.
            now: Seconds since the epoch.

        Returns:
            The record as it is now; None if somebody else changed it meanwhile.

        Raises:
            IllegalMoveError: The move of state is not in the table.
        """
        return self.change_all([asked], now)[0]

    def change_all(self, asked: Sequence[Change], now: float) -> list[Record | None]:
        """The same of several, in one transaction: a change by itself takes a server's disk, each time."""
        drafts = [one.draft(now) for one in asked]
        rows = [{**columns, **sql.as_seen(one.record)} for one, (_, columns, _) in zip(asked, drafts, strict=True)]
        events = [[sql.event(record) for record in told] for _, _, told in drafts]
        try:
            as_seen = self._change_rows(rows, events, at_once=len(rows) > 1)
        except _ChangedMeanwhileError:
            as_seen = self._change_rows(rows, events, at_once=False)
        done = [new if same else None for (new, _, _), same in zip(drafts, as_seen, strict=True)]
        for changed, told in zip(done, events, strict=True):
            if changed is not None:
                self._remember(changed)
                if told:
                    self.on_change(changed.id)
        return done

    def _change_rows(
        self, rows: Sequence[dict[str, Any]], events: Sequence[list[dict[str, Any]]], *, at_once: bool
    ) -> list[bool]:
        """Change rows, and add events of each that is still as it was seen; which these are.

        Raises:
            _ChangedMeanwhileError: Some are not, and nothing was changed; only ``at_once``: then a server is waited for
                once, not for each row, and says how many it has changed, not which.
        """
        with self._writing() as connection:
            if at_once and len({frozenset(row) for row in rows}) == 1:
                if connection.execute(sql.CHANGE, rows).rowcount != len(rows):
                    raise _ChangedMeanwhileError
                as_seen = [True] * len(rows)
            else:
                as_seen = [connection.execute(sql.CHANGE, row).rowcount > 0 for row in rows]
            said = [event for told, same in zip(events, as_seen, strict=True) if same for event in told]
            if said:
                connection.execute(sql.EVENT, said)
        return as_seen

    def add_service_reports(self, record: Record, now: float, reports: Sequence[ServiceReport]) -> Record | None:
        """Keep what the present run of an instance reported, as events, if the instance is still as it was seen.

        Returns:
            The record as it is now; None if somebody else changed it meanwhile.
        """
        changes = {"version": record.version + 1, "said": reports[-1].number}
        said = {"instance": record.id, "at": now, "state": record.state.value}
        with self._writing() as connection:
            if connection.execute(sql.CHANGE, {**changes, **sql.as_seen(record)}).rowcount == 0:
                return None
            connection.execute(sql.EVENT, [{**said, "reason": one.message, "code": one.code} for one in reports])
        new = record.after(changes)
        self._remember(new)
        self.on_change(new.id)
        return new

    def claim(self, asked: Change, now: float, owner: str, key: str | None, body_sha256: str) -> Record | None:
        """Give a standby to a robot; None if another was quicker, or what it would replace has a successor."""
        standby = asked.record
        changes = {**asked.columns, "version": standby.version + 1}
        new = standby.after(changes)
        try:
            with self._writing() as connection:
                if self._coming(connection, new.replaces) is not None:
                    return None
                if connection.execute(sql.CHANGE, {**changes, **sql.as_seen(standby)}).rowcount == 0:
                    return None
                if key is not None:
                    row = {"owner": owner, "key": key, "body_sha256": body_sha256, "instance": new.id}
                    connection.execute(insert(idempotency).values(created_at=now, **row))
                sql.add_event(connection, new)
        except IntegrityError:
            return None  # the same request came twice at once: the other one has it
        self.on_change(new.id)
        return new

    def _coming(self, connection: Connection, replaced: str | None) -> str | None:
        """The successor of an instance that is to get one; whoever else is about to give it one waits meanwhile."""
        if replaced is None:
            return None
        if self.served:
            connection.execute(sql.SUCCEED, {"instance": replaced})
        return connection.scalar(sql.SUCCESSOR, {"instance": replaced})

    def hand_out(self, instance: str, claim_sha256: str) -> bool:
        """Note who gets the key of an instance's session; False if somebody else has it."""
        mine = instances.c.claim.is_(None) | (instances.c.claim == claim_sha256)
        statement = update(instances).where(instances.c.id == instance, mine).values(claim=claim_sha256)
        with self._writing() as connection:
            return connection.execute(statement).rowcount == 1

    def successor(self, instance: str) -> str | None:
        """The id of the one that replaces an instance and has not ended."""
        with self._reader.connect() as connection:
            return connection.scalar(sql.SUCCESSOR, {"instance": instance})

    def last_params(self, service: str) -> dict[str, Any] | None:
        """What the last robot that asked for a service asked for; None: nobody did."""
        newest = select(instances.c.params).where(instances.c.service == service, instances.c.standby.is_(False))
        with self._reader.connect() as connection:
            return connection.scalar(newest.order_by(instances.c.created_at.desc()).limit(1))

    def renew(
        self,
        instance: str,
        now: float,
        lease_s: float | None,
        *,
        robot: str | None = None,
        measurements: dict[str, Any] | None = None,
    ) -> Renewed | None:
        """Keep an instance's lease.

        Args:
            instance: Which.
            now: Seconds since the epoch.
            lease_s: From now on; None: as before.
            robot: Whose it must be; None: anybody's.
            measurements: Instead of those before; None: as before.

        Returns:
            None if it is not there, not the robot's, or has ended or ends.
        """
        statement = sql.renewal(
            length=lease_s is not None, robot=robot is not None, measurements=measurements is not None
        )
        values = {"instance": instance, "now": now, "length": lease_s, "of_robot": robot, "measured": measurements}
        with self._writing(alone=True) as connection:
            row = connection.execute(statement, values).mappings().one_or_none()
        if row is None:
            return None
        renewed = Renewed(sql.record(row), row["successor"])
        self._remember(renewed.record)
        return renewed

    def keep_robot_reports(
        self,
        heard: Mapping[str, tuple[float, Mapping[str, Any]]],
        counted: Mapping[Owner, Iterable[tuple[str, Counts]]],
    ) -> Counter[str]:
        """Keep robots' reports instead of those before; whoever leads exports them.

        Args:
            heard: By instance, the time [s since the epoch] and the report.
            counted: By robot and service: lives and what each has counted by now.

        Returns:
            By robot, names that were too many: what is counted under them is not kept.
        """
        rows = [{"of_instance": i, "at": at, "report": report} for i, (at, report) in sorted(heard.items())]
        with self._writing() as connection:
            beyond = self._count(connection, counted)
            connection.execute(sql.HEAR, rows)
        return beyond

    def reports(self, control: Collection[str] | None = None) -> dict[str, dict[str, Any]]:
        """The last report on each instance that has not ended; only of robots that one of these controls, if given."""
        query = select(reports.c.instance, reports.c.report).join(instances).where(instances.c.state.not_in(sql.FINAL))
        if control is not None:
            query = query.where(reports.c.report["control_source"].as_string().in_(control))
        with self._reader.connect() as connection:
            rows = connection.execute(query)
            return {row.instance: row.report for row in rows}

    def count(self, record: Record, counted: Iterable[tuple[str, Counts]]) -> None:
        """Add to what is known of an instance's robot and service: lives and what each has counted by now."""
        with self._writing() as connection:
            self._count(connection, {(record.robot, record.service): counted})

    def _count(self, connection: Connection, counted: Mapping[Owner, Iterable[tuple[str, Counts]]]) -> Counter[str]:
        owners = sorted(counted)
        kept = _kept(connection, owners)
        new = [{"of_robot": robot, "of_service": service} for robot, service in owners if (robot, service) not in kept]
        if new:
            connection.execute(sql.NEW_ACCOUNT, new)
            kept = _kept(connection, owners)
        merged, beyond = merge(kept, counted, self._robot_names)
        rows = [{"of_robot": o[0], "of_service": o[1], "account": merged[o].document()} for o in owners]
        connection.execute(sql.KEEP_ACCOUNT, rows)
        return beyond

    def accounts(self) -> dict[tuple[str, str], CounterTotals]:
        """What is known, by robot and service."""
        with self._reader.connect() as connection:
            return {
                (row.robot, row.service): CounterTotals(row.account) for row in connection.execute(select(accounts))
            }

    def extend_leases(self, now: float, *, at_least: bool = False) -> None:
        """Give every live instance its whole lease from now, no less and no more; a standby keeps its own.

        For nobody could renew, or nobody can say when they did. ``at_least``: those that last longer stay as they are;
        for who does not lead, and may be late.
        """
        full: ColumnElement[float] = now + instances.c.lease_s
        if at_least:
            full = case((instances.c.lease_expires_at > full, instances.c.lease_expires_at), else_=full)
        statement = update(instances).where(instances.c.state.not_in(sql.FINAL), instances.c.standby.is_(False))
        with self._writing() as connection:
            connection.execute(statement.values(lease_expires_at=full, version=instances.c.version + 1))

    def events(self, instance: str, after: int) -> list[EventRow]:
        """An instance's events with higher ids, in order."""
        query = select(events).where(events.c.instance == instance, events.c.id > after).order_by(events.c.id)
        with self._reader.connect() as connection:
            rows = connection.execute(query).all()
        return [
            EventRow(row.id, row.instance, row.at, State(row.state), row.reason, row.code, row.pull) for row in rows
        ]

    def prune(self, now: float, ended_age: float, ended_count: int, events_count: int) -> list[tuple[str, str | None]]:
        """Forget ended instances that are too old or too many, their events, keys and sums, and the oldest events.

        What services reported is bounded by instance first (`_REPORTS`), then all events together.

        Returns:
            Forgotten instances with their sites.
        """
        ended = select(instances.c.id, instances.c.site, instances.c.updated_at).where(instances.c.state.in_(sql.FINAL))
        with self._writing() as connection:
            rows = connection.execute(ended.order_by(instances.c.updated_at.desc())).all()
            gone = [(r.id, r.site) for i, r in enumerate(rows) if i >= ended_count or r.updated_at < now - ended_age]
            connection.execute(delete(instances).where(instances.c.id.in_([i for i, _ in gone])))
            same = (instances.c.robot == accounts.c.robot) & (instances.c.service == accounts.c.service)
            connection.execute(delete(accounts).where(~exists().where(same)))
            rank = func.row_number().over(partition_by=events.c.instance, order_by=events.c.id.desc())
            told = select(events.c.id, rank.label("rank")).where(events.c.code != "").subquery()
            connection.execute(delete(events).where(events.c.id.in_(select(told.c.id).where(told.c.rank > _REPORTS))))
            # By their number, not by their ids: of those many are gone.
            beyond = connection.scalar(select(events.c.id).order_by(events.c.id.desc()).offset(events_count).limit(1))
            connection.execute(delete(events).where(events.c.id <= (beyond or 0)))
        return gone

    def _select(self, look: sql.Look, **named: str) -> list[Record]:
        """Oldest first. Of those that have not changed since they were seen last, only the version is read.

        One that was changed meanwhile is among them only if what is looked for is so still.
        """
        with self._reader.connect() as connection:
            rows = connection.execute(look.versions, named).all()
            found = {id_: self._seen.get(id_) for id_, _ in rows}
            changed = [id_ for id_, version in rows if (seen := found[id_]) is None or seen.version != version]
            for start in range(0, len(changed), _FETCHED):
                these = changed[start : start + _FETCHED]
                known = {id_: seen for id_ in these if (seen := found[id_]) is not None}
                found |= dict.fromkeys(these)
                if known:
                    rows_now = connection.execute(look.changeable, {**named, "ids": list(known)}).mappings()
                    found |= {row["id"]: sql.newer(known[row["id"]], row) for row in rows_now}
                if new := [id_ for id_ in these if id_ not in known]:
                    rows_now = connection.execute(look.whole, {**named, "ids": new}).mappings()
                    found |= {row["id"]: sql.record(row) for row in rows_now}
        for id_ in changed:
            if (record := found[id_]) is not None:
                self._remember(record)
        return [record for record in found.values() if record is not None]

    def _remember(self, record: Record) -> None:
        """As it is stored; a version that is not the newest any more does no harm. What has ended is not looked at."""
        if record.state.final:
            self._seen.pop(record.id, None)
            return
        if record.id not in self._seen and len(self._seen) >= _SEEN:
            self._seen = {}
        self._seen[record.id] = record

    def _records(self, query: Any) -> list[Record]:
        with self._reader.connect() as connection:
            return [sql.record(row) for row in connection.execute(query).mappings()]


def _kept(connection: Connection, owners: Iterable[Owner]) -> dict[Owner, dict[str, Any]]:
    rows = connection.execute(sql.LOCKED_ACCOUNTS, {"robots": list({robot for robot, _ in owners})})
    return {(row.robot, row.service): row.account for row in rows}
