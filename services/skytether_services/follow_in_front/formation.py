"""The control law: the robot keeps a distance ahead of its operator, and turns to where the operator's face points.

After the controller that the thesis describes (section 5.5.1, after Scheidegger et al.): a formation controller for the
linear velocity, a steering controller that minimises the face's horizontal angle. Pure: times are given.

**Distance.** With d the distance, u the operator's speed towards the robot and alpha the angle between the robot's
heading and the line from operator to robot, ``d' = v cos(alpha) - u``. The law is ``v = (u + k e) cos(alpha)`` with
``e = d* - d``; near alpha = 0 the error obeys ``e' = -k e``, and what of u is not known adds to it. If all of it comes
late by T, ``e'(t) = -k e(t - T)``: stable for ``k T < pi/2``, without any swing for ``k T <= 1/e``. With k = 0.7/s
that is T < 2.2 s and T <= 0.53 s. T is the round trip, half a scan's period and the wheels' lag: some 0.2 s more than
the round trip. So up to the 300 ms of section 5.7 nothing swings, and at its 500 ms little does.

**Steering.** The face points to ``psi`` off the robot's heading; where the operator looks at one place,
``psi' = -omega``. The law is ``omega = k_psi f(psi)``, f being psi less a dead band, which is at most psi itself: the
same equation, with a gain of 0.9/s at the most, stable for T < 1.7 s. Within the dead band the robot drives straight
on; that is how a wavering head, and the error of the pose, do not become turns.

**Prediction** (``predict``). Since the robot knows its own commands, it counts on from the moment of measurement to the
moment at which the new command acts: the distance by what it has commanded less the way of the operator, the face's
angle by the turns commanded. That is Smith's predictor (1957), for a plant that is an integrator: the delay leaves the
loop, and what remains is what the operator does meanwhile. They are taken to walk on as fast as they do: how that
changes is mostly the swing of their steps, and counting on with it made the robot jerk and drive slower. Where the time
is wrong by dT, the loop is one with the delay dT.
Who leads the robot round a curve goes on looking aside, and ``psi`` does not fall by what the robot turns: counting on
alone would make the answer smaller, ``k_psi / (1 + k_psi T)``, and smaller still over a slower link. So the gain is
raised to ``k_psi / (1 - k_psi T)``, T being the time that is usually counted on: a face that stays aside is answered
alike over any link. It is doubled at the most.

Speed and acceleration are limited; the robot never drives back, towards the operator. Saturation slows both laws down
and adds no energy: each error's sign gives the command's sign, whatever its size.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

from skytether.control.admittance import STANDSTILL, Velocity
from skytether.control.numbers import check_positive

_LONGEST_STEP = 0.2
"""A step that comes later than this counts as this, s: a stalled machine makes no leap."""
_MEMORY = 3.0
"""Commands are remembered for this long, s: longer than anything is predicted."""
_MOST = 1000
"""And so many of them at the most: 3 s at 100 Hz, with room."""
_MOST_RAISED = 0.5
"""What is counted on doubles the gain of steering at the most: noise and errors of time are raised with it."""
_LONGEST_GAP = 1.0
"""Samples further apart than this say nothing of how something changes, s."""


class State(StrEnum):
    """What the robot does, and why it does not.

    Attributes:
        FOLLOWING: Legs and face are in sight.
        FACE_SLOW: Faces come too seldom: the robot goes slowly.
        FACE_LOST: No face: the robot goes straight on, slower and slower.
        LEGS_LOST: No legs: likewise.
        STANDING: One of both is gone for long, or was never there.
    """

    FOLLOWING = "following"
    FACE_SLOW = "face_slow"
    FACE_LOST = "face_lost"
    LEGS_LOST = "legs_lost"
    STANDING = "standing"


class Command(NamedTuple):
    """What to do: a velocity, and the reason."""

    velocity: Velocity
    state: State


@dataclass(frozen=True, slots=True)
class FormationParams:
    """The law's numbers.

    Attributes:
        distance: d*, from the robot's middle to the operator's [m].
        distance_gain: k [1/s].
        steering_gain: k_psi [1/s].
        dead_band: A face that points less than this off the heading does not steer [rad].
        widest: A face that points further off counts as this [rad]: nobody sees the way beyond it.
        filter_time: Time constant of the filter of the face's angle [s].
        speed_time: Time constant of the filter of the operator's speed [s]: legs swing, about once a second.
        max_linear: Fastest [m/s].
        max_angular: Fastest turn [rad/s].
        acceleration: Of the linear velocity [m/s^2].
        braking: The same, when it falls [m/s^2].
        angular_acceleration: [rad/s^2].
        slow_after: Legs or a face older than this make it slower [s]; above the round trips of section 5.7.
        stop_after: And older than this make it stand [s].
        least_face_rate: Faces that come less often make it slow [Hz] (section 5.5.2: five frames a second).
        slow_share: What of the speed is left then.
        sharpest: An operator further off the line straight back than this is not followed [rad].
        predict: Whether to predict.
        lead: From a command to its effect, for the prediction, at first: the way down, and half the wheels' lag [s].
    """

    distance: float = 0.9
    distance_gain: float = 0.7
    steering_gain: float = 0.9
    dead_band: float = math.radians(5)
    widest: float = math.radians(60)
    filter_time: float = 0.15
    speed_time: float = 0.5
    max_linear: float = 0.8
    max_angular: float = 0.6
    acceleration: float = 0.6
    braking: float = 1.2
    angular_acceleration: float = 1.5
    slow_after: float = 0.6
    stop_after: float = 1.2
    least_face_rate: float = 5.0
    slow_share: float = 0.5
    sharpest: float = math.radians(60)
    predict: bool = True
    lead: float = 0.1

    def __post_init__(self) -> None:
        """Refuse what cannot be.

        Raises:
            ValueError: A number is out of its range; the text names it.
        """
        names = [name for name in self.__slots__ if name not in ("predict", "lead", "dead_band")]
        check_positive(self, "formation", names)
        check_positive(self, "formation", ("lead", "dead_band"), zero=True)
        if self.stop_after <= self.slow_after:
            raise ValueError(f"formation: stop_after must be above slow_after, not {self.stop_after}")
        if self.slow_share > 1:
            raise ValueError(f"formation: slow_share must be 1 at the most, not {self.slow_share}")


class _Legs(NamedTuple):
    """Where the operator was at a time [s]: distance [m], angle off straight back [rad], speed to the robot [m/s]."""

    at: float
    distance: float
    off: float
    speed: float


_DEFAULT = FormationParams()


class Formation:
    """One robot ahead of one operator."""

    def __init__(self, params: FormationParams = _DEFAULT) -> None:
        self._params = params
        self.lead = params.lead
        """From a command to its effect [s], as far as it is known now."""
        self.doubt = 0.0
        """What was measured may be older by so much than is told [s]; inf: nobody knows how old it is."""
        self._legs: _Legs | None = None
        self._face: tuple[float, float] | None = None
        self._interval = 0.0
        self._ahead = 0.0
        """From a face to what the command that it leads to does [s], as a mean."""
        self._counted_at: float | None = None
        """When the face was made that this was last noted of."""
        self._velocity = STANDSTILL
        self._stands_first = False
        self._stepped_at: float | None = None
        self._commands: deque[tuple[float, Velocity]] = deque(maxlen=_MOST)

    @property
    def face_rate(self) -> float:
        """Faces a second, lately; 0 until two came."""
        return 1 / self._interval if self._interval > 0 else 0.0

    @property
    def aside(self) -> bool:
        """Whether the operator is too far off the line straight back to be followed."""
        return self._legs is not None and abs(self._legs.off) > self._params.sharpest

    def legs(self, x: float, y: float, vx: float, vy: float, at: float) -> None:
        """Take where the operator was; what is not finite, or not newer than the last, is ignored.

        Args:
            x: In the robot's frame, below 0 [m].
            y: To the left [m].
            vx: Velocity over the floor along the robot's x [m/s].
            vy: Along its y [m/s].
            at: When [s].
        """
        if not all(map(math.isfinite, (x, y, vx, vy, at))) or (self._legs is not None and at <= self._legs.at):
            return
        distance = math.hypot(x, y)
        # From operator to robot the direction is (-x, -y) / distance.
        speed = -(x * vx + y * vy) / distance if distance > 1e-6 else vx
        before = self._legs
        gap = at - before.at if before is not None else math.inf
        if before is not None and gap <= _LONGEST_GAP:
            speed = before.speed + (speed - before.speed) * -math.expm1(-gap / self._params.speed_time)
        self._legs = _Legs(at, distance, math.atan2(y, -x), speed)

    def face(self, angle: float, at: float) -> None:
        """Take where the face pointed; what is not finite, or not newer than the last, is ignored.

        Args:
            angle: Off the robot's heading, positive to its left [rad].
            at: When [s].
        """
        if not (math.isfinite(angle) and math.isfinite(at)) or (self._face is not None and at <= self._face[1]):
            return
        angle = min(max(angle, -self._params.widest), self._params.widest)
        if self._face is None or at - self._face[1] > _LONGEST_GAP:
            self._face, self._interval = (angle, at), 0.0
            return
        before, gap = self._face[0], at - self._face[1]
        # What the robot has turned since then is no doing of the operator: the filter must not delay it.
        if self._params.predict:
            before -= self._turned(self._face[1], at)
        filtered = before + (angle - before) * -math.expm1(-gap / self._params.filter_time)
        self._face = (filtered, at)
        self._interval = gap if self._interval == 0 else self._interval + 0.2 * (gap - self._interval)

    def lose(self) -> None:
        """Forget the operator: another one begins anew, and from a stand."""
        self._legs, self._face, self._interval = None, None, 0.0
        self._stands_first = True

    def step(self, now: float) -> Command:
        """What to do now [s]."""
        p = self._params
        dt = min(max(now - self._stepped_at, 0.0), _LONGEST_STEP) if self._stepped_at is not None else 0.0
        self._stepped_at = now
        state, share = self._state(now)
        linear = angular = 0.0
        if share > 0 and self._legs is not None and self._face is not None:
            linear = share * min(max(self._linear(self._legs, now), 0.0), p.max_linear)
            if state in (State.FOLLOWING, State.FACE_SLOW):
                angular = min(max(self._angular(self._face, now), -p.max_angular), p.max_angular)
        change = p.braking if linear < self._velocity.linear else p.acceleration
        self._velocity = Velocity(
            _towards(self._velocity.linear, linear, change * dt),
            _towards(self._velocity.angular, angular, p.angular_acceleration * dt),
        )
        if self._too_old(now):
            self._velocity = STANDSTILL  # no ramp: what was measured so long ago moves nothing
        while self._commands and now - self._commands[0][0] > _MEMORY:
            self._commands.popleft()
        self._commands.append((now, self._velocity))
        return Command(self._velocity, state)

    def _state(self, now: float) -> tuple[State, float]:
        """What is wrong, and the share of the speed that it leaves."""
        p = self._params
        if self._legs is None or self._face is None:
            return State.STANDING, 0.0
        self._stands_first = self._stands_first and self._velocity != STANDSTILL
        if self._stands_first or self._too_old(now) or abs(self._legs.off) > p.sharpest:
            return State.STANDING, 0.0
        legs, face = now - self._legs.at, now - self._face[1]
        worst = max(legs, face)
        share = min((p.stop_after - worst) / (p.stop_after - p.slow_after), 1.0)
        if share < 1:
            return (State.LEGS_LOST if legs >= face else State.FACE_LOST), share
        if self.face_rate < p.least_face_rate * 0.9:  # frames that come late are not fewer
            return State.FACE_SLOW, p.slow_share
        return State.FOLLOWING, 1.0

    def _too_old(self, now: float) -> bool:
        """Whether legs or face may be as old as the limit."""
        if self._legs is None or self._face is None:
            return False
        return now - min(self._legs.at, self._face[1]) + self.doubt >= self._params.stop_after

    def _linear(self, legs: _Legs, now: float) -> float:
        p = self._params
        distance, speed = legs.distance, legs.speed
        if p.predict:
            ahead = now - legs.at + self.lead
            way = sum(part * velocity.linear for part, velocity in self._acting(legs.at - self.lead, now))
            distance += way * math.cos(legs.off) - speed * ahead
        return (max(speed, 0.0) + p.distance_gain * (p.distance - distance)) * math.cos(legs.off)

    def _angular(self, face: tuple[float, float], now: float) -> float:
        p = self._params
        angle, at = face
        gain = p.steering_gain
        if p.predict:
            angle -= self._turned(at, now + self.lead)
            if at != self._counted_at:
                ahead = now + self.lead - at
                self._ahead = ahead if self._counted_at is None else self._ahead + 0.1 * (ahead - self._ahead)
                self._counted_at = at
            # As usual, not since this face: of one that is late nobody knows whether it stays aside. The filter counts
            # on, too.
            gain /= 1 - min(gain * (self._ahead + p.filter_time), _MOST_RAISED)
        return gain * math.copysign(max(abs(angle) - p.dead_band, 0.0), angle)

    def _turned(self, since: float, until: float) -> float:
        """What the robot turned between two times by its commands, which act `lead` after they are given [rad]."""
        return sum(part * velocity.angular for part, velocity in self._acting(since - self.lead, until - self.lead))

    def _acting(self, since: float, until: float) -> list[tuple[float, Velocity]]:
        """Commands given between two times, and for how long each held [s]; before the first one it stood."""
        found: list[tuple[float, Velocity]] = []
        end = until
        if end <= since:
            return found
        for begun, velocity in reversed(self._commands):
            if begun < end:
                found.append((end - max(begun, since), velocity))
                end = begun
            if end <= since:
                break
        return found


def _towards(value: float, goal: float, most: float) -> float:
    """One step of at most so much towards a goal."""
    return value + min(max(goal - value, -most), most)
