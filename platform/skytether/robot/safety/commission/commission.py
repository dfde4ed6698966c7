"""Commissioning: what the wheels, their own watchdog, the button and the power really do, measured step by step.

The gate is not there while this is done, and no sensor looks where the robot goes: a person does, with a hand on the
button. Time and hardware are behind `Rig`. The two equations of braking are those of docs/safety.md.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from math import inf, isfinite
from typing import Any, Protocol

from skytether.guard.velocity import STANDSTILL, Velocity
from skytether.robot.control.supervisor import VelocityLimits

BRAKING_SHARE, REACTION_SHARE = 0.8, 1.2
"""What is left of the measured braking, and made of the measured time: worn wheels, a load, a wet floor."""
_SLOW = Velocity(0.15, 0.4)
"""Fast enough to be told apart from noise, slow enough to be stepped aside from [m/s, rad/s]."""
_STEADY_S = 1.0
"""How long a velocity is told before something is measured."""
_PATIENCE_S = 3.0
"""A robot that still moves so long after is told to stop, and the step has failed."""
_STOOD_S = 0.2
"""Readings of a standstill for so long are one."""
_PERSON_S = 60.0
"""For a person to press a button."""
_STRONGEST = Velocity(5.0, 20.0)
"""Braking beyond it is not believed: the readings are too coarse to tell [m/s^2, rad/s^2]."""
_DIVERGENCE = 0.2
"""Of the measured velocity from the told one."""


class CommissionError(Exception):
    """It cannot go on; the text says why."""


class Rig(Protocol):
    """The hardware, and the time."""

    def now(self) -> float:
        """Seconds."""
        ...

    def write_velocity(self, velocity: Velocity | None, seconds: float) -> None:
        """Tell the wheels a velocity, again and again, for so long; None: tell them nothing.

        Raises:
            CommissionError: The button is pressed or silent, the odometry is silent, the wheels cannot be told.
        """
        ...

    def motion(self, since: float) -> Sequence[tuple[float, Velocity]]:
        """Measured velocities, and when they came."""
        ...

    def pressed(self) -> bool | None:
        """The button; None: it is not heard."""
        ...

    def power(self, on: bool) -> None:
        """Let the enable signal change, or not."""
        ...


@dataclass(frozen=True, slots=True)
class Plan:
    """What is there, as configured.

    Attributes:
        limits: Of the wheels.
        reaction_s: `zones.reaction_s`.
        tolerance: Below it a reading is a standstill [m/s, rad/s].
        button: Whether there is an emergency stop button.
        enable: Whether there is an enable signal.
    """

    limits: VelocityLimits
    reaction_s: float
    tolerance: Velocity
    button: bool
    enable: bool


@dataclass(frozen=True, slots=True)
class Step:
    """One step.

    Attributes:
        name: Of the step.
        ok: True, False, or None: it was left out.
        says: For people.
        measured: Numbers, with their units in their names.
    """

    name: str
    ok: bool | None
    says: str
    measured: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Stop:
    """A braking that was measured on one axis, from the word to the standstill.

    Attributes:
        speed: Before it [m/s, rad/s].
        way: [m, rad]
        seconds: How long it took.
    """

    speed: float
    way: float
    seconds: float


class Commission:
    """The steps.

    Args:
        plan: What is there.
        rig: The hardware.
        ask: Puts a question to the person; True: yes.
        tell: Shows a sentence.
    """

    def __init__(self, plan: Plan, rig: Rig, ask: Callable[[str], bool], tell: Callable[[str], object]) -> None:
        self._plan = plan
        self._rig = rig
        self._ask = ask
        self._tell = tell
        self.proposal: dict[str, float] = {}
        """Keys of robot.yaml and what they should be."""

    def steps(self) -> Mapping[str, Callable[[], Step]]:
        """By name, in the order in which they are to be done."""
        return {
            "button": self.button,
            "directions": self.directions,
            "watchdog": self.watchdog,
            "braking": lambda: self.braking(0),
            "turning": lambda: self.braking(1),
            "power": self.power,
        }

    def button(self) -> Step:
        """Whether the emergency stop button is heard, pressed and released."""
        if not self._plan.button:
            return Step("button", None, "there is no button: safety.estop is not configured")
        if not self._ask("Does somebody stand at the emergency stop button?"):
            return _left_out("button")
        for pressed, word in ((True, "press"), (False, "release")):
            self._tell(f"now {word} the emergency stop button")
            if not self._wait_for_button(pressed=pressed):
                return Step("button", False, f"somebody was to {word} it; that was not heard within {_PERSON_S:g} s")
        return Step("button", True, "it was heard pressed, and heard released")

    def directions(self) -> Step:
        """Whether forward is forward and left is left, for the wheels and for the odometry."""
        speed = self._slow()
        if not self._ask(f"Drive forward at {speed.linear:g} m/s, then turn left at {speed.angular:g} rad/s?"):
            return _left_out("directions")
        measured = {}
        for axis, name, told in ((0, "linear_m_s", speed.linear), (1, "angular_rad_s", speed.angular)):
            found = self._steady(axis, told)
            self._halt()
            measured[f"told_{name}"], measured[f"measured_{name}"] = told, round(found, 3)
        ok = all(
            abs(measured[f"measured_{name}"] - measured[f"told_{name}"]) <= self._off(axis, measured[f"told_{name}"])
            for axis, name in enumerate(("linear_m_s", "angular_rad_s"))
        )
        if not ok:
            return Step(
                "directions", False, "the odometry does not show what was told: a sign, a scale, or an axis", measured
            )
        seen = self._ask("Did it really drive forward, and then turn to its left?")
        says = (
            "as told, measured and seen"
            if seen
            else "the odometry shows what was told, but the person saw another thing"
        )
        return Step("directions", seen, says, measured | {"seen": seen})

    def watchdog(self) -> Step:
        """Whether the drives stop by themselves when nobody tells them anything."""
        speed = self._slow().linear
        if not self._ask(f"Drive at {speed:g} m/s and then say nothing more, for {_PATIENCE_S:g} s at most?"):
            return _left_out("watchdog")
        self._steady(0, speed)
        since = self._rig.now()
        self._rig.write_velocity(None, _PATIENCE_S)
        stood = self._stood_at(since, 0)
        self._halt()
        if stood is None:
            says = f"it drove on for {_PATIENCE_S:g} s without a word: the drives need a watchdog of some 100 ms"
            return Step("watchdog", False, says, {"speed_m_s": speed})
        seconds = stood - since
        way = _way(self._rig.motion(since), since, stood, 0)
        measured = {"speed_m_s": speed, "stood_after_s": round(seconds, 3), "way_m": round(way, 3)}
        return Step("watchdog", True, f"it stood {seconds:.2f} s after the last word", measured)

    def braking(self, axis: int) -> Step:
        """Braking and reaction of one axis, from full and from half speed; what should be configured."""
        name, unit = (("braking", "m"), ("turning", "rad"))[axis]
        limits = self._plan.limits
        full = (limits.linear_max, limits.angular_max)[axis]
        verb = "Drive" if axis == 0 else "Turn"
        question = f"{verb} at {full / 2:g} and at {full:g} {unit}/s and stop; {self._room(axis, full)}?"
        if not self._ask(question):
            return _left_out(name)
        half, fast = self._stop_from(axis, full / 2), self._stop_from(axis, full)
        if half is None or fast is None:
            return Step(name, False, f"it did not stand {_PATIENCE_S:g} s after it was told to stop")
        reaction, strength = fit(half, fast, _STRONGEST[axis])
        configured = (limits.linear_braking, limits.angular_braking)[axis]
        needed = [s.speed * self._plan.reaction_s + s.speed**2 / (2 * configured) for s in (half, fast)]
        measured = {
            f"way_from_half_{unit}": round(half.way, 3),
            f"way_from_full_{unit}": round(fast.way, 3),
            "reaction_s": round(reaction, 3),
            f"braking_{unit}_s2": round(strength, 3),
        }
        self.proposal[f"limits.{'linear' if axis == 0 else 'angular'}_braking"] = round(BRAKING_SHARE * strength, 2)
        worst = max(self.proposal.get("zones.reaction_s", 0.0), round(REACTION_SHARE * reaction, 3))
        self.proposal["zones.reaction_s"] = worst
        if all(s.way <= most for s, most in zip((half, fast), needed, strict=True)):
            return Step(name, True, f"it stops in {fast.way:.2f} {unit}; the zones count on {needed[1]:.2f}", measured)
        says = (
            f"it needs {half.way:.2f} and {fast.way:.2f} {unit}; the zones count on {needed[0]:.2f} and {needed[1]:.2f}"
        )
        return Step(name, False, f"{says}: configure what is proposed", measured)

    def power(self) -> Step:
        """Whether the wheels do nothing without the enable signal, whatever they are told."""
        if not self._plan.enable:
            return Step("power", None, "there is no enable signal: safety.enable is not configured")
        speed = self._slow().linear
        if not self._ask(f"Take the enable signal away, and then tell the wheels {speed:g} m/s for a second?"):
            return _left_out("power")
        self._steady(0, speed)
        self._halt()
        self._rig.power(False)
        try:
            self._rig.write_velocity(STANDSTILL, 1.0)
            since = self._rig.now()
            self._rig.write_velocity(Velocity(speed, 0.0), _STEADY_S)
            fastest = max((abs(v.linear) for _, v in self._rig.motion(since)), default=inf)
        finally:
            self._rig.write_velocity(STANDSTILL, 0.2)
            self._rig.power(True)
        ok = fastest <= self._plan.tolerance.linear
        says = (
            "without the signal the wheels stand, whatever they are told"
            if ok
            else "the wheels turn without the signal"
        )
        return Step("power", ok, says, {"fastest_m_s": round(fastest, 3) if isfinite(fastest) else None})

    def _slow(self) -> Velocity:
        limits = self._plan.limits
        return Velocity(min(_SLOW.linear, limits.linear_max), min(_SLOW.angular, limits.angular_max))

    def _off(self, axis: int, told: float) -> float:
        return self._plan.tolerance[axis] + _DIVERGENCE * abs(told)

    def _room(self, axis: int, full: float) -> str:
        if axis == 1:
            return "does nothing stand in the way of its corners"
        limits = self._plan.limits
        way = 2 * full * _STEADY_S + full**2 / limits.linear_acceleration + 2 * full * self._plan.reaction_s
        return f"are {way + full**2 / limits.linear_braking + 1:.1f} m ahead of it free"

    def _steady(self, axis: int, speed: float) -> float:
        """Ramp up to a velocity and hold it; the mean of what was measured at its end."""
        self._rig.write_velocity(STANDSTILL, _WAKE_S)
        limits = self._plan.limits
        rate = (limits.linear_acceleration, limits.angular_acceleration)[axis]
        ramp = max(1, round(speed / rate / _RAMP_S))
        for k in range(1, ramp + 1):
            self._rig.write_velocity(_along(axis, speed * k / ramp), _RAMP_S)
        self._rig.write_velocity(_along(axis, speed), _STEADY_S)
        late = self._rig.motion(self._rig.now() - _STEADY_S / 2)
        if not late:
            raise CommissionError("the odometry was not heard while the robot drove")
        return sum(velocity[axis] for _, velocity in late) / len(late)

    def _halt(self) -> None:
        """Tell a standstill until there is one.

        Raises:
            CommissionError: There is none.
        """
        since = self._rig.now()
        while self._stood_at(since, 0) is None or self._stood_at(since, 1) is None:
            if self._rig.now() - since > _PATIENCE_S:
                raise CommissionError(
                    f"the robot still moves {_PATIENCE_S:g} s after it was told to stand: cut the power"
                )
            self._rig.write_velocity(STANDSTILL, 0.1)

    def _stop_from(self, axis: int, speed: float) -> Stop | None:
        """Braking from a velocity: the word comes at once, as in an emergency."""
        real = self._steady(axis, speed)
        since = self._rig.now()
        while (stood := self._stood_at(since, axis)) is None and self._rig.now() - since <= _PATIENCE_S:
            self._rig.write_velocity(STANDSTILL, 0.1)
        if stood is None:
            return None
        return Stop(abs(real), _way(self._rig.motion(since), since, stood, axis), stood - since)

    def _stood_at(self, since: float, axis: int) -> float | None:
        """When the standstill began that lasts until now; None: there is none, or it is too short to tell."""
        began: float | None = None
        last = since
        for at, velocity in self._rig.motion(since):
            stands = abs(velocity[axis]) <= self._plan.tolerance[axis]
            began = (began if began is not None else at) if stands else None
            last = at
        return began if began is not None and last - began >= _STOOD_S else None

    def _wait_for_button(self, *, pressed: bool) -> bool:
        end = self._rig.now() + _PERSON_S
        while self._rig.pressed() is not pressed:
            if self._rig.now() > end:
                return False
            self._rig.write_velocity(None, 0.05)
        return True


_RAMP_S = 0.05
"""Between two steps of the ramp up."""
_WAKE_S = 0.5
"""For drives that nobody spoke to while the person was asked, and for their power to come back."""


def fit(half: Stop, full: Stop, strongest: float) -> tuple[float, float]:
    """Reaction [s] and braking [m/s^2 or rad/s^2] from two brakings: way = v reaction + v^2 / (2 braking)."""
    slope = (full.way / full.speed - half.way / half.speed) / (full.speed - half.speed)
    slope = max(slope, 1 / (2 * strongest))  # a lag that is the same at every speed, or noise: no braking is better
    reaction = max(full.way / full.speed - slope * full.speed, half.way / half.speed - slope * half.speed, 0.0)
    return reaction, 1 / (2 * slope)


def _way(motion: Sequence[tuple[float, Velocity]], since: float, until: float, axis: int) -> float:
    """How far it went, from readings that hold until the next one."""
    way, before, speed = 0.0, since, None
    for at, velocity in motion:
        if at > until:
            break
        way += (at - before) * (abs(velocity[axis]) if speed is None else speed)
        before, speed = at, abs(velocity[axis])
    return way


def _along(axis: int, speed: float) -> Velocity:
    return Velocity(speed, 0.0) if axis == 0 else Velocity(0.0, speed)


def _left_out(name: str) -> Step:
    return Step(name, None, "left out by the person")
