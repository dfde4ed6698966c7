"""What is to be done next, from what should be and what is: pure, and level-triggered.

It makes no difference how things came to be as they are, so a crash of a service, a crash of the orchestrator and a
call that got lost are all mended by the next look. Each run of an instance has a number (``attempt``); an observation
of an earlier one has been dealt with and only says what is still there.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass

from skytether.api.pull_progress import PullProgress
from skytether.api.rest import State

from ..config.settings import Timing
from ..domain.records import Change, Record
from ..domain.transitions import crashed, restarting
from ..runtimes.base import Observation, Phase

BAD_GRANT_STATUS = 2
"""Exit status of a service that does not like its parameters or grant: another try would end the same way."""
_RETURN_S = 60.0
"""Seconds, or a lease if that is shorter, that robots get to renew once a silent site answers again: who was cut off
together with it could not, and is driven by what runs there."""


@dataclass(frozen=True, slots=True)
class Place:
    """Choose a site."""

    record: Record


@dataclass(frozen=True, slots=True)
class Start:
    """Begin the present run."""

    record: Record


@dataclass(frozen=True, slots=True)
class Progress:
    """The present run is not ready, but further than it was: its time to start begins anew."""

    record: Record
    detail: str
    pull: PullProgress | None = None
    """Where the detail says how far a pull is."""


@dataclass(frozen=True, slots=True)
class Ready:
    """The service listens (again, or elsewhere)."""

    record: Record
    host: str | None
    port: int | None


@dataclass(frozen=True, slots=True)
class Crash:
    """The present run is over and was not asked to be; see :func:`after_crash`."""

    record: Record
    why: str
    """Continues "the service ..."."""
    for_good: bool = False
    out_of_memory: bool = False
    unstarted: bool = False
    """It could not even be begun and nothing is left, or it ended before it was ready: another site may do better."""


@dataclass(frozen=True, slots=True)
class Expire:
    """The lease ran out."""

    record: Record


@dataclass(frozen=True, slots=True)
class End:
    """Nothing of it is left: stopping becomes stopped."""

    record: Record


@dataclass(frozen=True, slots=True)
class Stop:
    """Make the runtime end it."""

    instance: str
    force: bool


@dataclass(frozen=True, slots=True)
class Remove:
    """A stranger: at the site, but in no row of the store."""

    instance: str


Action = Place | Start | Progress | Ready | Crash | Expire | End | Stop | Remove


def plan(
    live: Iterable[Record],
    observed: Mapping[str, Observation],
    ended: Collection[str],
    now: float,
    timing: Timing,
    seen_since: float = -math.inf,
) -> list[Action]:
    """Every action due at one site (or, with nothing observed, for what has no site yet).

    Args:
        live: Records that have not ended.
        observed: What the runtime reports.
        ended: Those of the observed that the store knows as ended.
        now: Seconds since the epoch.
        timing: How patient to be.
        seen_since: Since when the site has answered each time (seconds since the epoch): what nobody sees is not late.
    """
    actions: list[Action] = []
    expected = set()
    for record in live:
        expected.add(record.id)
        action = decide(record, observed.get(record.id), now, timing, seen_since)
        if action is not None:
            actions.append(action)
    for instance, seen in observed.items():
        if instance in expected:
            continue
        if instance not in ended:
            actions.append(Remove(instance))
        elif seen.phase is not Phase.EXITED:
            actions.append(Stop(instance, force=True))
    return actions


def decide(
    record: Record, seen: Observation | None, now: float, timing: Timing, seen_since: float = -math.inf
) -> Action | None:
    """The next action for one instance; None: wait. See :func:`plan`."""
    there = seen is not None and seen.phase is not Phase.EXITED
    if record.state is State.STOPPING:
        if not there:
            return End(record)
        return Stop(record.id, force=_waited(record.stopping_at or 0.0, now, seen_since) >= timing.stop_grace)
    if record.state.final:
        return Stop(record.id, force=True) if there else None
    if now >= record.lease_expires_at and now - seen_since >= min(record.lease_s, _RETURN_S):
        return Expire(record)
    if record.state in (State.PENDING, State.PLACING):
        return Place(record)
    if seen is not None and seen.attempt != record.attempt:
        if there:
            return Stop(record.id, force=True)  # what is left of an earlier run
        seen = None
    if seen is not None and there and seen.exceeds:
        return Crash(record, seen.exceeds, for_good=True)
    if record.state is State.STARTING:
        return _starting(record, seen, now, timing, seen_since)
    return _running(record, seen)


def _waited(since: float, now: float, seen_since: float) -> float:
    """Seconds in which something could be seen; a date that is still to come was another clock's."""
    return now - (seen_since if since > now else max(since, seen_since))


