"""One tick of the control loop: readings in, source choice, supervisor, velocity out. Time is an argument.

It is given a session when there is one, and drives without. Nothing here waits for anything.
"""

from __future__ import annotations

import logging
from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from math import inf, isfinite, nan
from typing import Protocol

from skytether.control.admittance import STANDSTILL, Velocity
from skytether.messages import DecodeError, Encoding, Message, Twist, Vector3, decode
from skytether.wire.events import MessageReceived

from ..log_throttle import LogThrottle
from ..session.link_quality import Quality
from ..session.session import LiveSession
from . import arbiter, restart_interlock, service_manager, supervisor
from .arbiter import ArbiterDecision, LinkRequirements, LinkState
from .command import UNUSED_AXES, Command, Source, unused_axes
from .control_status import ControlStatus, Transition
from .failure_detector import AccrualDetector
from .fallback import Fallback, Reading, Watching
from .restart_interlock import RestartInterlock
from .service_manager import Terms
from .stall import StallWatch
from .supervisor import Objection, Supervised, VelocityLimits
from .wheels_feedback import AsksWhy, TellsBack, WheelsFeedback, rebase

_log = logging.getLogger(__name__)

_NAMED = {
    Objection.NOT_FINITE: "a velocity is NaN or infinite; such are not followed",
    Objection.UNUSED_AXES: f"one wants to move along {UNUSED_AXES}, and the wheels cannot; such are not followed",
    Objection.SEQUENCE: "one came again, or after a newer one; such are not followed",
    Objection.STALE: "made from information that is too old; such are not followed",
    Objection.FUTURE: "sent later than now; such are not followed",
    Objection.CLOCK: "their age cannot be known, because a clock is not known or did not go on; such are not followed",
    Objection.LINEAR_LIMIT: "faster than limits.linear_min and linear_max allow; they are cut down",
    Objection.ANGULAR_LIMIT: "turning faster than limits.angular_max allows; they are cut down",
}
"""Named in the log, once while it lasts. A gap is told by the hand-over; limits of acceleration are no trouble."""
_OWES = (
    "the link is good, but the service wants to move since before the reset, and nothing moves by itself: it takes over"
    " once it wanted a standstill; or end its work and begin it again, or type `skytether robot start`"
)
_ONE_VOICE_S = restart_interlock.NEUTRAL_S + 0.1
"""For how long the service must have been the agent's voice, for what the gate heard to be all its own [s]."""
_LOOKED_TICKS = 2.0
"""Periods of the loop that one tick counts for at most, when the cloud's silence is measured."""
_TICK_S = 0.5
"""No tick takes longer than this: a command that came later than that after its begin is not from this clock."""
_SETTLE_S = 0.2
"""After a stall, how long readings are not used [s]: those from before it wait in sockets, and are read first."""
_QUIET_S = 30.0
"""Without an error of a part, the next one is logged again [s]."""
_TRANSITIONS_KEPT = 1000
"""The newest; all are counted."""


class WheelsStandError(ConnectionError):
    """The wheels were told to stand, in place of what they were to do."""


class RobotHardware(Protocol):
    """The robot's own hardware, or a simulation of it. Both calls must return within a fraction of a tick.

    A call that never returns, or a killed process, ends the control loop: motors must stop by themselves when nothing
    has been written for some 100 ms (`VelocityLimits.watchdog_s`), as motor drives with a watchdog do.
    """

    topics: Mapping[str, type[Message]]
    """What `read` may give, by topic name."""

    def read(self, now: float) -> Iterable[tuple[str, Message]]:
        """New readings since the last call, for the service and for the fallback."""
        ...

    def write(self, twist: Twist) -> None:
        """What the wheels are to do until the next call.

        Raises:
            WheelsStandError: They were told to stand; the loop goes on from there. Whatever else is raised is counted.
        """
        ...


Observer = Callable[[Command, Objection | None], None]
"""Told each command from the cloud that arrives, and what was wrong with it. Must return at once."""


