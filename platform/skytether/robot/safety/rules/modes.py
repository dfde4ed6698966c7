"""Limits by mode: with a load, with people near, in a narrow hall. Pure: time is an argument.

A mode only ever tightens: slower, gentler, more room, a larger outline. Modes that hold together are as tight as each
of them. The robot itself says which hold, again and again, on a topic or by a request at the gate's socket; what it
says is nobody else's to say. While nobody says it, or something unknown is said, all of them hold.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from math import inf, nan

from skytether.robot.control.supervisor import VelocityLimits

from ..geometry.footprint import Footprint, polygon
from .zones import ZoneParams

MOST_MODES = 8
"""Every set of them is an outline and zones of its own, made when it first holds: 256 at most."""
LONGEST_TEXT = 400
"""Characters of what is said; eight names are shorter."""
_EDGE_M = 1e-6
_TOLERANCE_S = 0.05
"""How far ahead of now something may have been heard."""
_NONE = frozenset({"", "none", "normal"})
_SMALLER = (
    "linear_max",
    "angular_max",
    "linear_acceleration",
    "angular_acceleration",
    "linear_braking",
    "angular_braking",
)
TIGHTENED = frozenset((*_SMALLER, "linear_min"))
"""The limits that a mode may have."""
_LARGER = ("stop_m", "slow_m", "hysteresis_m", "sensing_s", "reaction_s")


@dataclass(frozen=True, eq=False)
class Envelope:
    """What holds at a time.

    Attributes:
        limits: Of the wheels. The braking is what the zones rely on; the guard may brake harder.
        zones: Sizes.
        footprint: Outline with all that it carries.
    """

    limits: VelocityLimits
    zones: ZoneParams
    footprint: Footprint

    def tightened(self, other: Envelope) -> Envelope:
        """As tight as both in everything."""
        a, b = self.limits, other.limits
        limits = replace(
            a,
            linear_min=max(a.linear_min, b.linear_min),
            **{name: min(getattr(a, name), getattr(b, name)) for name in _SMALLER},
        )
        zones = replace(
            self.zones,
            slow_speed=min(self.zones.slow_speed, other.zones.slow_speed),
            **{name: max(getattr(self.zones, name), getattr(other.zones, name)) for name in _LARGER},
        )
        both = [*self.footprint.vertices.tolist(), *other.footprint.vertices.tolist()]
        return Envelope(limits, zones, polygon((x, y) for x, y in both))

    def loosens(self, base: Envelope) -> str:
        """The first key in which this is less tight than the base; empty: it is in none."""
        for name in _SMALLER:
            if getattr(self.limits, name) > getattr(base.limits, name):
                return f"limits.{name}"
        if self.limits.linear_min < base.limits.linear_min:
            return "limits.linear_min"
        for name in _LARGER:
            if getattr(self.zones, name) < getattr(base.zones, name):
                return f"zones.{name}"
        if self.zones.slow_speed > base.zones.slow_speed:
            return "zones.slow_speed"
        inside = self.footprint.outside(base.footprint.vertices).max() <= _EDGE_M
        return "" if inside else "footprint"


@dataclass(frozen=True, slots=True)
class ModeRules:
    """Which modes there are, and who says which hold.

    Attributes:
        envelopes: By name.
        topic: std_msgs/String with the names of those that hold, with commas between; empty: there is none, and
            requests say it.
        max_age_s: Silence of the topic after which all hold [s].
    """

    envelopes: Mapping[str, Envelope] = field(default_factory=dict)
    topic: str = ""
    max_age_s: float = 1.0


class Modes:
    """Remembers what was said, and makes the envelope of it.

    Args:
        rules: What is configured.
        base: Without any mode.
    """

    def __init__(self, rules: ModeRules, base: Envelope) -> None:
        self._rules = rules
        self._said: frozenset[str] | None = None
        self._heard_at = nan
        self._unknown = ""
        self._made: dict[frozenset[str], Envelope] = {frozenset(): base}

    def select(self, text: str, now: float) -> str:
        """Somebody says which modes hold: names with commas between; empty, ``none`` and ``normal``: none of them.

        Returns:
            What is wrong with it, in which case all hold; empty: nothing.
        """
        names = frozenset(name.strip() for name in text[:LONGEST_TEXT].split(",")) - _NONE
        unknown = sorted(names - set(self._rules.envelopes))
        self._heard_at = now
        self._unknown = unknown[0][:32] if unknown else ""
        self._said = None if unknown else names
        if unknown:
            there = ", ".join(self._rules.envelopes)
            return f"there is no mode '{self._unknown}' (there are {there}); all hold"
        return ""

    def active(self, now: float, troubles: dict[str, str]) -> frozenset[str]:
        """Which hold now.

        Args:
            now: [s]
            troubles: Gets a sentence for people if that was not said.
        """
        rules, everything = self._rules, frozenset(self._rules.envelopes)
        if not everything:
            return everything
        oldest = rules.max_age_s if rules.topic else inf
        if not -_TOLERANCE_S <= now - self._heard_at <= oldest:
            source = f"{rules.topic} is not heard" if rules.topic else "nobody has said which holds"
            troubles["mode"] = f"mode: {source}; all hold: {', '.join(rules.envelopes)}"
            return everything
        if self._said is None:
            troubles["mode"] = f"mode: '{self._unknown}' is none of {', '.join(rules.envelopes)}; all hold"
            return everything
        return self._said

    def envelope(self, active: frozenset[str]) -> Envelope:
        """What holds with these; the same object each time."""
        if active not in self._made:
            made = self._made[frozenset()]
            for name in sorted(active):
                made = made.tightened(self._rules.envelopes[name])
            self._made[active] = made
        return self._made[active]
