"""The part ``odometry`` of the section ``safety``: what people write, checked."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from skytether.messages import Message, Odometry, Twist, TwistStamped

from ...config_base import Numbers, Topic
from ..geometry.stopping import Stages
from ..rules.motion import MotionParams
from ..rules.real_motion import OdometryRules
from ..sensing.coverage import Action
from ..sensing.stamps import StampRule

_KINDS: dict[str, type[Message]] = {kind.TYPE: kind for kind in (Odometry, TwistStamped, Twist)}


class OdometryConfig(Numbers):
    """What the wheels really do, in the robot's base frame: odometry, or the drives' own velocity."""

    topic: Topic = "odom"
    type: Literal["nav_msgs/msg/Odometry", "geometry_msgs/msg/TwistStamped", "geometry_msgs/msg/Twist"] = (
        "nav_msgs/msg/Odometry"
    )
    latency_s: Annotated[float, Field(ge=0, le=1)] = 0.1
    """Oldest motion that a reading shows when it comes; its period and its filter belong to it."""
    lag_s: Annotated[float, Field(ge=0, le=1)] = 0.15
    """Time in which the wheels do 63 % of a change, after their dead time (``zones.reaction_s``)."""
    linear_tolerance: Annotated[float, Field(ge=0.005, le=1)] = 0.05
    """Noise of the readings and unevenness of the wheels [m/s]."""
    angular_tolerance: Annotated[float, Field(ge=0.01, le=2)] = 0.1
    """[rad/s]"""
    tolerance_share: Annotated[float, Field(ge=0, le=0.5)] = 0.1
    """The same, as a share of the velocity told."""
    confirm_s: Annotated[float, Field(ge=0.05, le=2)] = 0.2
    """How long the motion must be another than told before it is a fault."""
    blocked_s: Annotated[float, Field(ge=0.1, le=30)] = 1.0
    """How long the wheels may stand when they are told to move."""
    max_age_s: Annotated[float, Field(ge=0.02, le=5)] = 0.3
    """Silence after which the real motion is not known."""
    stamps: Literal["auto", "required", "order", "own"] = "auto"
    """What is asked of its stamps: used if the first has one; needed; only their order (simulators); of our clock."""
    on_unknown: Literal["stop", "slow", "free"] = "stop"
    """When it is silent, late, or reports what is no number."""
    on_fault: Literal["latch", "name"] = "latch"
    """An emergency stop until a reset, or a sentence in log and status only."""
    start_from: Literal["told", "measured"] = "told"
    """Where a new driver's ramp begins; measured: where the wheels are slower than told."""

    def rules(self, stages: Stages) -> OdometryRules:
        """The rules that follow.

        Args:
            stages: The latencies of guard, writer and drives, which delay what is measured.
        """
        params = MotionParams(
            latency_s=self.latency_s,
            dead_s=2 * stages.period_s + stages.writer_s + stages.wheels_s,
            lag_s=self.lag_s,
            linear_tolerance=self.linear_tolerance,
            angular_tolerance=self.angular_tolerance,
            share=self.tolerance_share,
            confirm_s=self.confirm_s,
            blocked_s=self.blocked_s,
            max_age_s=self.max_age_s,
            stamps=StampRule(self.stamps),
        )
        return OdometryRules(
            self.topic, params, Action(self.on_unknown), self.on_fault == "latch", self.start_from == "measured"
        )


def odometry_kind(config: OdometryConfig) -> type[Message]:
    """Message type of the readings."""
    return _KINDS[config.type]