Clocks = Callable[[], tuple[float, float | None]]
"""Now by the clock that stands still in a suspend, and by the one that goes on (None: there is none)."""


class ControlLoop:
    """The robot's control, tick by tick.

    Args:
        hardware: The robot's.
        fallback: Who drives when the cloud does not.
        limits: The supervisor's.
        needs: The arbiter's, and the robot's own; what a session says about the service only tightens them.
        now: Monotonic seconds.
        observer: See `Observer`.
        clocks: Both clocks as `agent.clocks` reads them, looked at right before each velocity is
            written: who is stopped in the middle of a tick tells nothing old. None: time is made up.
    """

    def __init__(
        self,
        hardware: RobotHardware,
        fallback: Fallback,
        limits: VelocityLimits,
        needs: LinkRequirements,
        now: float,
        observer: Observer | None = None,
        clocks: Clocks | None = None,
    ) -> None:
        self.session: LiveSession | None = None
        self.left: deque[LiveSession] = deque()
        """Those before, for somebody else to close: that may take a while."""
        self._offered: deque[LiveSession] = deque()
        self._coming: LiveSession | None = None
        self.quality = Quality()
        self._hardware = hardware
        self._fallback = fallback
        self._tells_back = hardware if isinstance(hardware, TellsBack) else None
        self._asks_why = hardware if isinstance(hardware, AsksWhy) else None
        self._told: WheelsFeedback | None = None
        self._spoke = False
        """A service has sent commands, ever."""
        self._owed = RestartInterlock()
        """Whether it must have wanted a standstill before it takes over from the fallback."""
        self._waited = False
        """Nobody was allowed to drive, when the gate told of it last."""
        self._watching = fallback if isinstance(fallback, Watching) else None
        self._own_limits = self._limits = limits
        """As configured, and with what was learned of the commands' gaps."""
        self._observer = observer
        self._own_needs = self._needs = replace(needs, local=Source.FALLBACK if fallback.drives else Source.STOP)
        self._command_timeout_s = needs.command_timeout_s
        self._arrivals = AccrualDetector(None, limits.silence_s, needs.command_timeout_s)
        self._quiet = inf
        self._command_before = (0, 0)
        """Handshake and sequence of the newest that was admitted."""
        self._log_throttle = LogThrottle(_log)
        self._choice: ArbiterDecision = arbiter.start(self._needs, now)
        self._supervised = Supervised()
        self._why = "no command has come yet"
        self._now = now
        self._ticks = 0
        self._readings: dict[str, Reading] = {}
        self._transitions = deque([Transition(now, self._choice.source, self._choice.reason)], _TRANSITIONS_KEPT)
        self._counts: Counter[str] = Counter({self._choice.reason: 1})
        self._seconds = dict.fromkeys(Source, 0.0)
        self._commands = self._missed_commands = 0
        self._objections: Counter[str] = Counter()
        self._errors: Counter[str] = Counter()
        self._failed_at: dict[str, float] = {}
        self._read: Counter[str] = Counter()
        self._first_command_at: float | None = None
        self._clocks = clocks
        self._stall = StallWatch(limits.watchdog_s)
        self._stalls = 0
        self._written_at = now
        self._believed_from = -inf

    @property
    def source(self) -> Source:
        """Who drives now."""
        return self._choice.source

    def hold_to(self, terms: Terms) -> None:
        """Take over what the service's manifest says of the link and of its commands, where it is stricter."""
        self._arrivals = AccrualDetector(terms.period_s, self._own_limits.silence_s, self._command_timeout_s)
        self._needs = service_manager.tighten(self._own_needs, terms)

    def tick(self, now: float, boot: float | None = None) -> None:
        """One turn of the loop: exactly one velocity is written. Never raises.

        Whatever goes wrong on the way brakes the wheels: what cannot be computed must not be driven. A loop that stood
        still goes on from standstill.

        Args:
            now: Monotonic seconds.
            boot: Seconds of the clock that goes on in a suspend; None: there is none.
        """
        self._seconds[self._choice.source] += max(0.0, now - self._now)
        try:
            self._check_stall(now, boot)
            # Time in which nobody could look proves no silence: what came meanwhile may wait in the socket still.
            self._quiet += min(max(0.0, now - self._now), _LOOKED_TICKS * self._limits.period_s)
            self._read_sensors(now)
            self._read_back_velocity(now)
            self._receive_commands(now)
            self._choose(now)
            velocity = self._drive(now)
            decided = self._decided(now)
        except Exception as error:  # a plug-in, a driver, a bug: none of them may keep the wheels turning
            self._caught("control", error)
            velocity, decided = self._brake(now), False
        self._now = now
        self._ticks += 1
        self._write(velocity, decided)

    def offer(self, session: LiveSession) -> None:
        """Another session, instead of the one that there is; it gets the same readings until it takes over."""
        self._offered.append(session)

    def let_go(self) -> None:
        """Have no session, and none that is coming."""
        self._offered.clear()
        self._coming = self.session = None

    def halt(self) -> None:
        """Tell the wheels to stand; the last thing that the loop does."""
        self._supervised = Supervised()
        self._write(STANDSTILL)

    def status(self) -> ControlStatus:
        """A snapshot; from any thread."""
        held = self._supervised.held.get(Source.CLOUD)
        return ControlStatus(
            source=self._choice.source,
            transitions=tuple(self._transitions),
            transition_counts=dict(self._counts),
            why=self._why,
            seconds=dict(self._seconds),
            velocity=self._supervised.velocity,
            commands=self._commands,
            missed_commands=self._missed_commands,
            objections=dict(self._objections),
            errors=dict(self._errors),
            first_command_at=self._first_command_at,
            last_command_at=held.received_at if held and isfinite(held.received_at) else None,
            readings=dict(self._read),
            told=self._told,
            silence_limit_s=self._arrivals.limit_s,
            stalls=self._stalls,
        )

    def _check_stall(self, now: float, boot: float | None) -> None:
        """Whatever was known before a gap is old, and the wheels stand."""
        stood = self._stall.tick(now, boot)
        if not stood:
            if now - self._written_at > self._limits.watchdog_s:  # nothing could be written: they stand as well
                self._supervised = replace(self._supervised, velocity=STANDSTILL)
            return
        self._stalls += 1
        self._supervised = supervisor.begin_anew(self._supervised, now)
        self._readings.clear()
        self._believed_from = now + _SETTLE_S
        self._now = now - self._limits.period_s  # the wheels' step, and the fallback's, is an ordinary one
        if isfinite(self._quiet):
            self._quiet = 0.0  # whether the cloud is there is found out from now on
        sentence = f"the control loop stood still for {stood:.2f} s; the robot goes on from standstill"
        self._log_throttle.warn("stall", f"control: {sentence}", now)

    def _read_sensors(self, now: float) -> None:
        for topic, message in self._hardware.read(now):
            self._read[topic] += 1
            if now < self._believed_from:
                continue
            self._readings[topic] = Reading(message, now)
            for session in (self.session, self._coming):
                if session is not None:
                    try:
                        session.publish(topic, message)
                    except Exception as error:  # costs the cloud a reading; the robot's own control goes on
                        self._caught("publish", error)

    def _read_back_velocity(self, now: float) -> None:
        if self._tells_back is None:
            return
        self._told = self._tells_back.told(now)
        if self._told is None:
            return
        self._supervised = rebase(self._limits, self._supervised, self._told)
        # The gate takes the agent for one. The fallback's standstill lets the fallback drive; a service that wanted to
        # drive all the time must have wanted one itself, also where it was let go and asked for again meanwhile.
        if self._told.nobody:
            self._waited = True
            if self._spoke and not self._owed.why:
                self._owed = restart_interlock.require("nobody was allowed to drive")
        elif self._told.agent:
            served = self._choice.source is Source.CLOUD and now - self._choice.since > _ONE_VOICE_S
            if self._told.started or (self._waited and served):
                self._owed = RestartInterlock()  # a person let the agent go on, or it was the service that was neutral
            self._waited = False

    def _change_over(self) -> list[LiveSession]:
        """Make before break: while the cloud drives, another session takes over with its first command.

        Returns:
            Whose commands are taken now: at a change also those that still wait of the session before, which came
            first. Without them the change alone would cost up to a period of commands.
        """
        while self._offered:
            if self._coming is not None:
                self.left.append(self._coming)
            self._coming = self._offered.popleft()
        before, coming = self.session, self._coming
        if coming is not None and (self._choice.source is not Source.CLOUD or coming.commands):
            if before is not None:
                self.left.append(before)
            self.session, self._coming = coming, None
            return [before, coming] if before is not None else [coming]
        return [before] if before is not None else []

    def _receive_commands(self, now: float) -> None:
        for session in self._change_over():
            self._missed_commands += session.drain_missed()
            for epoch, message in session.drain_commands():
                self._commands += 1
                self._receive_command(epoch, message, session.encoding, now)

    def _receive_command(self, epoch: int, message: MessageReceived, encoding: Encoding, now: float) -> None:
        try:
            command = _command(epoch, message, encoding)
        except DecodeError as error:
            self._caught("decode", error)
            return
        late = command.received_at - now
        if 0 < late < _TICK_S:  # it came while this tick was under way, which began at `now`
            command = replace(command, received_at=now, sent_at=command.sent_at - late)
        objection = self._admit(command, now)
        if objection is None:
            self._spoke = True
            wanted = Velocity(command.linear, command.angular)
            self._owed = restart_interlock.want(self._owed, wanted, now, self._arrivals.limit_s)
            before = self._command_before
            lost = command.sequence - before[1] - 1 if before[0] == command.epoch else 0
            self._command_before = command.epoch, command.sequence
            self._arrivals.arrived(command.received_at, lost)
            self._quiet = min(max(0.0, now - command.received_at), _LOOKED_TICKS * self._limits.period_s)
            if self._first_command_at is None:
                self._first_command_at = command.received_at
        if self._observer is not None:
            try:
                self._observer(command, objection)
            except Exception as error:  # measuring must not stop the robot
                self._caught("observer", error)

    def _choose(self, now: float) -> None:
        held = self._supervised.held.get(Source.CLOUD)
        link = LinkState(
            connected=self.session is not None and self.session.connected,
            command_at=now - self._quiet if isfinite(self._quiet) else None,
            rtt=self.quality.rtt,
            loss=self.quality.loss,
            late=self.quality.late,
            clock_error=held.sent_at_error if held else nan,
            owes=bool(self._owed.why) and not (self._told is not None and self._told.nobody),
        )
        timeout = self._arrivals.limit_s
        if timeout != self._needs.command_timeout_s:
            self._needs = replace(self._needs, command_timeout_s=timeout)
            self._limits = replace(self._own_limits, max_gap_s=max(self._own_limits.max_gap_s, timeout))
        before = self._choice
        self._choice = arbiter.choose(self._needs, before, link, now)
        if self._choice.source is not before.source:
            why = service_manager.explain(self._choice.reason, self._needs, link, self.quality, now)
            self._counts[self._choice.reason] += 1
            self._transitions.append(Transition(now, self._choice.source, self._choice.reason))
            _log.warning("control: %s -> %s (%s): %s", before.source, self._choice.source, self._choice.reason, why)
            self._why = why
        since = self._choice.good_since
        if link.owes and self._choice.source is not Source.CLOUD and since and now - since > self._needs.good_s:
            self._log_throttle.warn("owes", f"control: {_OWES}", now)

    def _drive(self, now: float) -> Velocity:
        source = self._choice.source
        dt = min(max(0.0, now - self._now), self._limits.max_step_s)
        if self._watching is not None:
            try:
                self._watching.watch(self._supervised.velocity, self._readings, dt)
            except Exception as error:  # who only watches must not stop who drives
                self._caught("fallback", error)
        if source is Source.FALLBACK:
            wanted = self._fallback.step(self._supervised.velocity, self._readings, dt)
            if wanted is not None:
                (linear, angular), read_at = wanted
                self._admit(Command(source, linear, angular, 0, self._ticks, read_at, 0.0, now), now)
        velocity = self._supervise(source, now)
        if self._told is not None and self._told.stopped:  # the wheels stand, and whoever resets wants them to
            self._supervised = replace(self._supervised, velocity=STANDSTILL)
            return STANDSTILL
        return velocity

    def _supervise(self, source: Source, now: float) -> Velocity:
        self._supervised, objections = supervisor.step(
            self._limits, self._supervised, source, self._max_age(source), now
        )
        self._object(objections, source, now)
        return self._supervised.velocity

    def _admit(self, command: Command, now: float) -> Objection | None:
        age = self._max_age(command.source)
        self._supervised, objection = supervisor.admit(self._limits, self._supervised, command, age, now)
        if objection is not None:
            self._object((objection,), command.source, now)
        return objection

    def _object(self, objections: Iterable[Objection], source: str, now: float) -> None:
        """Count always; name each kind once."""
        for objection in objections:
            self._objections[objection] += 1
            if objection in _NAMED:
                self._log_throttle.warn(f"{source} {objection}", f"commands of {source}: {_NAMED[objection]}", now)

    def _max_age(self, source: str) -> float:
        return supervisor.max_age(self._limits, source, self._needs.max_rtt_s)

    def _brake(self, now: float) -> Velocity:
        try:
            return self._supervise(Source.STOP, now)
        except Exception as error:  # nothing left to reason with
            self._caught("supervisor", error)
            self._supervised = Supervised()
            return STANDSTILL

    def _decided(self, now: float) -> bool:
        """Whether a standstill is what the one who drives wants; else it is told because nothing better is known."""
        source = self._choice.source
        if now < self._believed_from:
            return False
        if source is Source.STOP:  # a service that has spoken, and is not heard now, may want to drive all the time
            return not self._spoke
        return supervisor.wants_standstill(self._limits, self._supervised, source, self._max_age(source), now)

    def _write(self, velocity: Velocity, decided: bool = False) -> None:
        if self._clocks is not None and self._stall.late(*self._clocks()):
            velocity, decided = STANDSTILL, False  # what was computed before the gap; the next tick finds it
        try:
            if self._asks_why is not None:
                self._asks_why.decided(decided)
            self._hardware.write(Twist(linear=Vector3(x=velocity.linear), angular=Vector3(z=velocity.angular)))
            self._written_at = self._now
        except Exception as error:  # tried again at the next tick
            if isinstance(error, WheelsStandError):
                self._supervised = replace(self._supervised, velocity=STANDSTILL)  # from there it goes on
            self._caught("write", error)

    def _caught(self, part: str, error: Exception) -> None:
        """Count always; log the first of each part in a while, with its trace if its sentence may not say all."""
        self._errors[part] += 1
        if self._now - self._failed_at.get(part, -inf) > _QUIET_S:
            trace = None if isinstance(error, ConnectionError) else error
            _log.error("%s failed, more within %g s are counted only: %s", part, _QUIET_S, error, exc_info=trace)
        self._failed_at[part] = self._now


def _command(epoch: int, message: MessageReceived, encoding: Encoding) -> Command:
    twist = decode(Twist, message.payload, encoding)
    return Command(
        source=Source.CLOUD,
        linear=twist.linear.x,
        angular=twist.angular.z,
        epoch=epoch,
        sequence=message.sequence,
        sent_at=message.sent_at,
        sent_at_error=message.sent_at_error,
        received_at=message.received_at,
        unused=unused_axes(twist),
    )
