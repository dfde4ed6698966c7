"""The parts of the section ``safety`` about modes: what people write, checked, and the envelopes that follow."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace
from typing import Annotated

from pydantic import Field

from ...config_base import Numbers, Topic
from ..rules.modes import MOST_MODES, TIGHTENED, Envelope, ModeRules
from ..rules.zones import ZoneParams
from .outline_config import OutlineConfig

ModeName = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]{0,31}$")]


class ModeConfig(Numbers):
    """What is tighter in this mode; the rest is as without it."""

    limits: dict[str, float] = {}
    """Of the supervisor's limits those about velocities, accelerations and braking."""
    zones: dict[str, float] = {}
    footprint: OutlineConfig | None = None
    """With the load; it must hold the ordinary one."""

    def envelope(self, base: Envelope) -> Envelope:
        """What holds in this mode alone.

        Raises:
            ValueError: A key is unknown, or looser than without the mode; the text names it.
        """
        _know("limits", self.limits, TIGHTENED)
        _know("zones", self.zones, frozenset(f.name for f in fields(ZoneParams)))
        limits = dict(self.limits)
        for axis in ("linear", "angular"):  # who brakes weaker does not speed up faster than that
            braking = limits.get(f"{axis}_braking", getattr(base.limits, f"{axis}_braking"))
            limits.setdefault(f"{axis}_acceleration", min(getattr(base.limits, f"{axis}_acceleration"), braking))
        outline = base.footprint if self.footprint is None else self.footprint.footprint()
        made = Envelope(replace(base.limits, **limits), replace(base.zones, **self.zones), outline)
        if key := made.loosens(base):
            raise ValueError(f"{key}: a mode only tightens, and this is looser than without it")
        return made


class ModeSource(Numbers):
    """Who says which modes hold: a program of the robot, again and again (std_msgs/msg/String: names with commas)."""

    topic: Topic | None = None
    """null: requests say it (``skytether robot mode NAMES``), and all hold until the first."""
    max_age_s: Annotated[float, Field(gt=0, le=60)] = 1.0
    """Silence after which all hold."""


Modes = Annotated[dict[ModeName, ModeConfig], Field(max_length=MOST_MODES)]


def mode_rules(modes: Mapping[str, ModeConfig], source: ModeSource, base: Envelope) -> ModeRules:
    """The rules that follow.

    Raises:
        ValueError: A mode does not tighten; the text names the key.
    """
    made = {}
    for name, mode in modes.items():
        try:
            made[name] = mode.envelope(base)
        except ValueError as error:
            raise ValueError(f"modes.{name}.{error}") from None
    if source.topic is not None and not modes:
        raise ValueError("mode.topic: there are no modes that it could name (safety.modes)")
    return ModeRules(made, source.topic or "", source.max_age_s)


def _know(what: str, given: Mapping[str, float], known: frozenset[str]) -> None:
    for name in given:
        if name not in known:
            raise ValueError(f"{what}.{name}: unknown key; allowed are {', '.join(sorted(known))}")
