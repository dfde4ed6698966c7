"""The section ``safety`` of robot.yaml: what people write, checked, and the rules that follow from it."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from pydantic import Field, field_validator, model_validator

from skytether.guard import teller
from skytether.guard.kinematics import Bounds
from skytether.messages import Bool, Encoding, Message, String
from skytether.robot.control.supervisor import VelocityLimits
from skytether.ros.names import check_name, resolve

from ...config_base import Numbers, Topic, no_switches
from ...graphs.gate_io import WheelsTiming
from ...graphs.inbox import IsStop, Topics
from ...graphs.kind import GateSection, GraphKind
from ...graphs.registry import GRAPHS, sections_of, with_sections
from ..geometry.stopping import Stages, shortfall
from ..protocol import WHEELS_SOCKET, default_folder, default_record
from ..rules.contact import ContactParams, feels
from ..rules.modes import Envelope
from ..rules.rules import Rules
from ..rules.zones import ZoneParams
from .address import address, numeric
from .bounds import LONGEST_REASON, check_plausible
from .display_config import DisplayConfig
from .enable_config import ON_DISK, EnableConfig
from .mode_config import Modes, ModeSource, mode_rules
from .odometry_config import OdometryConfig, odometry_kind
from .outline_config import OutlineConfig
from .sensor_config import ContactConfig, SensorConfig, UnseenConfig
from .source_config import SourcesConfig


class SocketsConfig(Numbers):
    """Drivers that speak to the gate through datagram sockets; ``unix:PATH`` or ``udp:HOST:PORT``."""

    sensors: str | None = None
    """Where the gate listens: the topic's name, a zero byte, the message as CDR; null: ``sensors.sock``."""
    estop: str | None = None
    """The same for the emergency stop button, bumpers and cliff sensors; null: ``estop.sock``."""
    wheels: str | None = None
    """Where velocities go: a geometry_msgs/msg/Twist as CDR; null: ``wheels.sock`` in the gate's folder."""

    @field_validator("sensors", "estop", "wheels")
    @classmethod
    def _an_address(cls, text: str | None) -> str | None:
        if text is not None:
            address(text)
        return text


class GateGraph(NamedTuple):
    """The graph that sensors and wheels are topics of."""

    kind: GraphKind[Any, Any]
    way: GateSection


