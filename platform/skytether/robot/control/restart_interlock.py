"""No motion by itself after a reset (ISO 13850): whoever wants to drive must have wanted a standstill first. Pure.

A reset permits motion and must not begin it. So a command that was there all the time does not count; one that comes
after a standstill does, for somebody decided on it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import nan

from skytether.control.admittance import Velocity

NEUTRAL_S = 0.2
"""How long a source must have wanted a standstill, and nothing else [s]. Longer than a queue on the way holds, shorter
than a person notices."""
_VOUCHED_S = NEUTRAL_S / 2
"""How much of the time before it a message speaks for at most [s]: a value that is only held is not said, so it takes
three messages, however far apart they are."""
_ROUNDING_S = 1e-6
"""Of sums of times."""
_STANDSTILL = Velocity(1e-3, 1e-3)
"""What counts as one [m/s, rad/s]: the rest of a ramp, a stick that is not quite in its middle."""


@dataclass(frozen=True, slots=True)
class RestartInterlock:
    """What is remembered of one source.

    Attributes:
        said_s: For how long it has said standstill and nothing else [s].
        heard_at: When it said so last; NaN: it did not, or said something else since.
        why: What it has to be neutral after, for people; empty: it may drive.
    """

    said_s: float = 0.0
    heard_at: float = nan
    why: str = ""


def require(why: str) -> RestartInterlock:
    """Let a source wait until it was neutral."""
    return RestartInterlock(why=why)


def want(
    before: RestartInterlock, velocity: Velocity, now: float, timeout_s: float, decided: bool = True
) -> RestartInterlock:
    """The source wants a velocity; it may drive once it was neutral for long enough.

    Args:
        before: What is remembered.
        velocity: Wanted.
        now: When it was heard [s].
        timeout_s: A source that was silent for longer begins anew [s].
        decided: False: a standstill is told because nothing better is known; nobody wants it.
    """
    if not before.why:
        return before
    if not decided or not all(abs(value) <= most for value, most in zip(velocity, _STANDSTILL, strict=True)):
        return require(before.why)
    gap = now - before.heard_at
    said = before.said_s + min(gap, _VOUCHED_S) if 0 <= gap <= timeout_s else 0.0
    return RestartInterlock() if said >= NEUTRAL_S - _ROUNDING_S else replace(before, said_s=said, heard_at=now)
