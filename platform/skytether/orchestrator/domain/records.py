"""An instance as the store keeps it, and the table of its legal moves. Times are seconds since the epoch.

Wall-clock, not monotonic: leases and back-off must mean the same after a restart, on another machine too.
"""

from __future__ import annotations

import secrets
from collections.abc import Mapping
from copy import copy
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

from pydantic_core import to_json

from skytether.api.manifest import Manifest, ServiceSpec
from skytether.api.rest import Size, State

_REASON_LENGTH = 1024
MOVES: dict[State, frozenset[State]] = {
    State.PENDING: frozenset({State.PLACING, State.STOPPED}),
    State.PLACING: frozenset({State.PENDING, State.STARTING, State.STOPPED}),
    State.STARTING: frozenset({State.PENDING, State.RUNNING, State.STOPPING, State.FAILED}),
    State.RUNNING: frozenset({State.STARTING, State.STOPPING, State.FAILED}),
    State.STOPPING: frozenset({State.STOPPED}),
    State.STOPPED: frozenset(),
    State.FAILED: frozenset(),
}
"""Nothing runs before STARTING, so what is pending or placing stops without stopping. What could not be started at one
site is PENDING again, for another."""


class IllegalMoveError(Exception):
    """A move that is not in the table: a mistake in this program."""


def check_move(old: State, new: State) -> None:
    """Refuse what is not in the table; staying is no move.

    Raises:
        IllegalMoveError: It is not there.
    """
    if new is not old and new not in MOVES[old]:
        raise IllegalMoveError(f"an instance cannot go from {old} to {new}")


@dataclass(frozen=True)
class Record:
    """One instance. Nobody changes what its dictionaries and lists hold: others may have the same record."""

    id: str
    robot: str
    service: str
    session_id: str
    manifest: dict[str, Any]
    """As it was when the robot asked: a later change of the catalog does not touch what runs."""
    created_at: float
    lease_s: float
    lease_expires_at: float
    updated_at: float
    """Of state or reason; renewals do not count."""
    params: dict[str, Any] = field(default_factory=dict)
    measurements: dict[str, Any] = field(default_factory=dict)
    """By site: :class:`skytether.api.rest.Measurement` as JSON."""
    state: State = State.PENDING
    reason: str = ""
    pull: dict[str, Any] | None = None
    """:class:`skytether.api.pull_progress.PullProgress` as JSON, where the reason tells that; None: it does not."""
    site: str | None = None
    refused: list[dict[str, Any]] = field(default_factory=list)
    """:class:`skytether.api.rest.Refusal` as JSON."""
    scores: list[dict[str, Any]] = field(default_factory=list)
    """:class:`skytether.api.rest.Score` as JSON."""
    host: str | None = None
    port: int | None = None
    attempt: int = 1
    """Which run this is; what a runtime reports of an earlier one has been dealt with."""
    failures: int = 0
    """Quick ones in a row."""
    restarts: int = 0
    """At this site."""
    start_at: float = 0.0
    """The present run is not launched before this (back-off). Without a site: those that could not start it are tried
    again after this."""
    started_at: float | None = None
    """When the present run was launched."""
    running_at: float | None = None
    """When the present run was ready."""
    stopping_at: float | None = None
    replaces: str | None = None
    """The instance whose robot is to change to this one as soon as it runs."""
    pinned: str | None = None
    """The one site where it may run; None: any but that of the one it replaces."""
    standby: bool = False
    """Warm, and nobody's yet: it has no robot and no lease."""
    key_id: str = ""
    """Fingerprint of the secret key that its session's is derived from; empty: from before they were noted."""
    size: dict[str, Any] | None = None
    """:class:`skytether.api.rest.Size` as JSON: what it has now; None: what its manifest says."""
    resize: dict[str, Any] | None = None
    """What it is to have instead, with ``reason`` (bounded, for metrics) and ``why``; None: nothing else."""
    said: int = 0
    """Number of the last report of the present run that became an event: whoever leads next tells none twice."""
    version: int = 1
    """Counts changes: who changes a record must have seen the last one."""

    def after(self, changes: Mapping[str, Any]) -> Record:
        """As it is after changes of other fields than the manifest, which is not parsed again."""
        changed = copy(self)
        if "size" in changes and changes["size"] != self.size:
            vars(changed).pop("spec", None)
        vars(changed).update(changes)
        return changed

    @cached_property
    def spec(self) -> ServiceSpec:
        """What its manifest says, with the needs that it has now."""
        said = _spec(to_json(self.manifest))
        return said if self.size is None else said.sized(self.size["cpu"], self.size["memory_mb"])

    @property
    def has(self) -> Size:
        """What it has now."""
        needs = self.spec.needs
        return Size(cpu=needs.cpu, memory_mb=needs.memory_mb)

    def sized(self, size: Size) -> ServiceSpec:
        """What its manifest says, with other needs."""
        return _spec(to_json(self.manifest)).sized(size.cpu, size.memory_mb)

    @property
    def wants(self) -> Size | None:
        """What it is to have instead; None: nothing else."""
        return None if self.resize is None else Size(cpu=self.resize["cpu"], memory_mb=self.resize["memory_mb"])

    @property
    def holds(self) -> Size:
        """What is kept for it: what it has, or is to have, whichever is more."""
        has, wants = self.has, self.wants
        if wants is None:
            return has
        return Size(cpu=max(has.cpu, wants.cpu), memory_mb=max(has.memory_mb, wants.memory_mb))


class Change(NamedTuple):
    """What is to become of an instance."""

    record: Record
    """As it was seen."""
    columns: dict[str, Any]
    through: State | None = None
    """A state that it passes at once."""
    happened: str = ""
    """What is told as an event, where neither state nor reason tells it."""

    @property
    def state(self) -> State:
        """In which it is then."""
        return State(self.columns.get("state", self.record.state))

    @property
    def after(self) -> Record:
        """As it is then."""
        return self.record.after(self.columns)

    def draft(self, now: float) -> tuple[Record, dict[str, Any], list[Record]]:
        """The record as it would be, the columns that change, and what is told of it, in this order.

        Raises:
            IllegalMoveError: The move of state is not in the table.
        """
        record, changes = self.record, self.columns
        state, reason = changes.get("state", record.state), changes.get("reason", record.reason)[:_REASON_LENGTH]
        through = {"state": self.through, "reason": "", "pull": None, "updated_at": now}
        passed = record.after(through) if self.through else record
        check_move(record.state, passed.state)
        check_move(passed.state, state)
        told = state is not record.state or reason != record.reason
        columns = {
            **({"pull": None} if told else {}),
            **changes,
            "version": record.version + 1,
            "reason": reason,
            "updated_at": now if told else record.updated_at,
        }
        new = record.after(columns)
        events = [passed] if self.through else []
        events += [new] if told else []
        if self.happened:
            events.append(new.after({"reason": self.happened[:_REASON_LENGTH], "pull": None, "updated_at": now}))
        return new, columns, events


@lru_cache(maxsize=256)
def _spec(manifest: bytes) -> ServiceSpec:
    """Parsed once: a pass over many instances asks again and again, and few services are theirs."""
    return Manifest.model_validate_json(manifest).spec


def new_record(**values: Any) -> Record:
    """One with an id and a session of its own, which nobody can guess."""
    return Record(id=secrets.token_hex(8), session_id=secrets.token_hex(8), **values)