def _starting(record: Record, seen: Observation | None, now: float, timing: Timing, seen_since: float) -> Action | None:
    if seen is None:
        # A wait longer than the longest was another clock's.
        return Start(record) if not 0 < record.start_at - now <= timing.backoff_max else None
    if seen.phase is Phase.RUNNING:
        return Ready(record, seen.host, seen.port)
    if seen.phase is Phase.EXITED:
        for_good = seen.exit_status == BAD_GRANT_STATUS
        ended = seen.exit_status is not None and not for_good  # else something may be left that is to be cleared first
        unstarted = seen.unstarted or ended
        return Crash(record, how_it_ended(seen), for_good, out_of_memory=seen.out_of_memory, unstarted=unstarted)
    waits_for = str(seen.pull) if seen.pull else seen.detail
    if waits_for and waits_for != record.reason:
        return Progress(record, waits_for, seen.pull)
    if record.started_at is not None and _waited(record.started_at, now, seen_since) > timing.start_timeout:
        why = f"was not ready within {timing.start_timeout:g} s"
        return Crash(record, f"{why}: {waits_for}" if waits_for else why, unstarted=seen.unstarted)
    return None


def _running(record: Record, seen: Observation | None) -> Action | None:
    if seen is None:
        return Crash(record, "is gone")
    if seen.phase is Phase.EXITED:
        return Crash(record, how_it_ended(seen), out_of_memory=seen.out_of_memory)
    if seen.phase is Phase.RUNNING and seen.detail:
        return Crash(record, f"is not well: {seen.detail}")
    if seen.phase is Phase.RUNNING and (seen.host, seen.port) != (record.host, record.port):
        return Ready(record, seen.host, seen.port)
    return None


def how_it_ended(seen: Observation) -> str:
    """In words that continue "the service ..."."""
    if seen.detail:
        text = seen.detail
    elif seen.exit_status is None:
        text = "ended"
    elif seen.exit_status < 0:
        text = f"was killed by signal {-seen.exit_status}"
    else:
        text = f"ended with exit status {seen.exit_status}"
    return f'{text}; its last line: "{seen.last_line}"' if seen.last_line else text


def failures_by(crash: Crash, now: float, timing: Timing) -> int:
    """Quick failures in a row, with this one."""
    record = crash.record
    ran = now - record.running_at if record.running_at is not None else 0.0
    return 1 if ran >= timing.stable else record.failures + 1


def after_crash(crash: Crash, now: float, timing: Timing) -> Change:
    """What a crash changes in the record: the next run and when, or failed with a reason to act on."""
    record, failures = crash.record, failures_by(crash, now, timing)
    if crash.for_good:
        return crashed(record, failures, f"the service {crash.why}; correct what it names and ask again")
    if failures >= timing.max_failures:
        advice = f"see `skytether instance logs {record.id}`"
        return crashed(
            record, failures, f"given up after {failures} failures in a row: the service {crash.why}; {advice}"
        )
    wait = backoff(failures, timing)
    reason = f"the service {crash.why}; starting it again" + (f" in {wait:g} s" if wait else "")
    return restarting(record, failures, now + wait, reason)


def backoff(failures: int, timing: Timing) -> float:
    """Seconds to wait after so many quick failures in a row."""
    if failures <= 1:
        return 0.0
    # The exponent is bounded: a power of two beyond floating point would raise.
    return min(timing.backoff * 2.0 ** min(failures - 2, 64), timing.backoff_max)