@with_sections(lambda kind: kind.gate_section)
class SafetyConfig(SourcesConfig):
    """The whole section. `with_sections` adds a key for each kind of graph: then sensors and wheels are its topics."""

    footprint: OutlineConfig
    limits: VelocityLimits | None = None
    """Of the wheels, whoever drives; null: the file's own ``limits``."""
    zones: ZoneParams = ZoneParams()
    sensors: Annotated[dict[Topic, SensorConfig], Field(max_length=32)]
    """By topic. Without any (``{}``) the robot is blind, and all that it does is moving where no sensor looks."""
    unseen: UnseenConfig = UnseenConfig()
    """Moving where no sensor looks."""
    contacts: Annotated[dict[Topic, ContactConfig], Field(max_length=32)] = {}
    """Bumpers and cliff sensors, by topic."""
    odometry: OdometryConfig | None = None
    """What the wheels really do; null: nobody looks."""
    enable: EnableConfig | None = None
    """An output that takes power away; null: there is none."""
    display: DisplayConfig | None = None
    """Zones, stopping way and state for RViz and Foxglove, with ``ros1`` or ``ros2``; null: they are not shown."""
    modes: Modes = {}
    """Tighter limits, zones and outlines that hold at times, by name."""
    mode: ModeSource = ModeSource()
    """Who says which of them hold."""
    stop_from_afar: bool = False
    """Whether the orchestrator may stop this robot; nobody can reset it from afar."""
    rate_hz: Annotated[float, Field(ge=10, le=500)] = 50.0
    """Of the gate's loop."""
    guard_s: Annotated[float, Field(ge=0.02, le=1)] = 0.1
    """The guard brakes when the gate has said nothing for this long, and the gate when the guard has not."""
    folder: Path | None = None
    """Of the gate's sockets, where only its owner may write; null: ``/run/skytether`` for root, else
    ``$XDG_RUNTIME_DIR/skytether``, or ``skytether/gate`` in the user's state folder where there is none."""
    record: Path | None = None
    """Of the event record; null: ``record`` in a ``folder`` that is given, else ``/var/lib/skytether/safety-record``
    for root, and the user's state folder for others."""
    sockets: SocketsConfig | None = None
    """Drivers that are no nodes of a graph; the way to the hardware unless a graph is given."""

    beyond: dict[str, Annotated[str, Field(min_length=1, max_length=LONGEST_REASON)]] = {}
    """Numbers that are meant to be beyond what is plausible: key below ``safety`` to reason."""

    @field_validator("limits", "zones", mode="before")
    @classmethod
    def _are_numbers(cls, section: Any) -> Any:
        return no_switches(section)

    @model_validator(mode="after")
    def _is_plausible(self) -> SafetyConfig:
        self.notes()
        if self.footprint.footprint().outside(np.zeros((1, 2)))[0] > 0:
            raise ValueError("footprint: the origin of the base frame (0, 0) must be inside of it")
        return self

    @model_validator(mode="after")
    def _fits_together(self) -> SafetyConfig:
        ways = [*(["sockets"] if self.sockets is not None else []), *sections_of(self)]
        if len(ways) > 1:
            raise ValueError(f"there are {' and '.join(ways)}, and the wheels can have only one of them")
        if self.graph is not None:
            for name in self.kinds():
                check_name(name, self.graph.kind.generation)
        topics = [*self.sensors, *(topic for topic, _ in self._other_kinds())]
        for topic in topics:
            if topics.count(topic) > 1:
                raise ValueError(f"the topic '{topic}' cannot be two things")
        self._check_display()
        if self.guard_s < 2 / self.rate_hz:
            raise ValueError(f"guard_s must be two periods of rate_hz or more: {2 / self.rate_hz:g}")
        limits = self.limits or VelocityLimits()
        if limits.max_gap_s < 2 / self.rate_hz:
            raise ValueError(f"limits.max_gap_s must be two periods of rate_hz or more: {2 / self.rate_hz:g}")
        return self

    def _check_display(self) -> None:
        """Nobody listens to it but people."""
        if self.display is None or self.graph is None:
            return
        kind, way = self.graph
        check_name(self.display.topic, kind.generation)
        others = [*self.kinds(), way.cmd_vel, (self.enable.topic if self.enable is not None else None) or way.cmd_vel]
        if resolve(self.display.topic, way.namespace) in {resolve(name, way.namespace) for name in others}:
            raise ValueError(f"display.topic: '{self.display.topic}' is another topic of the gate")

    @model_validator(mode="after")
    def _can_stop(self) -> SafetyConfig:
        """The inequality of `stopping`, for what is known before anything is seen."""
        rules = self.rules()
        self._check_stop("", Envelope(rules.limits, rules.zones, rules.footprint))
        for name, envelope in rules.modes.envelopes.items():
            self._check_stop(f"modes.{name}.", envelope)
        return self

    def _check_stop(self, where: str, envelope: Envelope) -> None:
        limits, zones, outline = envelope.limits, envelope.zones, envelope.footprint
        stages = replace(self.stages(), sensing_s=zones.sensing_s, wheels_s=zones.reaction_s)
        braking = min(limits.linear_braking, limits.angular_braking * outline.radius)
        wrong = shortfall(stages, zones.slow_speed, braking, 0.0, zones.slow_m)
        if wrong:
            raise ValueError(f"{where}zones.slow_speed, {where}zones.slow_m: {wrong}")
        if self.sensors and all(sensor.range_max for sensor in self.sensors.values()):
            name, eye = max(self.sensors.items(), key=lambda item: item[1].x + item[1].range_max)
            front = float(outline.vertices[:, 0].max()) + zones.stop_m
            way = eye.x + eye.range_max - front
            wrong = shortfall(stages, limits.linear_max, limits.linear_braking, eye.max_age_s, way)
            if wrong:
                raise ValueError(f"{where}limits.linear_max, sensors.{name}.range_max: {wrong}")

    @property
    def graph(self) -> GateGraph | None:
        """The robot's graph; None: its drivers speak to the gate's sockets."""
        return next((GateGraph(GRAPHS[key], way) for key, way in sections_of(self).items()), None)

    @property
    def encoding(self) -> Encoding:
        """Of readings and velocities."""
        return "cdr" if self.graph is None else self.graph.kind.encoding

    def rules(self) -> Rules:
        """The rules that follow."""
        stages = self.stages()
        limits = replace(self.limits or VelocityLimits(), period_s=stages.period_s, max_step_s=stages.longest_step_s)
        footprint = self.footprint.footprint()
        return Rules(
            footprint=footprint,
            limits=limits,
            zones=self.zones,
            sensors={topic: sensor.sensor() for topic, sensor in self.sensors.items()},
            unseen=self.unseen.params(),
            contacts={topic: contact.params() for topic, contact in self.contacts.items()},
            stages=stages,
            modes=mode_rules(self.modes, self.mode, Envelope(limits, self.zones, footprint)),
            sources=self.source_rules(),
            odometry=None if self.odometry is None else self.odometry.rules(stages),
        )

    def notes(self) -> tuple[str, ...]:
        """What a person should know of this configuration.

        A sentence for each number that is beyond its bounds, or above a limit that cuts it down.
        """
        reasons = dict(self.beyond)
        found = []
        if self.enable is not None and self.enable.file is not None and reasons.get(ON_DISK, "").strip():
            found.append(f"{ON_DISK} may be a regular file, whose disk the guard waits for: {reasons.pop(ON_DISK)}")
        numbers = self.model_dump(exclude={"beyond", "sockets", *GRAPHS})
        return (*check_plausible(numbers, reasons), *found, *self._cut())

    def _cut(self) -> list[str]:
        """What the limits take away from other numbers: people look for it in vain at the wheels."""
        limits, pad, found = self.limits or VelocityLimits(), self.joystick, []
        if self.zones.slow_speed > limits.linear_max:
            found.append(
                f"zones.slow_speed {self.zones.slow_speed:g} is above limits.linear_max {limits.linear_max:g}: "
                "straight ahead the slow zone slows nothing"
            )
        for name, most in (("linear", limits.linear_max), ("angular", limits.angular_max)):
            wanted = abs(getattr(pad, name)) if pad is not None else 0.0
            if wanted > most:
                found.append(
                    f"joystick.{name} {wanted:g} is above limits.{name}_max {most:g}: the rest of the stick's way "
                    "does nothing"
                )
        return found

    def enable_words(self) -> tuple[str, ...]:
        """The line of the enable signal, for `skytether.guard.enable.open_line`; empty: there is none.

        Raises:
            OSError: See `EnableConfig.words`.
        """
        return () if self.enable is None else self.enable.words(on_disk=ON_DISK in self.beyond)

    def stages(self) -> Stages:
        """The latencies from the light to the brakes."""
        period = 1 / self.rate_hz
        writer = 0.0 if self.graph is None else period
        return Stages(self.zones.sensing_s, period, self.guard_s, writer, self.zones.reaction_s)

    def wheels_timing(self) -> WheelsTiming:
        """How long the wheels may be told nothing by one, until another does.

        Whoever goes on for another claims the wheels 1.5 periods after its last velocity, and speaks 0.75 after that. A
        velocity is sent on 0.75 after it was decided, at the latest, and then may get 1.5 periods old. Where only who
        sends it stands still, who tells them begins to be silent when that counts as such: with a turn more, the other
        one speaks within `guard_s`.
        """
        period, bounds = 1 / self.rate_hz, self.bounds()
        fastest = max(bounds.linear_max, -bounds.linear_min)
        braking = max(fastest / bounds.linear_braking, bounds.angular_max / bounds.angular_braking)
        stuck_s = max(1.5 * period, self.guard_s - 3.25 * period)
        return WheelsTiming(self.guard_s, teller.FRESH * period, stuck_s, self.guard_s + 3 * period + braking)

    def wheels_at(self) -> str:
        """Where the wheels are, in words that tell one robot's from another's."""
        if self.graph is not None:
            return self.graph.kind.wheels_at(self.graph.way)
        sockets = self.sockets.wheels if self.sockets is not None else None
        return sockets or str(self.place() / WHEELS_SOCKET)

    def place(self) -> Path:
        """The gate's folder."""
        return self.folder or default_folder()

    def bounds(self) -> Bounds:
        """What the wheels may do, as the guard takes it."""
        limits = self.limits or VelocityLimits()
        return Bounds(*(float(getattr(limits, name)) for name in Bounds._fields))

    def frozen(self) -> SafetyConfig:
        """With everything looked up that could make somebody wait later: names of hosts, folders.

        Raises:
            OSError: A host's name is not known.
        """
        changes: dict[str, object] = {"folder": self.place().absolute(), "record": self.record_file().absolute()}
        if self.sockets is not None:
            named = {name: text for name, text in self.sockets.model_dump().items() if text is not None}
            numbers = {name: _text(numeric(address(text))) for name, text in named.items()}
            changes["sockets"] = self.sockets.model_copy(update=numbers)
        return self.model_copy(update=changes)

    def record_file(self) -> Path:
        """Of the event record. A folder of its own has its own, unless it is said."""
        return self.record or (self.folder / "record" if self.folder is not None else default_record())

    def kinds(self) -> dict[str, type[Message]]:
        """Message type of each topic that the gate listens to."""
        kinds = {name: sensor.message() for name, sensor in self.sensors.items()}
        return kinds | dict(self._other_kinds())

    def _other_kinds(self) -> list[tuple[str, type[Message]]]:
        """All but range sensors; a topic that is there twice is a mistake."""
        kinds = [(topic, contact.params().message) for topic, contact in self.contacts.items()]
        odometry = self.odometry
        if self.mode.topic is not None:
            kinds.append((self.mode.topic, String))
        return kinds + self.source_kinds() + ([] if odometry is None else [(odometry.topic, odometry_kind(odometry))])

    def topics(self) -> Topics:
        """What the gate listens to, and which of it stops the robot."""
        stops: dict[str, IsStop] = {topic: partial(_felt, c.params()) for topic, c in self.contacts.items()}
        if self.estop is not None:
            stops[self.estop.topic] = partial(_pressed, self.estop.pressed_is)
        return Topics(self.kinds(), stops)


def _felt(contact: ContactParams, message: Message) -> bool:
    return feels(contact, message) is True


def _pressed(pressed_is: bool, message: Message) -> bool:
    return isinstance(message, Bool) and bool(message.data) is pressed_is


def _text(found: str | tuple[str, int]) -> str:
    return f"unix:{found}" if isinstance(found, str) else f"udp:{found[0]}:{found[1]}"


NO_GATE = "none"
"""What is written instead of the section where there is to be no gate."""
WITHOUT_SECTION: dict[str, Any] = {"footprint": {"radius": 0.3}, "sensors": {}, "unseen": {"action": "free"}}
"""The gate of a robot.yaml that has no such section: limits and silence only. Without sensors no outline counts."""
