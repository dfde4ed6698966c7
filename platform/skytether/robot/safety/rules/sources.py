"""Who drives: the first in the order of priority who wants to, and may. Pure: time is an argument.

The agent, the joystick and further sources of commands (the robot's own navigation, a keyboard) stand in one order, as
in twist_mux. Locks block all below them. The emergency stop is above all. How fast is not asked here: every source
passes the supervisor and the zones, so a change of source does not jump in velocity.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from math import inf, isfinite, nan

from skytether.control.admittance import STANDSTILL, Velocity
from skytether.messages import Bool, Joy, Message, Twist, TwistStamped
from skytether.robot.control import restart_interlock
from skytether.robot.control.command import Command, Hand, unused_axes
from skytether.robot.control.restart_interlock import RestartInterlock
from skytether.robot.control.supervisor import VelocityLimits, with_gap

from ..sensing.stamps import StampRule, Stamps, date
from . import estop, joystick
from .estop import ButtonParams, Estop
from .joystick import Grip, Joystick, JoystickParams

_STARTED = "the gate was started"
_RESET = "the reset"


class OnSilence(StrEnum):
    """What becomes of the robot when the emergency stop button is heard again after a silence."""

    STOP = "stop"
    """It goes on."""
    NEUTRAL = "neutral"
    """Whoever drives must have wanted a standstill first."""
    LATCH = "latch"
    """It stands until a reset."""


@dataclass(frozen=True, slots=True)
class SourceParams:
    """A further source of commands, a Twist or TwistStamped.

    Attributes:
        name: Its own, for people.
        priority: The highest that wants to drive does.
        timeout_s: Age at which its command ends [s].
        stamped: Whether it sends TwistStamped.
    """

    name: str
    priority: int
    timeout_s: float = 0.5
    stamped: bool = False


@dataclass(frozen=True, slots=True)
class LockParams:
    """A topic that blocks every source of a lower priority while it says true.

    Attributes:
        name: Its own, for people.
        priority: Those below it are blocked.
        max_age_s: Silence that locks too [s]; inf: it speaks only when it changes. One never heard is locked.
    """

    name: str
    priority: int
    max_age_s: float = 1.0


@dataclass(frozen=True, slots=True)
class SourceRules:
    """Who may drive, and who may stop the robot.

    Attributes:
        joystick: None: there is none.
        joystick_topic: Its topic.
        joystick_priority: Among the sources.
        agent_priority: Among the sources.
        further: Other sources, by topic.
        locks: By topic.
        button: The emergency stop button; None: there is none.
        button_topic: Its topic.
        on_silence: When the button falls silent.
    """

    joystick: JoystickParams | None = None
    joystick_topic: str = "joy"
    joystick_priority: int = 100
    agent_priority: int = 10
    further: Mapping[str, SourceParams] = field(default_factory=dict)
    locks: Mapping[str, LockParams] = field(default_factory=dict)
    button: ButtonParams | None = None
    button_topic: str = "estop"
    on_silence: OnSilence = OnSilence.STOP


@dataclass(frozen=True, slots=True)
class _Source:
    """What is remembered of a source of commands."""

    priority: int
    timeout_s: float
    neutral: RestartInterlock
    started: bool = False
    """A person let it go on since it last had to be neutral."""
    wanted: Velocity = STANDSTILL
    heard_at: float = nan
    sequence: int = 0
    stamps: Stamps = field(default_factory=Stamps)

    def speaks(self, now: float) -> bool:
        """Whether its last command is young enough; NaN and a clock that went back are silence."""
        return -_TOLERANCE_S <= now - self.heard_at <= self.timeout_s


_TOLERANCE_S = 0.05
"""How far ahead of now something may have been heard."""


class Sources:
    """Takes in what people and programs want, and tells at each step who drives.

    Args:
        rules: What is configured.
        limits: The supervisor's; `max_gap_s` is the age at which a command of the agent ends.
        stopped: Why the robot is to stand until somebody resets it; empty: it is not.
    """

    def __init__(self, rules: SourceRules, limits: VelocityLimits, stopped: str = "") -> None:
        self._rules = rules
        self._limits = limits
        self._joystick = Joystick()
        self._latch = Estop(reason=stopped)
        self._locks: dict[str, tuple[bool, float]] = {}
        wait = restart_interlock.require(_STARTED)
        self._sources: dict[str, _Source] = {Hand.AGENT: _Source(rules.agent_priority, limits.max_gap_s, wait)}
        for params in rules.further.values():
            self._sources[params.name] = _Source(params.priority, params.timeout_s, wait)
        self._joystick_count = 0
        self._settled_at = -inf

    @property
    def stopped(self) -> str:
        """Why the robot stands until somebody resets it; empty: it does not."""
        return self._latch.reason

    @property
    def waiting(self) -> Mapping[str, str]:
        """Sources that must be neutral before they may drive, and after what."""
        return {name: source.neutral.why for name, source in self._sources.items() if source.neutral.why}

    @property
    def agent_started(self) -> bool:
        """A person let the agent go on since it last had to be neutral."""
        return self._sources[Hand.AGENT].started

    def engage(self, reason: str) -> None:
        """Emergency stop, until `reset`."""
        self._latch = estop.engage(self._latch, reason)

    def reset(self, now: float) -> str:
        """End the emergency stop. Nobody drives by that alone: each source must be neutral first.

        Returns:
            Why it was refused; empty: it was not.
        """
        self._latch, refused = estop.reset(self._rules.button, self._latch, now)
        if not refused:
            self._joystick = Joystick()
            self._require(_RESET, inf)
        return refused

    def stalled(self, now: float) -> None:
        """The gate stood still: commands that waited meanwhile are not followed, and the button is to be heard anew.

        The age of an agent's command is known, and a joystick is looked after by `joystick.on_message`.
        """
        self._settled_at = now + estop.SETTLES_S
        if self._rules.button is not None:
            self._latch = estop.doubt(self._rules.button, self._latch, now)

    def start(self, now: float) -> tuple[list[str], str]:
        """A person says that those who want to drive now may do so.

        Returns:
            Who may, and why it was refused (empty: it was not).
        """
        if self._latch.reason:
            return [], f"the robot is stopped: {self._latch.reason}; `skytether robot reset` comes first"
        if self._joystick.grip in _HOLDS_BACK:
            return [], "the joystick is lost, or its button was not let go; let it go first"
        may = [name for name, source in self._sources.items() if source.speaks(now)]
        for name in may:
            self._sources[name] = replace(self._sources[name], neutral=RestartInterlock(), started=True)
        return may, ""

    def refuses_reset(self, now: float) -> str:
        """Why `reset` would be refused now; empty: it would not."""
        return estop.reset(self._rules.button, self._latch, now)[1]

    def expects(self, topic: str, message: Message) -> bool:
        """Whether `on_message` is for this message."""
        rules = self._rules
        if topic in rules.further:
            return isinstance(message, TwistStamped if rules.further[topic].stamped else Twist)
        if rules.joystick is not None and topic == rules.joystick_topic:
            return isinstance(message, Joy)
        listens = topic in rules.locks or (rules.button is not None and topic == rules.button_topic)
        return listens and isinstance(message, Bool)

    def on_message(self, topic: str, message: Message, now: float) -> tuple[Command | None, str]:
        """Take a message in. Never raises for what it holds.

        Returns:
            The command that it is, if it is one, and what is wrong with it (empty: nothing).
        """
        rules = self._rules
        if isinstance(message, Bool):
            if topic in rules.locks:
                self._locks[topic] = (bool(message.data), now)
            elif rules.button is not None:
                self._latch = estop.on_button(rules.button, self._latch, bool(message.data), now)
        elif isinstance(message, Joy) and rules.joystick is not None:
            return self._on_joystick(rules.joystick, message, now)
        elif isinstance(message, Twist | TwistStamped) and topic in rules.further:
            return (None, "") if now < self._settled_at else self._on_twist(rules.further[topic].name, message, now)
        return None, ""

    def admitted(self, command: Command, now: float) -> None:
        """The supervisor took a command in, of whatever source."""
        source = self._sources.get(command.source)
        if source is not None:
            wanted = Velocity(command.linear, command.angular)
            heard = restart_interlock.want(source.neutral, wanted, now, source.timeout_s, command.decided)
            self._sources[command.source] = replace(source, wanted=wanted, heard_at=now, neutral=heard)

    def select(self, now: float, troubles: dict[str, str]) -> str:
        """Who drives now.

        Args:
            now: Monotonic seconds.
            troubles: Gets a sentence for people about each thing that stands in the way.
        """
        rules = self._rules
        if rules.joystick is not None:
            self._joystick = joystick.expire(rules.joystick, self._joystick, now)
        floor = max(self._floor_of_locks(now, troubles), self._floor_of_joystick(troubles))
        if self._stops(now, troubles):
            return Hand.NOBODY
        return self._first(floor, now, troubles)

    def limits(self, hand: str) -> VelocityLimits:
        """The supervisor's limits while that one drives."""
        params = self._rules.joystick
        if hand == Hand.JOYSTICK and params is not None:
            return with_gap(self._limits, params.max_age_s)
        source = self._sources.get(hand)
        return self._limits if source is None else with_gap(self._limits, source.timeout_s)

    def _first(self, floor: float, now: float, troubles: dict[str, str]) -> str:
        """The one of the highest priority who wants to drive and may; the agent, if nobody does."""
        rules = self._rules
        order = sorted(self._sources.items(), key=lambda item: -item[1].priority)
        held = rules.joystick_priority if self._joystick.grip is Grip.HELD else -inf
        for name, source in order:
            if held > source.priority and held >= floor:
                return Hand.JOYSTICK
            if not source.speaks(now) or source.priority < floor:
                continue
            if not source.neutral.why:
                return name
            if source.wanted != STANDSTILL:
                troubles[f"{name}:neutral"] = (
                    f"{name}: wants to move without having wanted a standstill for {restart_interlock.NEUTRAL_S:g} s"
                    f" since {source.neutral.why}; nothing moves by itself: `skytether robot start` lets it go on"
                )
        if held >= floor and held > -inf:
            return Hand.JOYSTICK
        agent = self._sources[Hand.AGENT]
        return Hand.NOBODY if agent.neutral.why or agent.priority < floor else Hand.AGENT

    def _stops(self, now: float, troubles: dict[str, str]) -> bool:
        """Whether the emergency stop holds the robot, or its button is not heard."""
        rules = self._rules
        doubted = rules.button is not None and estop.doubted(self._latch)
        if doubted:
            sentence = (
                "the emergency stop button was not heard since the gate stood still; the robot stands until it is"
            )
            troubles["button"] = f"{rules.button_topic}: {sentence}"
        silent = rules.button is not None and estop.silent(rules.button, self._latch, now)
        if silent:
            if rules.on_silence is OnSilence.LATCH and isfinite(self._latch.heard_at):
                self.engage("the emergency stop button fell silent")
            elif rules.on_silence is OnSilence.NEUTRAL:
                self._require("the emergency stop button was silent", inf)
                self._joystick = joystick.distrust(self._joystick)
            sentence = "the emergency stop button is not heard; the robot stands; see that its driver runs"
            troubles["button"] = f"{rules.button_topic}: {sentence}"
        if self._latch.reason:
            troubles["stopped"] = f"emergency stop: {self._latch.reason}; `skytether robot reset` ends it"
        return doubted or silent or bool(self._latch.reason)

    def _floor_of_locks(self, now: float, troubles: dict[str, str]) -> float:
        """Below what priority sources are blocked."""
        floor = -inf
        for topic, params in self._rules.locks.items():
            locked, heard_at = self._locks.get(topic, (True, nan))
            heard = -_TOLERANCE_S <= now - heard_at <= params.max_age_s
            if locked or not heard:
                floor = max(floor, params.priority)
                says = f"{topic} says so" if heard else f"{topic} is not heard"
                troubles[f"lock:{params.name}"] = (
                    f"lock {params.name}: {says}; whoever has a lower priority than {params.priority} is blocked"
                )
        return floor

    def _floor_of_joystick(self, troubles: dict[str, str]) -> float:
        topic, priority = self._rules.joystick_topic, self._rules.joystick_priority
        if self._joystick.grip is Grip.LOST:
            self._require("the joystick was lost", priority)
            troubles["joystick"] = (
                f"{topic}: {self._joystick.lost}; the robot stands until it is heard with the button up, or until"
                " `skytether robot reset`"
            )
        elif self._joystick.grip is Grip.UNSURE:
            troubles["joystick"] = (
                f"{topic}: the button is held and was not seen up for {joystick.RELEASED_S:g} s; let it go, then press"
            )
        return priority if self._joystick.grip in _HOLDS_BACK else -inf

    def _require(self, why: str, below: float) -> None:
        """All sources of a lower priority must be neutral before they drive again."""
        for name, source in self._sources.items():
            if source.priority < below:
                self._sources[name] = replace(source, neutral=restart_interlock.require(why), started=False)

    def _on_joystick(self, params: JoystickParams, message: Joy, now: float) -> tuple[Command | None, str]:
        self._joystick, wrong = joystick.on_message(params, self._joystick, message, now)
        if self._joystick.grip is Grip.LOST:
            self._require("the joystick was lost", self._rules.joystick_priority)
        if self._joystick.grip is not Grip.HELD:
            return None, wrong
        self._joystick_count += 1
        linear, angular = self._joystick.wanted
        return Command(Hand.JOYSTICK, linear, angular, 0, self._joystick_count, now, 0.0, now), wrong

    def _on_twist(self, name: str, message: Twist | TwistStamped, now: float) -> tuple[Command | None, str]:
        source = self._sources[name]
        twist, stamp = (message, (0, 0)) if isinstance(message, Twist) else (message.twist, _stamp(message))
        if any(stamp):
            dated = date(StampRule.ORDER, source.stamps, stamp, now, inf)
            self._sources[name] = source = replace(source, stamps=dated.stamps)
            if dated.wrong:
                return None, _WRONG[dated.wrong]
        self._sources[name] = source = replace(source, sequence=source.sequence + 1)
        linear, angular, unused = twist.linear.x, twist.angular.z, unused_axes(twist)
        return Command(name, linear, angular, 0, source.sequence, now, 0.0, now, unused), ""


_WRONG = {
    "repeated": "sends the same command again, which counts as silence",
    "older": "sends a command that is older than one before, which counts as silence until they go on for a second",
}
_HOLDS_BACK = frozenset({Grip.LOST, Grip.UNSURE})


def _stamp(message: TwistStamped) -> tuple[int, int]:
    return message.header.stamp.sec, message.header.stamp.nanosec
