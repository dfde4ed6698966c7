"""Where in its graph a robot's things are, in whatever kind of graph."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any, ClassVar, Self

from skytether.api.manifest import TopicSpec
from skytether.ros.names import Generation, Names, namespace_of, resolve
from skytether.ros.permissions import NOTHING_MORE, Allowed, Permissions

from ..control.supervisor import VelocityLimits
from .graph_base import IDLE_S, protected_names


@dataclass(frozen=True, slots=True)
class RobotGraphConfig:
    """What all kinds have; one that needs more extends it.

    Attributes:
        robot: Its name.
        service: The service's: what it sends is found below that name.
        namespace: Of the robot's topics; None: its name.
        remap: Names in the graph, by topic, call, action or reading.
        cmd_vel: What the wheels listen to; None: others have the wheels.
        idle_s: See `skytether.robot.graphs.graph_base.IDLE_S`.
        fresh_s: The wheels get no velocity that is older [s], where the graph's own thread sends it: this process may
            stand still meanwhile.
        readings: Types of what the robot's own control reads, by name.
        topics: Sent to a service that takes any.
        allowed: What the service may publish, call and offer beyond its own namespace.
        protected: What it never may: why, by absolute name; the wheels and the readings are, without being named.
        wheels: Absolute name of what the wheels listen to, to see who else publishes it; None: it is no topic.
        drivers: Names of the nodes that publish it for us; empty: this one.
    """

    generation: ClassVar[Generation] = 2
    """Of ROS, whose rules names obey."""

    robot: str
    service: str
    namespace: str | None = None
    remap: Mapping[str, str] = field(default_factory=dict)
    cmd_vel: str | None = "cmd_vel"
    idle_s: float | None = IDLE_S
    fresh_s: float = VelocityLimits().watchdog_s
    readings: Mapping[str, str] = field(default_factory=dict)
    topics: Collection[str] = ()
    allowed: Allowed = NOTHING_MORE
    protected: Mapping[str, str] = field(default_factory=dict)
    wheels: str | None = None
    drivers: Collection[str] = ()

    @classmethod
    def extended(cls, shared: RobotGraphConfig, **more: Any) -> Self:
        """What all kinds have, and what this one has more."""
        return cls(**{each.name: getattr(shared, each.name) for each in fields(shared)}, **more)

    @property
    def home(self) -> str:
        """The namespace of the robot's topics."""
        return namespace_of(self.robot) if self.namespace is None else resolve(self.namespace, "/")

    def names(self, specs: Sequence[TopicSpec]) -> Names:
        """Names in the robot's graph.

        Raises:
            GraphNameError: One is not allowed.
        """
        return Names(specs, self.home, namespace_of(self.service), self.remap, ros=self.generation)

    def permissions(self) -> Permissions:
        """What the service may do in the robot's graph."""
        wheels = [] if self.cmd_vel is None else [self.cmd_vel]
        kept = protected_names(self.names(()), self.home, wheels, self.readings)
        return Permissions(self.home, namespace_of(self.service), self.allowed, {**kept, **self.protected})
