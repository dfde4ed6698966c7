"""How old a reading is, by the stamps of its sensor. Pure: time is an argument.

Clocks of sensors are not ours: they start when they like, are set, and run a little faster or slower. So a stamp says
two things only. Its order: a reading that is not newer than one before is not used, until such stamps have gone on
evenly for a second, which is what a clock that was set back looks like. And its delay: how much later it came than the
quickest readings so far; that is added to its age. Only where a sensor is known to use our clock (`StampRule.OWN`) a
stamp says how old a reading is, and one that is late from the first is found out.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum
from math import inf, isfinite, nan

_DRIFT = 5e-4
"""Seconds per second that two clocks may part: the fastest that NTP slews one."""
_AGAIN_S = 1.0
"""How long stamps that went back must go on evenly until they are believed."""
_AGAIN_COUNT = 5
"""And how many there must be."""
_EVEN_S = 0.25
"""What counts as evenly: stamps and arrivals differ by less from one to the next."""
_NANO = 1_000_000_000
_AHEAD_S = 0.05
"""How far ahead of our clock a stamp of it may be: a driver may stamp the end of a turn that is not over yet."""

Stamp = tuple[int, int]
"""Seconds and nanoseconds."""


class StampRule(StrEnum):
    """What is asked of stamps."""

    AUTO = "auto"
    """Used if the first reading has one."""
    REQUIRED = "required"
    """A reading without is not used."""
    ORDER = "order"
    """Only their order: for simulators whose time runs at another speed."""
    OWN = "own"
    """They are of this computer's clock, so that they tell the age itself. A reading without is not used."""


@dataclass(frozen=True, slots=True)
class Stamps:
    """What is remembered of one sensor.

    Attributes:
        newest: Of all that were used; None: none had a stamp.
        at: When that one came [s].
        offset: Arrival minus stamp of the quickest [s].
        again: The last of those that went back.
        again_at: When it came [s].
        again_since: When the first of an even row of them came [s].
        again_count: How many they are.
    """

    newest: Stamp | None = None
    at: float = 0.0
    offset: float = inf
    again: Stamp = (0, 0)
    again_at: float = 0.0
    again_since: float = 0.0
    again_count: int = 0


@dataclass(frozen=True, slots=True)
class Dated:
    """What a stamp says.

    Attributes:
        stamps: What is to be remembered.
        delay: How much later than the quickest it came [s].
        wrong: Kind of what is wrong with it (``repeated``, ``older``, ``unstamped``, ``ahead``); empty: it may
            be used.
    """

    stamps: Stamps
    delay: float = 0.0
    wrong: str = ""


def date(rule: StampRule, before: Stamps, stamp: Stamp, now: float, max_age: float, wall: float = nan) -> Dated:
    """Take a reading's stamp in.

    Args:
        rule: What is asked of it.
        before: What is remembered.
        stamp: Zero: it has none.
        now: When it came, monotonic seconds.
        max_age: Age at which it is stale [s]; one that is later does not become what is usual.
        wall: This computer's clock when it came, as stamps have it [s]; only looked at with `StampRule.OWN`.
    """
    stamp = stamp[0] + stamp[1] // _NANO, stamp[1] % _NANO  # a driver may count nanoseconds beyond a second
    if stamp == (0, 0):
        missing = rule in (StampRule.REQUIRED, StampRule.OWN) or before.newest is not None
        return Dated(before, wrong="unstamped") if missing else Dated(before)
    if before.newest is None or stamp > before.newest:
        return _newer(rule, before, stamp, now, max_age, wall)
    if stamp == before.newest:
        return Dated(before, wrong="repeated")
    elapsed, advanced = now - before.again_at, _seconds(stamp) - _seconds(before.again)
    even = stamp > before.again and (rule is StampRule.ORDER or abs(advanced - elapsed) <= _EVEN_S)
    count, since = (before.again_count + 1, before.again_since) if before.again_count and even else (1, now)
    if count >= _AGAIN_COUNT and now - since >= _AGAIN_S:
        return _newer(rule, Stamps(), stamp, now, max_age, wall)
    marked = replace(before, again=stamp, again_at=now, again_since=since, again_count=count)
    return Dated(marked, wrong="older")


def _newer(rule: StampRule, before: Stamps, stamp: Stamp, now: float, max_age: float, wall: float) -> Dated:
    offset = now - _seconds(stamp)
    if rule is StampRule.OWN:
        age = wall - _seconds(stamp)
        if not age >= -_AHEAD_S:
            return Dated(before, wrong="ahead")
        return Dated(Stamps(newest=stamp, at=now, offset=offset), max(0.0, age))
    usual = min(offset, before.offset + _DRIFT * max(0.0, now - before.at))
    delay = 0.0 if rule is StampRule.ORDER else offset - usual
    if not delay <= max_age:
        usual = before.offset
        delay = offset - usual if isfinite(now) else inf
    return Dated(Stamps(newest=stamp, at=now, offset=usual), delay)


def _seconds(stamp: Stamp) -> float:
    return stamp[0] + stamp[1] * 1e-9
