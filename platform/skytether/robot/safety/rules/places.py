"""What the modes of a time leave: limits, outline, and the zones that are made of them. Made when it first holds."""

from __future__ import annotations

from dataclasses import dataclass, replace

from skytether.robot.control.supervisor import VelocityLimits

from ..geometry.footprint import Footprint
from ..geometry.stopping import Stages
from ..sensing.coverage import Unseen, UnseenParams
from .modes import Modes
from .zones import Zones


@dataclass(frozen=True, slots=True)
class Place:
    """One of them.

    Attributes:
        limits: Of the wheels.
        footprint: Outline of the robot with all that it carries.
        stages: Latencies from the light to the brakes.
        zones: Of that outline.
        unseen: Moving where no sensor looks.
    """

    limits: VelocityLimits
    footprint: Footprint
    stages: Stages
    zones: Zones
    unseen: Unseen


class Places:
    """All of them, one for each set of modes.

    Args:
        modes: Which there are.
        stages: Without any mode.
        unseen: What to do about moving where no sensor looks.
    """

    def __init__(self, modes: Modes, stages: Stages, unseen: UnseenParams) -> None:
        self._modes = modes
        self._stages = stages
        self._unseen = unseen
        self._made: dict[frozenset[str], Place] = {}

    def of(self, active: frozenset[str]) -> Place:
        """What these modes leave."""
        if active not in self._made:
            now, stages = self._modes.envelope(active), self._stages
            if active:
                stages = replace(stages, sensing_s=now.zones.sensing_s, wheels_s=now.zones.reaction_s)
            self._made[active] = Place(
                now.limits,
                now.footprint,
                stages,
                Zones(now.zones, now.footprint, now.limits, stages),
                Unseen(self._unseen, now.footprint, now.zones.slow_speed),
            )
        return self._made[active]
