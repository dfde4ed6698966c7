"""What may become of an instance, each with a name: a change of its record is made here and nowhere else. Pure.

A change is drafted against the record as it was seen, and the table of moves in ``records`` says whether its state may
change so; the store makes it, unless somebody else was quicker.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from skytether.api.pull_progress import PullProgress
from skytether.api.rest import Refusal, Score, Size, State

from .records import Change, Record


def waiting(record: Record, reason: str, refused: Sequence[Refusal]) -> Change:
    """No site takes it now."""
    return Change(record, {"state": State.PENDING, "reason": reason, "refused": _dumped(refused)})


def starting(
    record: Record, site: str, scores: Sequence[Score], refused: Sequence[Refusal], instead: str = ""
) -> Change:
    """A site was chosen. With ``instead``, which says so, it has what its manifest says and not what it had."""
    columns: dict[str, Any] = {
        "state": State.STARTING,
        "reason": "",
        "site": site,
        "refused": _dumped(refused),
        "scores": [score.model_dump() for score in scores],
        "start_at": 0.0,
    }
    if instead:
        columns["size"] = None
    return Change(record, columns, State.PLACING if record.state is State.PENDING else None, instead)


def launched(record: Record, now: float) -> Change:
    """Its site is about to be told to start it."""
    return Change(record, {"started_at": now, "said": 0})


def progressed(record: Record, now: float, detail: str, pull: PullProgress | None = None) -> Change:
    """Its start has come further, and has its time anew."""
    return Change(record, {"reason": detail, "started_at": now, "pull": pull.model_dump() if pull else None})


def running(record: Record, now: float, host: str | None, port: int | None) -> Change:
    """It is ready, and reached there."""
    since = record.running_at if record.state is State.RUNNING else now
    return Change(record, {"state": State.RUNNING, "reason": "", "host": host, "port": port, "running_at": since})


def restarting(record: Record, failures: int, start_at: float, reason: str) -> Change:
    """Its run has ended, and another one is to begin at the same site; ``failures``: quick ones in a row by now."""
    return Change(
        record,
        {
            "state": State.STARTING,
            "reason": reason,
            "failures": failures,
            "attempt": record.attempt + 1,
            "restarts": record.restarts + 1,
            "start_at": start_at,
            "started_at": None,
            "running_at": None,
        },
    )


def crashed(record: Record, failures: int, reason: str) -> Change:
    """Its run has ended, and no other one begins."""
    return Change(
        record,
        {"state": State.FAILED, "reason": reason, "failures": failures, "started_at": None, "running_at": None},
    )


def unstarted(record: Record, attempt: int, start_at: float, reason: str, refused: Sequence[Refusal]) -> Change:
    """Its site cannot start it: it is placed anew; what could not start it is tried again after ``start_at``."""
    return Change(
        record,
        {
            "state": State.PENDING,
            "reason": reason,
            "site": None,
            "host": None,
            "port": None,
            "refused": _dumped(refused),
            "attempt": attempt,
            "failures": 0,
            "restarts": 0,
            "start_at": start_at,
            "started_at": None,
            "running_at": None,
        },
    )


def displaced(record: Record, reason: str) -> Change:
    """It was lost with its site, and is placed anew."""
    return Change(
        record,
        {
            "state": State.PENDING,
            "reason": reason,
            "site": None,
            "host": None,
            "port": None,
            "attempt": record.attempt + 1,
            "restarts": record.restarts + 1,
            "start_at": 0.0,
            "started_at": None,
            "running_at": None,
        },
        State.STARTING if record.state is State.RUNNING else None,
    )


def stopping(record: Record, now: float, reason: str) -> Change:
    """It is to end; without a site it has ended."""
    to = State.STOPPED if record.site is None else State.STOPPING
    return Change(record, {"state": to, "stopping_at": now, "reason": reason})


def stopped(record: Record, reason: str | None = None) -> Change:
    """It has ended, as it was to; None: for the reason that it has."""
    return Change(record, {"state": State.STOPPED} if reason is None else {"state": State.STOPPED, "reason": reason})


def failed(record: Record, reason: str) -> Change:
    """It has ended, for a reason that is not its own."""
    return Change(record, {"state": State.FAILED, "reason": reason})


def explained(record: Record, reason: str) -> Change:
    """It is as it was, and there is something to say of that; empty: not any more."""
    return Change(record, {"reason": reason})


def noted(record: Record, text: str) -> Change:
    """It is as it was, and an event tells something."""
    return Change(record, {}, happened=text)


def resizing(record: Record, size: Size, reason: str, why: str) -> Change:
    """It is to have another size; ``reason`` is bounded, for metrics."""
    return Change(record, {"resize": _resize(size, reason, why)})


def resized(record: Record, size: Size, text: str) -> Change:
    """It has the size that it was to have."""
    return Change(record, {"size": size.model_dump(), "resize": None}, happened=text)


def not_resized(record: Record, text: str) -> Change:
    """It does not get the size that it was to have."""
    return Change(record, {"resize": None}, happened=text)


def with_memory(change: Change, size: Size) -> Change:
    """The same, and its next run has more memory."""
    record, reason = change.record, change.columns["reason"]
    text = f"{reason}, with {size.memory_mb} MiB of memory instead of {record.has.memory_mb}"
    return change._replace(columns={**change.columns, "size": size.model_dump(), "resize": None, "reason": text})


def claimed(standby: Record, wanted: Record, now: float) -> Change:
    """A standby becomes what somebody asked for."""
    return Change(
        standby,
        {
            "robot": wanted.robot,
            "measurements": wanted.measurements,
            "lease_s": wanted.lease_s,
            "lease_expires_at": wanted.lease_expires_at,
            "created_at": wanted.created_at,
            "updated_at": now,
            "standby": False,
        },
    )


def takes_over(standby: Record, wanted: Record, now: float) -> Change:
    """A standby becomes the successor of the instance that ``wanted`` replaces, with what that one had."""
    change = claimed(standby, wanted, now)
    columns: dict[str, Any] = {**change.columns, "replaces": wanted.replaces, "created_at": now}
    if wanted.has != standby.has:
        columns["resize"] = _resize(wanted.has, "successor", f"instance {wanted.replaces} had that")
    return change._replace(columns=columns)


def _resize(size: Size, reason: str, why: str) -> dict[str, Any]:
    return {**size.model_dump(), "reason": reason, "why": why}


def _dumped(refused: Sequence[Refusal]) -> list[Mapping[str, Any]]:
    return [refusal.model_dump() for refusal in refused]
