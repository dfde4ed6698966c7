"""What came of a trial of `follow_in_front`."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

from .trial.results import Point, Traces, TrialResult


@dataclass(frozen=True, slots=True)
class FollowTraces(Traces):
    """For figures.

    Attributes:
        operator: Where the operator was, each 0.1 s [m].
    """

    operator: tuple[Point, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class FollowResult(TrialResult):
    """What came out. ``completed``: the robot came round ahead of its operator, and touched nothing.

    Attributes:
        round: Share of the round that was done.
        lost: The operator had lost the robot: it was too far away from them or from the path.
        kte_m: Kinematic tracking error (thesis, equation 5.1) [m].
        deviation_max_m: Largest distance from the path [m].
        following: Share of the time in which the service saw legs and face, and followed.
        up_mbit_s: What left the robot for the network, median over the seconds.
        up_arrived_mbit_s: What of it came out of the network, likewise.
        down_mbit_s: What left the service for the robot, likewise.
        down_arrived_mbit_s: What of it came out of the network, likewise.
    """

    TRACES: ClassVar[type[Traces]] = FollowTraces

    round: float
    lost: bool
    kte_m: float
    deviation_max_m: float
    following: float
    up_mbit_s: float = math.nan
    up_arrived_mbit_s: float = math.nan
    down_mbit_s: float = math.nan
    down_arrived_mbit_s: float = math.nan
    traces: FollowTraces = FollowTraces()
