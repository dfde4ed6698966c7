"""What the control loop knows at one moment, for whoever asks: the robot's status, its metrics, a trial."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from skytether.control.admittance import Velocity

from .arbiter import Reason
from .command import Source
from .wheels_feedback import WheelsFeedback


@dataclass(frozen=True, slots=True)
class Transition:
    """One change of who drives; the first is the start."""

    at: float
    source: Source
    reason: Reason


@dataclass(frozen=True, slots=True)
class ControlStatus:
    """What the control loop knows at one moment. Times are monotonic seconds.

    Attributes:
        source: Who drives.
        transitions: Changes of the source, oldest first (the newest 1000).
        transition_counts: All of them, by reason.
        why: Of the last change, one line with the numbers behind it.
        seconds: Under each source.
        velocity: What the wheels were last told.
        commands: Of the cloud that were looked at, admitted or not.
        missed_commands: Of the cloud that nobody looked at: the loop stood still, and newer ones came.
        objections: The supervisor's, by kind.
        errors: Exceptions caught in the loop, by the part that raised them.
        first_command_at: Arrival of the first command from the cloud that was admitted.
        last_command_at: Of the newest.
        readings: Messages read from the hardware, by topic.
        silence_limit_s: A longer silence of the cloud hands over, as was learned of its commands.
        told: What the gate told the wheels last; None: there is none, or it does not say.
        stalls: Times that the loop stood still for longer than `VelocityLimits.watchdog_s`, or the computer slept.
    """

    source: Source
    transitions: tuple[Transition, ...]
    transition_counts: Mapping[str, int]
    why: str
    seconds: Mapping[Source, float]
    velocity: Velocity
    commands: int
    missed_commands: int
    objections: Mapping[str, int]
    errors: Mapping[str, int]
    first_command_at: float | None
    last_command_at: float | None
    readings: Mapping[str, int]
    silence_limit_s: float
    told: WheelsFeedback | None
    stalls: int
