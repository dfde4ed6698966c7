"""Commissioning on simulated drives with made-up time: what is measured is what they do."""

import pytest
from rig_wheels import Drives

from skytether.guard.velocity import Velocity
from skytether.robot.control.supervisor import VelocityLimits
from skytether.robot.safety.commission.commission import Commission, CommissionError, Plan, Step, Stop, fit

LIMITS = VelocityLimits(linear_max=0.5, angular_max=1.0, linear_braking=1.0, angular_braking=2.0)
TURN = 0.01


class FakeRig:
    """Drives, odometry at every other turn, a button that a person presses when asked."""

    def __init__(self, drives: Drives) -> None:
        self.drives, self.time = drives, 100.0
        self.seen: list[tuple[float, Velocity]] = []
        self.on, self.button, self.turns = True, False, 0

    def now(self) -> float:
        return self.time

    def write_velocity(self, velocity: Velocity | None, seconds: float) -> None:
        for _ in range(max(1, round(seconds / TURN))):
            self.time += TURN
            self.turns += 1
            if velocity is not None:
                self.drives.write(velocity, self.time)
            self.drives.enable(self.on and not self.drives.high, self.time)
            self.drives.roll(self.time, TURN)
            if self.turns % 2:
                self.seen.append((self.time, self.drives.shown))

    def motion(self, since: float) -> list[tuple[float, Velocity]]:
        return [(at, velocity) for at, velocity in self.seen if at >= since]

    def pressed(self) -> bool | None:
        return self.button

    def power(self, on: bool) -> None:
        self.on = on


class Person:
    """Says yes, and does what it is told."""

    def __init__(self, rig: FakeRig, *answers: bool, obeys: bool = True) -> None:
        self.rig, self.answers, self.asked, self.obeys = rig, list(answers), [], obeys

    def answer(self, question: str) -> bool:
        self.asked.append(question)
        return self.answers.pop(0) if self.answers else True

    def hear(self, sentence: str) -> None:
        if self.obeys:
            self.rig.button = "press" in sentence.split()


def bench(
    drives: Drives, *answers: bool, obeys: bool = True, limits: VelocityLimits = LIMITS
) -> tuple[Commission, Person]:
    rig = FakeRig(drives)
    person = Person(rig, *answers, obeys=obeys)
    plan = Plan(limits, 0.2, Velocity(0.02, 0.05), button=True, enable=drives.enable_s is not None)
    return Commission(plan, rig, person.answer, person.hear), person


def done(drives: Drives, step: str, *answers: bool, **more: bool) -> Step:
    work, _ = bench(drives, *answers, **more)
    return work.steps()[step]()


def test_braking_from_two_speeds_is_solved():
    # 0.2 s and 0.8 m/s^2: from 0.25 m/s 0.05 + 0.0390625 m, from 0.5 m/s 0.1 + 0.15625 m.
    reaction, braking = fit(Stop(0.25, 0.0890625, 0.5), Stop(0.5, 0.25625, 0.8), 5.0)
    assert (reaction, braking) == (pytest.approx(0.2), pytest.approx(0.8))


def test_braking_that_cannot_be_told_from_a_lag_is_not_believed_to_be_endless():
    # A first-order lag of 0.2 s: the way is 0.2 v at every speed.
    reaction, braking = fit(Stop(0.25, 0.05, 0.5), Stop(0.5, 0.1, 0.5), 5.0)
    assert braking == 5.0
    assert 0.1 < reaction <= 0.2


def test_what_the_drives_do_is_measured_and_proposed_with_room():
    work, _ = bench(Drives(braking=Velocity(0.8, 1.5), dead_s=0.1))
    step = work.steps()["braking"]()
    assert step.measured["braking_m_s2"] == pytest.approx(0.8, rel=0.15)
    assert step.measured["reaction_s"] == pytest.approx(0.1, abs=0.06)
    assert work.proposal["limits.linear_braking"] == pytest.approx(0.8 * step.measured["braking_m_s2"], abs=0.01)
    turning = work.steps()["turning"]()
    assert turning.measured["braking_rad_s2"] == pytest.approx(1.5, rel=0.15)
    reactions = (step.measured["reaction_s"], turning.measured["reaction_s"])
    assert work.proposal["zones.reaction_s"] == pytest.approx(1.2 * max(reactions), abs=0.002)


@pytest.mark.parametrize(("braking", "dead", "ok"), [(1.2, 0.1, True), (0.5, 0.1, False), (1.2, 0.5, False)])
def test_braking_that_is_weaker_or_later_than_configured_fails(braking, dead, ok):
    step = done(Drives(braking=Velocity(braking, 3.0), dead_s=dead), "braking")
    assert step.ok is ok
    assert ("configure what is proposed" in step.says) is not ok


def test_a_watchdog_is_found_and_how_soon_it_stops():
    step = done(Drives(watchdog_s=0.2), "watchdog")
    assert step.ok is True
    # 0.2 s of silence, then 0.15 m/s at 1 m/s^2 until 0.02 m/s is left: 0.33 s.
    assert step.measured["stood_after_s"] == pytest.approx(0.33, abs=0.05)
    assert step.measured["way_m"] == pytest.approx(0.2 * 0.15 + 0.011, abs=0.01)


def test_drives_without_a_watchdog_fail_and_are_stopped():
    drives = Drives(watchdog_s=None)
    step = done(drives, "watchdog")
    assert step.ok is False
    assert "need a watchdog" in step.says
    assert drives.velocity == (0.0, 0.0)


@pytest.mark.parametrize("turned", [Velocity(-1.0, 1.0), Velocity(1.0, -1.0), Velocity(0.5, 1.0), Velocity(1.0, 0.0)])
def test_an_axis_that_is_turned_or_has_another_scale_is_found(turned):
    step = done(Drives(turned=turned), "directions")
    assert step.ok is False
    assert "a sign, a scale, or an axis" in step.says


def test_what_the_person_saw_counts_as_well():
    assert done(Drives(), "directions").ok is True
    assert done(Drives(), "directions", True, False).ok is False


def test_the_button_is_heard_pressed_and_released():
    assert done(Drives(), "button").ok is True
    step = done(Drives(), "button", obeys=False)
    assert step.ok is False
    assert "press" in step.says


@pytest.mark.parametrize(("enable_s", "ok"), [(0.1, True), (1e9, False), (None, None)])
def test_without_the_enable_signal_the_wheels_stand(enable_s, ok):
    drives = Drives(enable_s=enable_s)
    if enable_s == 1e9:  # the signal is looked at by nobody
        drives.edge_at = 100.0
    assert done(drives, "power").ok is ok


@pytest.mark.parametrize("name", ["button", "directions", "watchdog", "braking", "turning", "power"])
def test_nothing_moves_before_the_person_says_yes(name):
    drives = Drives(enable_s=0.1)
    work, person = bench(drives, False)
    assert work.steps()[name]().ok is None
    assert len(person.asked) == 1
    assert len(drives.told) == 1  # nothing was told


def test_a_robot_that_does_not_stop_ends_all():
    class Runaway(Drives):
        def roll(self, now: float, dt: float) -> None:
            self.velocity = Velocity(0.15, 0.0)

    with pytest.raises(CommissionError, match="cut the power"):
        done(Runaway(), "directions")
