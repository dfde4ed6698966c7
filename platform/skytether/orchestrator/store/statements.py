"""Statements about instances, made once: to make one takes longer than to run it; and their rows as records."""

from __future__ import annotations

import dataclasses
from functools import cache
from typing import Any, NamedTuple

from sqlalchemy import (
    ColumnElement,
    Connection,
    Float,
    FromClause,
    RowMapping,
    Select,
    and_,
    bindparam,
    case,
    func,
    insert,
    select,
    text,
    update,
)
from sqlalchemy.sql.dml import ReturningUpdate

from skytether.api.rest import State

from ..domain.records import Record
from .models import accounts, events, instances, reports

FINAL = [state for state in State if state.final]


def serves(table: FromClause) -> ColumnElement[bool]:
    """It has not ended, and is not about to."""
    return and_(*(table.c.state != state for state in (*FINAL, State.STOPPING)))


# Made once: what every request asks. To make a statement takes longer than to run it.
INSTANCE = select(instances).where(instances.c.id == bindparam("instance"))
_later = instances.alias()
SUCCESSOR = (
    select(_later.c.id)
    .where(_later.c.replaces == bindparam("instance"), serves(_later))
    .order_by(_later.c.created_at.desc())
    .limit(1)
)
SUCCEEDS = SUCCESSOR.scalar_subquery().label("successor")
"""Not by the renewed row's own id: names after RETURNING lose their table's on SQLite, and would be the subquery's."""
SUCCEED = text("SELECT pg_advisory_xact_lock(hashtextextended(:instance, 0))")
"""Not a lock of its row: who extends all leases locks rows in any order."""
LOCKED_ACCOUNTS = (
    select(accounts)
    .where(accounts.c.robot.in_(bindparam("robots", expanding=True)))
    .order_by(accounts.c.robot, accounts.c.service)
    .with_for_update()
)
"""Locked, for two orchestrators may be told of the same robots at once; in order, lest each waits for the other."""
NEW_ACCOUNT = text(
    "INSERT INTO accounts (robot, service, account) VALUES (:of_robot, :of_service, '{}') ON CONFLICT DO NOTHING"
)
KEEP_ACCOUNT = (
    update(accounts)
    .where(accounts.c.robot == bindparam("of_robot"), accounts.c.service == bindparam("of_service"))
    .values(account=bindparam("account"))
)
HEAR = text(
    "INSERT INTO reports (instance, at, report) SELECT id, :at, :report FROM instances WHERE id = :of_instance"
    " ON CONFLICT (instance) DO UPDATE SET at = excluded.at, report = excluded.report WHERE reports.at <= excluded.at"
).bindparams(bindparam("report", type_=reports.c.report.type))
"""Nothing for an instance that was forgotten meanwhile, or of which another orchestrator has heard since."""


@cache
def renewal(*, length: bool, robot: bool, measurements: bool) -> ReturningUpdate[Any]:
    """Renews a lease, perhaps with another length, only for a robot, with new measurements; tells the successor too.

    One that comes late, for its orchestrator was frozen or waited for the database, does not shorten what a later one
    gave, unless it asks for another length.
    """
    lease_s = bindparam("length", type_=Float) if length else instances.c.lease_s
    statement = update(instances).where(instances.c.id == bindparam("instance"), serves(instances))
    if robot:
        statement = statement.where(instances.c.robot == bindparam("of_robot"))
    if measurements:
        statement = statement.values(measurements=bindparam("measured"))
    # The version counts up, so that whoever is about to end it for its old lease has to look again.
    full = bindparam("now", type_=Float) + lease_s
    later = and_(instances.c.lease_expires_at > full, instances.c.lease_s == lease_s)
    ends = {"lease_s": lease_s, "lease_expires_at": case((later, instances.c.lease_expires_at), else_=full)}
    return statement.values(**ends, version=instances.c.version + 1).returning(instances, SUCCEEDS)


LIVE = instances.c.state.not_in(FINAL)
CHANGE = update(instances).where(
    instances.c.id == bindparam("seen_id"), instances.c.version == bindparam("seen_version")
)
EVENT = insert(events)


class Look(NamedTuple):
    """For instances that are so at the moment when each statement is executed."""

    versions: Select[str, int]
    """Which, oldest first, and how often each was changed."""
    whole: Select[Any]
    """Those of these ids."""
    changeable: Select[Any]
    """The same without the manifest, which is the largest part and stays as it is."""


def look(*conditions: ColumnElement[bool]) -> Look:
    """How to look for instances."""
    versions = select(instances.c.id, instances.c.version).where(*conditions)
    some = (instances.c.id.in_(bindparam("ids", expanding=True)), *conditions)
    return Look(
        versions.order_by(instances.c.created_at, instances.c.id),
        select(instances).where(*some),
        select(*(column for column in instances.c if column is not instances.c.manifest)).where(*some),
    )


EVERY = look()
ALL_LIVE = look(LIVE)
LIVE_OF = look(LIVE, instances.c.robot == bindparam("robot"))
COUNT_LIVE = select(func.count()).where(LIVE, instances.c.service == bindparam("service"))
LIVE_AT = look(LIVE, instances.c.site == bindparam("site"))
CHANGING_AT = look(instances.c.state.in_([State.STARTING, State.STOPPING]), instances.c.site == bindparam("site"))
WAITING = look(instances.c.state.in_([State.PENDING, State.PLACING]))
LIVE_STANDBYS = look(LIVE, instances.c.standby)
STANDBYS = look(instances.c.standby, instances.c.service == bindparam("service"), instances.c.state == State.RUNNING)


def values(record: Record) -> dict[str, Any]:
    """The columns of a record."""
    return {field.name: getattr(record, field.name) for field in dataclasses.fields(record)}


COLUMNS = [field.name for field in dataclasses.fields(Record)]


def record(row: RowMapping) -> Record:
    """The record of a row."""
    return Record(**{name: row[name] for name in COLUMNS})


def newer(seen: Record, row: RowMapping) -> Record:
    """The record that was seen, as a row of `Look.changeable` has it now."""
    # By the fields' names: a column may have an older one.
    return seen.after({name: row[name] for name in COLUMNS if name != "manifest"})


def as_seen(record: Record) -> dict[str, Any]:
    """That it is changed only if it is still so."""
    return {"seen_id": record.id, "seen_version": record.version}


def add_event(connection: Connection, record: Record) -> None:
    """Tell of an instance as it is."""
    connection.execute(EVENT, event(record))


def event(record: Record) -> dict[str, Any]:
    """The row that tells of an instance as it is."""
    return {
        "instance": record.id,
        "at": record.updated_at,
        "state": record.state.value,
        "reason": record.reason,
        "pull": record.pull,
    }
