"""The order before the wheels: who drives -> supervisor -> zones -> wheels. Pure: time is an argument.

Why it holds: at every step the robot has a stop on its present curve that the step before found free. A new velocity is
taken only if the same is true of it and the wheels can reach it; else the robot brakes on the old curve.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from math import inf, isfinite, nan

from skytether.control.admittance import STANDSTILL, Velocity
from skytether.messages import Message, String
from skytether.robot.control import supervisor
from skytether.robot.control.command import UNUSED_AXES, Command
from skytether.robot.control.supervisor import Objection, Supervised, VelocityLimits

from ...control.command import Hand
from ..geometry import kinematics as reach
from ..geometry.dead_reckoning import DeadReckoning
from ..geometry.footprint import Footprint
from ..geometry.stopping import Stages
from ..sensing.coverage import Action, UnseenParams
from ..sensing.sensing import RangeSensor, Sensing
from .contact import ContactParams, Contacts
from .modes import Envelope, ModeRules, Modes
from .places import Places
from .real_motion import OdometryRules, RealMotion
from .sources import SourceRules, Sources
from .zones import Allowed, Asked, Zone, ZoneParams

_ORDINARY = frozenset({Objection.LINEAR_ACCELERATION, Objection.ANGULAR_ACCELERATION})
"""Every start and every turn meets these limits; they are counted and not named."""
_EVENTS = 32
"""Troubles of single messages that are kept until the next step names them."""


@dataclass(frozen=True, slots=True)
class Rules:
    """Everything that is configured.

    Attributes:
        footprint: Outline of the robot with all that it carries.
        limits: The supervisor's; `max_gap_s` is the age at which a command of the agent ends.
        zones: Sizes of the zones.
        sensors: By topic.
        unseen: What to do about moving where none of them looks.
        contacts: Bumpers and cliff sensors, by topic.
        sources: Who may drive, and who may stop the robot.
        stages: Latencies from the light to the brakes.
        modes: Tighter limits, zones and outlines that hold at times.
    """

    footprint: Footprint
    limits: VelocityLimits = field(default_factory=VelocityLimits)
    zones: ZoneParams = field(default_factory=ZoneParams)
    sensors: Mapping[str, RangeSensor] = field(default_factory=dict)
    unseen: UnseenParams = field(default_factory=UnseenParams)
    contacts: Mapping[str, ContactParams] = field(default_factory=dict)
    sources: SourceRules = field(default_factory=SourceRules)
    odometry: OdometryRules | None = None
    stages: Stages = field(default_factory=Stages)
    modes: ModeRules = field(default_factory=ModeRules)


@dataclass(frozen=True, slots=True)
class GateDecision:
    """What one step decided.

    Attributes:
        velocity: For the wheels.
        hand: Who drives: a `Hand`, or the name of a further source.
        zone: What lies ahead.
        way: Of the outermost corner until what is seen gets into the stop zone [m]; inf: nothing that is seen is near.
        share: Of the wanted velocity that zones and sensors left.
        troubles: All that stands in the way now: a sentence for people, by kind.
    """

    velocity: Velocity
    hand: str
    zone: Zone
    way: float
    share: float
    troubles: Mapping[str, str]


class Gate:
    """Takes in commands and readings as they come, and says at each step what the wheels are told.

    Args:
        rules: What is configured; nothing that arrives changes it.
        stopped: Why the robot is to stand until somebody resets it; empty: it is not.
    """

    def __init__(self, rules: Rules, stopped: str = "") -> None:
        self.counts: Counter[str] = Counter()
        """What was objected to, by kind."""
        self.asked: Asked | None = None
        """What the zones were asked at the last step."""
        self._rules = rules
        self._modes = Modes(rules.modes, Envelope(rules.limits, rules.zones, rules.footprint))
        self._places = Places(self._modes, rules.stages, rules.unseen)
        self._active, self._place = frozenset[str](), self._places.of(frozenset())
        self._supervised = Supervised()
        self._sources = Sources(rules.sources, rules.limits, stopped)
        self._sensing = Sensing(rules.sensors, rules.footprint, rules.limits.clock_tolerance_s)
        self._contacts = Contacts(rules.contacts)
        oldest = max((sensor.max_age_s for sensor in rules.sensors.values()), default=0.0)
        self._reckoning = DeadReckoning(oldest + rules.stages.reaction_s(0.0))
        odometry = rules.odometry
        self._motion = None if odometry is None else RealMotion(odometry, rules.limits, rules.stages.guard_s)
        self._zone = Zone.CLEAR
        self._events: dict[str, str] = {}

    @property
    def stopped(self) -> str:
        """Why the robot stands until somebody resets it; empty: it does not."""
        return self._sources.stopped

    @property
    def modes(self) -> list[str]:
        """The modes that hold, by name."""
        return sorted(self._active)

    def set_modes(self, text: str, now: float) -> str:
        """A person or a program of the robot says which modes hold; see `Modes.select`.

        Returns:
            Why it is refused; empty: it is not.
        """
        if not self._rules.modes.envelopes:
            return "there are no modes (safety.modes)"
        if self._rules.modes.topic:
            return f"the topic {self._rules.modes.topic} says which modes hold (safety.mode.topic)"
        refused = self._modes.select(text, now)
        self._active = self._modes.active(now, {})
        return refused

    def command(self, command: Command, now: float) -> Objection | None:
        """Take a velocity in that the agent wants; its ``source`` must be `Hand.AGENT`."""
        return self._admit(command, now)

    def sense(self, topic: str, message: Message, now: float, wall: float = nan) -> None:
        """Take a message in from one of the robot's own sensors. Never raises for what it holds.

        Args:
            topic: As it is configured.
            message: What came.
            now: When it came, monotonic seconds.
            wall: The same by the clock that stamps are of [s]; nan: no sensor is known to use that (`StampRule.OWN`).
        """
        if topic in self._rules.sensors:
            wrong = self._sensing.on_message(topic, message, now, wall)
            if wrong is not None:
                self._event(*wrong)
        elif topic in self._rules.contacts and isinstance(message, self._rules.contacts[topic].message):
            reason = self._contacts.on_message(topic, message, now)
            if reason:
                self.engage(reason)
        elif topic == self._rules.modes.topic and isinstance(message, String):
            if unknown := self._modes.select(message.data, now):
                self._event("mode:message", f"{topic}: {unknown}")
        elif self._sources.expects(topic, message):
            self._on_source_message(topic, message, now)
        elif self._motion is not None and self._rules.odometry is not None and topic == self._rules.odometry.topic:
            if wrong_reading := self._motion.measure(message, now, wall):
                self._event("odometry:message", f"{topic}: {wrong_reading}")
        else:
            self._event(f"topic:{topic[:64]}", f"{topic[:64]}: a {message.TYPE} is not expected there and not used")

    def stalled(self, now: float) -> None:
        """The gate stood still until now; see `Sources.stalled`."""
        self._sources.stalled(now)

    def engage(self, reason: str) -> None:
        """Emergency stop, until `reset`."""
        self._sources.engage(reason)

    def reset(self, now: float) -> str:
        """End the emergency stop and forget all commands; see `Sources.reset`.

        Returns:
            Why it was refused; empty: it was not.
        """
        refused = self._contacts.refuses_reset(now) or self._sources.reset(now)
        if not refused:
            self._sensing.relearn()
            if self._motion is not None:
                self._motion.relearn()
            self._supervised = replace(
                self._supervised, held={k: replace(v, received_at=-inf) for k, v in self._supervised.held.items()}
            )
        return refused

    def start(self, now: float) -> tuple[list[str], str]:
        """A person says that those who want to drive now may; see `Sources.start`."""
        return self._sources.start(now)

    @property
    def started(self) -> bool:
        """A person let the agent go on since it last had to be neutral."""
        return self._sources.agent_started

    @property
    def waiting(self) -> Mapping[str, str]:
        """Sources that must be neutral before they may drive, and after what."""
        return self._sources.waiting

    def refuses_reset(self, now: float) -> str:
        """Why `reset` would be refused now; empty: it would not."""
        return self._contacts.refuses_reset(now) or self._sources.refuses_reset(now)

    def rebase(self, velocity: Velocity, at: float) -> None:
        """The wheels were told something else than the last step decided: the next one goes on from there.

        Args:
            velocity: What they were told.
            at: When [s]; before the time of the next step.
        """
        before = self._supervised.now
        self._reckoning.update(velocity, at if before is None else max(at, before))
        self._supervised = replace(self._supervised, velocity=velocity, now=at)

    def step(self, now: float) -> GateDecision:
        """Decide what the wheels are told until the next step. Never raises; whatever fails stands still."""
        troubles: dict[str, str] = self._events
        self._events = {}
        self.asked = None
        try:
            decision = self._decide(now, troubles)
        except Exception as error:  # a bug in here must not keep the wheels turning
            troubles["internal"] = f"the gate itself failed and stops the robot: {type(error).__name__}: {error}"
            decision = GateDecision(STANDSTILL, Hand.NOBODY, Zone.STOP, 0.0, 0.0, troubles)
            self._supervised = Supervised(held=self._supervised.held)
        self._reckoning.update(decision.velocity, now)
        if self._motion is not None:
            self._motion.told(decision.velocity, now)
        self.counts.update(troubles.keys())
        return decision

    def _decide(self, now: float, troubles: dict[str, str]) -> GateDecision:
        self._active = self._modes.active(now, troubles)
        self._place = place = self._places.of(self._active)
        before, dt = self._supervised.velocity, supervisor.elapsed(place.limits, self._supervised, now)
        broken = self._motion.update(now, troubles) if self._motion is not None else ""
        if broken:
            self.engage(broken)
        hand = self._sources.select(now, troubles)
        silent = self._contacts.silent(now)
        if silent:
            troubles.update(silent)
            hand = Hand.NOBODY
        wanted = self._supervise(hand, now, troubles)
        allowed = self._see(wanted, now, troubles)
        if self._motion is not None:
            share = min(self._motion.share(hand, before, wanted, now), self._most(self._motion.action, wanted))
            allowed = replace(allowed, share=min(allowed.share, share))
        velocity = Velocity(wanted.linear * allowed.share, wanted.angular * allowed.share)
        if not reach.within_reach(place.limits, before, velocity, dt):
            velocity = reach.brake_on_curve(place.limits, before, dt)
        if not (isfinite(velocity.linear) and isfinite(velocity.angular)):
            velocity = STANDSTILL
        self._supervised = replace(self._supervised, velocity=velocity)
        return GateDecision(velocity, hand, allowed.zone, allowed.way, allowed.share, troubles)

    def _supervise(self, hand: str, now: float, troubles: dict[str, str]) -> Velocity:
        limits = supervisor.with_gap(self._place.limits, self._sources.limits(hand).max_gap_s)
        self._supervised, objections = supervisor.step(limits, self._supervised, hand, limits.max_gap_s, now)
        for objection in objections:
            if objection in _ORDINARY:
                self.counts[f"{hand}:{objection}"] += 1
            elif hand != Hand.NOBODY:
                troubles[f"{hand}:{objection}"] = f"{hand}: {_SAYS[objection]}"
        return self._supervised.velocity

    def _see(self, wanted: Velocity, now: float, troubles: dict[str, str]) -> Allowed:
        """What zones and sensors leave of a velocity."""
        scene = self._sensing.see(now, self._reckoning)
        troubles.update(scene.troubles)
        varied = self._reckoning.varied(now - scene.age - self._place.stages.late_s, wanted)
        self.asked = asked = Asked(wanted, scene.points, varied, self._zone)
        allowed = self._place.zones.allow(wanted, asked.points, varied, self._zone)
        self._zone = allowed.zone
        covers = [part.cover for part in scene.parts]
        unseen = self._place.unseen.share(wanted, covers, self._place.zones.way(wanted))
        if unseen < 1:
            verb = "does not go there" if unseen == 0 else "goes there slowly"
            troubles["unseen"] = f"no sensor looks where the robot is to move (safety.unseen); it {verb}"
        sight = self._place.zones.within_sight(wanted, scene.edge, varied)
        if sight < 1:
            troubles["sight"] = "the sensors do not see far enough to stop from a higher speed (their range_max)"
        most = self._most(scene.action, wanted)
        unknown = allowed.zone is not Zone.STOP and (scene.unknown or unseen < 1)
        zone = Zone.UNKNOWN if unknown else allowed.zone
        return replace(allowed, share=min(allowed.share, most, unseen, sight), zone=zone)

    def _most(self, action: Action, wanted: Velocity) -> float:
        """What share of a velocity an action leaves."""
        return {Action.STOP: 0.0, Action.SLOW: self._place.zones.slow(wanted), Action.FREE: 1.0}[action]

    def _on_source_message(self, topic: str, message: Message, now: float) -> None:
        command, wrong = self._sources.on_message(topic, message, now)
        if wrong:
            self._event(f"{topic}:message", f"{topic}: {wrong}")
        if command is not None:
            self._admit(command, now)

    def _admit(self, command: Command, now: float) -> Objection | None:
        limits = self._sources.limits(command.source)
        self._supervised, objection = supervisor.admit(limits, self._supervised, command, limits.max_gap_s, now)
        if objection is None:
            self._sources.admitted(command, now)
        else:
            who = f"a command of {command.source} is refused: {_SAYS[objection]}"
            self._event(f"command:{command.source}:{objection}", who)
        return objection

    def _event(self, kind: str, sentence: str) -> None:
        if len(self._events) < _EVENTS:
            self._events[kind] = sentence


_SAYS: Mapping[Objection, str] = {
    Objection.NOT_FINITE: "its velocity is NaN or infinite",
    Objection.UNUSED_AXES: f"it wants to move along {UNUSED_AXES}, which these wheels do not have",
    Objection.SEQUENCE: (
        "it is not newer than one that was taken before; of two agents only the one that was started last is followed, "
        "also when it has ended: end both and start one"
    ),
    Objection.STALE: "it was made too long ago",
    Objection.GAP: "the last valid command is too old; the robot stops",
    Objection.FUTURE: "it claims to come from the future",
    Objection.CLOCK: "the clock did not advance, or its time cannot be judged",
    Objection.NO_COMMAND: "no valid command has come yet",
    Objection.LINEAR_LIMIT: "it wants to go faster than the limit, and gets the limit",
    Objection.ANGULAR_LIMIT: "it wants to turn faster than the limit, and gets the limit",
    Objection.LINEAR_ACCELERATION: "it wants to change speed faster than the limit",
    Objection.ANGULAR_ACCELERATION: "it wants to change its turn faster than the limit",
}
