"""No motion by itself after a reset (ISO 13850): whoever wants to drive must have wanted a standstill first. Pure.

A reset permits motion and must not begin it. So a command that was there all the time does not count; one that comes
after a standstill does, for somebody decided on it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import inf, nan

from skytether.control.admittance import Velocity

NEUTRAL_S = 0.2
"""How long a source must have wanted a standstill, and nothing else [s]. Longer than a queue on the way holds, shorter
than a person notices."""
_STANDSTILL = Velocity(1e-3, 1e-3)
"""What counts as one [m/s, rad/s]: the rest of a ramp, a stick that is not quite in its middle."""


@dataclass(frozen=True, slots=True)
class Neutral:
    """What is remembered of one source.

    Attributes:
        still_since: Since when it has wanted nothing but a standstill; NaN: it has not.
        why: What it has to be neutral after, for people; empty: it may drive.
    """

    still_since: float = nan
    why: str = ""


def require(why: str) -> Neutral:
    """Let a source wait until it was neutral."""
    return Neutral(why=why)


def want(before: Neutral, velocity: Velocity, now: float, decided: bool = True) -> Neutral:
    """The source wants a velocity; it is neutral when it goes on to another one after a long enough standstill.

    Args:
        before: What is remembered.
        velocity: Wanted.
        now: [s]
        decided: False: a standstill is told because nothing better is known; nobody wants it.
    """
    before = look(before, now)
    if not before.why:
        return before
    if not decided or not all(abs(value) <= most for value, most in zip(velocity, _STANDSTILL, strict=True)):
        return replace(before, still_since=nan)
    return before if before.still_since <= now else replace(before, still_since=now)


def look(before: Neutral, now: float) -> Neutral:
    """Whether it may drive by now. One that wanted a standstill and then fell silent wants it still."""
    return Neutral() if before.why and NEUTRAL_S <= now - before.still_since < inf else before
