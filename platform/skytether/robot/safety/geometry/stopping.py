"""The one inequality that keeps the robot out of things, and every latency in it. Pure, standard library only.

**What must hold.** At every turn of the gate, for the velocity v that it tells the wheels next:

    v (sensing + age + hold + wheels) + v^2 / (2 a)  <=  way

with ``way`` the metres, along the curve that v is on, until something that is seen, or the end of what is seen,
gets into the stop zone. All metres are those of the outermost corner. A curve is left by scaling both axes down
together, so v / a is the time 1 / d in which the slower axis can brake (`kinematics.slowdown`).

**Why.** The scan shows the world as it was ``sensing + age`` before the decision: ``sensing`` from the light to the
message at the gate, ``age`` since then. While the message aged the robot went on as it was told, on other curves
maybe: the points are moved by that (`dead_reckoning`), and the inequality is then asked for with no age. The wheels
feel what is decided now up to ``wheels`` later (the drives' dead time). ``sensing + writer + wheels`` is the time by
which their real motion may lag behind the told one; the stop zone is larger by what that can make wrong. What is
decided is then held for ``hold`` at most before the brakes are told:

- The gate's next turn may brake, a period later; but the gate may hang. The guard brakes once the gate's word is
  older than ``guard``, and may be up to two periods late: ``hold = guard + 2 period + writer``. A
  gate that hangs for less than ``guard`` and goes on is no worse: its next turn comes within ``hold``.
- ``writer`` is the process between guard and wheels where the wheels are on a graph, which may be a period late, too.

From then on the told velocity falls by ``a dt`` at every turn, where ``dt`` is the time since the turn before. This
staircase is never above the straight line v - a (t - hold): the step that is held longest belongs to the turn that
came latest, and that turn is in ``hold``. It is so at every rate and with every jitter *as long as dt is not cut
short*; therefore a turn counts for all its time up to ``guard`` (`Stages.longest_step_s`), beyond which the guard
has taken over, and who tells the wheels says nothing old again while the gate is no more than a period late
(`skytether.guard.teller.repeat_s`). So the way until the standstill is at most
v (sensing + age + hold + wheels) + v^2 / (2 a).

At the next turn either the same holds for the velocity then wanted, or the gate goes on braking on the old curve,
for which it held. One of gate, guard and writer may hang at a time; drives that hear nothing must stop by
themselves.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt


@dataclass(frozen=True, slots=True)
class Stages:
    """The latency of each stage from the light to the brakes [s], at worst.

    Attributes:
        sensing_s: From the light to the message at the gate; a rotating laser's turn belongs to it.
        period_s: Of the loops of gate and guard.
        guard_s: Patience of gate and guard with each other.
        writer_s: Of the process that writes to a graph; 0: the guard writes itself.
        wheels_s: From a velocity that is written to its first effect.
    """

    sensing_s: float = 0.05
    period_s: float = 0.02
    guard_s: float = 0.1
    writer_s: float = 0.0
    wheels_s: float = 0.1

    @property
    def hold_s(self) -> float:
        """How long a velocity may be told after it was decided before the brakes are told."""
        return self.guard_s + 2 * self.period_s + self.writer_s

    @property
    def longest_step_s(self) -> float:
        """The longest turn that counts in full; what lasts longer is a stall, in which the guard brakes."""
        return self.guard_s

    @property
    def late_s(self) -> float:
        """How much later than told the wheels may have moved, counted from a scan's message: nobody knows how much."""
        return self.sensing_s + self.writer_s + self.wheels_s

    def reaction_s(self, age: float) -> float:
        """From the light to the first effect of the brakes, at worst, with a message of this age at the gate."""
        return self.sensing_s + age + self.hold_s + self.wheels_s


def stopping_way(speed: float, braking: float, reaction: float) -> float:
    """How far the robot gets until it stands [m]."""
    return speed * reaction + speed**2 / (2 * braking)


def fastest(way: float, braking: float, reaction: float) -> float:
    """The speed [m/s] whose `stopping_way` is this long; 0 where there is none."""
    if way <= 0:
        return 0.0
    return braking * (sqrt(reaction**2 + 2 * way / braking) - reaction)


def shortfall(stages: Stages, speed: float, braking: float, age: float, way: float) -> str:
    """What is missing to stop on a way; empty: nothing.

    Args:
        stages: All latencies.
        speed: The fastest [m/s].
        braking: [m/s^2].
        age: The oldest message that is used [s].
        way: Until the stop zone [m].
    """
    reaction = stages.reaction_s(age)
    needed = stopping_way(speed, braking, reaction)
    if needed <= way:
        return ""
    # Of a speed, the time that is left for everything before the brakes is way / v - v / (2 a).
    left = way / speed - speed / (2 * braking)
    harder = speed**2 / (2 * (way - speed * reaction)) if way > speed * reaction else 0.0
    held = [f"{fastest(way, braking, reaction):.2f} m/s"]
    if harder:
        held.append(f"a braking of {harder:.2f} m/s^2")
    if left > 0:
        held.append(f"{left:.2f} s until the brakes")
    return (
        f"at {speed:g} m/s the robot needs {needed:.2f} m to stop ({reaction:.2f} s until the brakes, then {braking:g} "
        f"m/s^2), and has {way:.2f} m; {' or '.join(held)} would hold"
    )
