"""The parts of the section ``safety`` that say who drives and who stops: what people write, checked."""

from __future__ import annotations

from math import inf
from typing import Annotated, Literal

from pydantic import Field, field_validator, model_validator

from skytether.messages import Bool, Joy, Message, Twist, TwistStamped

from ...config_base import Numbers, Topic
from ...control.command import Hand
from ..rules.estop import ButtonParams
from ..rules.joystick import JoystickParams
from ..rules.sources import LockParams, OnSilence, SourceParams, SourceRules

Priority = Annotated[int, Field(ge=0, le=255)]
"""As in twist_mux."""
Name = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]{0,31}$")]
AGENT_PRIORITY = 10


class JoystickConfig(Numbers):
    """A joystick or gamepad (sensor_msgs/msg/Joy), repeated at 10 Hz or more while the button is held."""

    topic: Topic = "joy"
    priority: Priority = 100
    """Among the sources; the highest that wants to drive does."""
    deadman: Annotated[int, Field(ge=0, le=63)] = 4
    """Index of the button to be held."""
    linear_axis: Annotated[int, Field(ge=0, le=63)] = 1
    angular_axis: Annotated[int, Field(ge=0, le=63)] = 0
    linear: Annotated[float, Field(ge=-5, le=5)] = 0.2
    """At the end of the axis [m/s]; negative turns the axis round."""
    angular: Annotated[float, Field(ge=-10, le=10)] = 0.4
    """At the end of the axis [rad/s]."""
    deadzone: Annotated[float, Field(ge=0, le=0.5)] = 0.05
    """Share of the axis about its middle that is the middle. Leave joy_node's own at 0: the unrest of a stick with a
    hand on it shows that its radio is there."""
    max_age_s: Annotated[float, Field(gt=0, le=2)] = 0.3
    """Silence after which a held joystick is lost."""
    max_still_s: Annotated[float, Field(ge=0.2, le=10)] | None = 1.0
    """Time without a change of any axis or button after which a joystick that drives is lost: a driver that repeats by
    itself goes on when the radio is gone. null: by cable, where the driver ends with the joystick."""

    @model_validator(mode="after")
    def _two_axes(self) -> JoystickConfig:
        if self.linear_axis == self.angular_axis:
            raise ValueError("linear_axis and angular_axis must be two axes")
        return self

    def params(self) -> JoystickParams:
        """As the rules take it."""
        values = self.model_dump(exclude={"topic", "priority", "max_still_s"})
        return JoystickParams(**values, max_still_s=inf if self.max_still_s is None else self.max_still_s)


class ButtonConfig(Numbers):
    """An emergency stop button (std_msgs/msg/Bool)."""

    topic: Topic = "estop"
    pressed_is: bool = True
    """Its value when pressed; false for a circuit that opens."""
    max_age_s: Annotated[float, Field(gt=0, le=60)] | None = 0.5
    """Silence after which the robot stops; null: it speaks only when it changes."""
    on_silence: Literal["stop", "neutral", "latch"] = "stop"
    """When it is heard again after a silence, the robot goes on (stop), goes on once whoever drives has wanted a
    standstill (neutral), or stands until a reset (latch)."""

    def params(self) -> ButtonParams:
        """As the rules take it."""
        return ButtonParams(self.pressed_is, self.max_age_s or inf)


class SourceConfig(Numbers):
    """A further source of velocities: the robot's own navigation, a keyboard."""

    topic: Topic
    type: Literal["geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped"] = "geometry_msgs/msg/Twist"
    priority: Priority
    """Among the sources; the highest that wants to drive does. The agent has 10, the joystick 100."""
    timeout_s: Annotated[float, Field(ge=0.05, le=2)] = 0.5
    """Age at which its command ends, and the next in the order drives."""

    @property
    def stamped(self) -> bool:
        """Whether its messages are TwistStamped."""
        return self.type.endswith("Stamped")


class LockConfig(Numbers):
    """A topic (std_msgs/msg/Bool) that blocks every source of a lower priority while it says true."""

    topic: Topic
    priority: Priority
    max_age_s: Annotated[float, Field(ge=0.05, le=60)] | None = 1.0
    """Silence that locks too; null: it speaks only when it changes. One that was never heard is locked."""


class SourcesConfig(Numbers):
    """All who may drive, and all who may forbid it; a part of the whole section."""

    joystick: JoystickConfig | None = None
    estop: ButtonConfig | None = None
    agent_priority: Priority = AGENT_PRIORITY
    """Of the agent among the sources."""
    sources: Annotated[dict[Name, SourceConfig], Field(max_length=16)] = {}
    """Further sources of velocities, by name."""
    locks: Annotated[dict[Name, LockConfig], Field(max_length=16)] = {}
    """By name."""

    @field_validator("sources")
    @classmethod
    def _names_of_their_own(cls, sources: dict[str, SourceConfig]) -> dict[str, SourceConfig]:
        for name in sources:
            if name in list(Hand):
                raise ValueError(f"a further source cannot be called '{name}'; that name is taken")
        return sources

    @model_validator(mode="after")
    def _an_order(self) -> SourcesConfig:
        order = {"agent": self.agent_priority} | {name: source.priority for name, source in self.sources.items()}
        if self.joystick is not None:
            order["joystick"] = self.joystick.priority
        for name, priority in order.items():
            same = sorted(other for other, its in order.items() if its == priority)
            if len(same) > 1:
                raise ValueError(f"{' and '.join(same)} have the same priority {priority}; '{name}' needs another")
        return self

    def source_rules(self) -> SourceRules:
        """The rules that follow."""
        joystick, button = self.joystick, self.estop
        return SourceRules(
            joystick=joystick.params() if joystick else None,
            joystick_topic=joystick.topic if joystick else "",
            joystick_priority=joystick.priority if joystick else 0,
            agent_priority=self.agent_priority,
            further={
                source.topic: SourceParams(name, source.priority, source.timeout_s, source.stamped)
                for name, source in self.sources.items()
            },
            locks={
                lock.topic: LockParams(name, lock.priority, lock.max_age_s or inf) for name, lock in self.locks.items()
            },
            button=button.params() if button else None,
            button_topic=button.topic if button else "",
            on_silence=OnSilence(button.on_silence) if button else OnSilence.STOP,
        )

    def source_kinds(self) -> list[tuple[str, type[Message]]]:
        """Topics that the rules listen to, and the type of each; a topic that is there twice is a mistake."""
        kinds: list[tuple[str, type[Message]]] = []
        if self.joystick is not None:
            kinds.append((self.joystick.topic, Joy))
        if self.estop is not None:
            kinds.append((self.estop.topic, Bool))
        kinds += [(source.topic, TwistStamped if source.stamped else Twist) for source in self.sources.values()]
        return kinds + [(lock.topic, Bool) for lock in self.locks.values()]
