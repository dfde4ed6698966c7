"""Simulated wheels beside what they were told: no false alarm within the configured lag, and each fault in time."""

import math
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from played_wheels import Wheels, odometry

from skytether.guard.velocity import STANDSTILL, Velocity
from skytether.messages import Bool, Header, Time, Twist, TwistStamped, Vector3
from skytether.robot.control.supervisor import VelocityLimits
from skytether.robot.safety.rules.motion import Fault, Motion, MotionEstimate, MotionParams
from skytether.robot.safety.sensing.stamps import StampRule

LIMITS = VelocityLimits(linear_max=0.5, linear_min=-0.2, angular_max=1.0)
PARAMS = MotionParams()
TURN, READING = 0.02, 0.05


class Bench:
    def __init__(self, wheels: Wheels, params: MotionParams = PARAMS) -> None:
        self.motion = Motion(params, LIMITS, gap_s=0.1)
        self.wheels, self.now, self.turns = wheels, 100.0, 0
        self.faults: list[tuple[float, Fault, str]] = []
        self.seen = MotionEstimate(None)

    def drive(self, velocity: Velocity, seconds: float) -> None:
        for _ in range(round(seconds / TURN)):
            self.now += TURN
            self.turns += 1
            self.motion.told(velocity, self.now)
            self.wheels.write(velocity, self.now)
            self.wheels.roll(self.now, TURN)
            if self.turns % round(READING / TURN) == 0:
                self.motion.measure(odometry(*self.wheels.reading(self.now), self.now), self.now)
            self.seen = self.motion.estimate(self.now)
            if self.seen.fault:
                self.faults.append((self.now, self.seen.fault, self.seen.detail))


commanded = st.lists(
    st.tuples(st.floats(-0.2, 0.5), st.floats(-1.0, 1.0), st.sampled_from([0.02, 0.1, 0.5, 1.5])), max_size=25
)


@settings(max_examples=80, deadline=None)
@given(
    commanded,
    st.floats(0, PARAMS.dead_s),
    st.floats(0, PARAMS.lag_s),
    st.floats(0, PARAMS.latency_s),
    st.integers(0, 1000),
)
def test_wheels_that_follow_as_configured_are_never_called_broken(legs, dead, lag, latency, seed):
    """Whatever they are told, jumps between both ends of the range included."""
    bench = Bench(Wheels(dead, lag, latency, 0.8, seed))
    for linear, angular, seconds in legs:
        bench.drive(Velocity(linear, angular), seconds)
    bench.drive(STANDSTILL, 2.0)
    assert bench.faults == []


def test_a_lag_or_a_latency_beyond_the_configured_is_seen():
    """The tolerance is no blank cheque: wheels three times as late brake too late."""
    bench = Bench(Wheels(dead_s=3 * PARAMS.window_s))
    bench.drive(STANDSTILL, 2.0)
    bench.drive(Velocity(0.5, 0.0), 5.0)
    bench.drive(STANDSTILL, 5.0)
    assert bench.faults


BOUND_S = PARAMS.window_s + PARAMS.confirm_s + 3 * READING


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize(
    ("before", "fault", "after", "kind", "within"),
    [
        # Full speed, whatever is told.
        (Velocity(0.2, 0.0), lambda _: Velocity(0.5, 0.0), Velocity(0.2, 0.0), Fault.RUNAWAY, BOUND_S),
        # A sign is wrong.
        (Velocity(0.3, 0.0), lambda v: Velocity(-v.linear, v.angular), Velocity(0.3, 0.0), Fault.RUNAWAY, BOUND_S),
        (Velocity(0.0, 0.6), lambda v: Velocity(v.linear, -v.angular), Velocity(0.0, 0.6), Fault.RUNAWAY, BOUND_S),
        # One wheel runs away: it turns.
        (Velocity(0.2, 0.0), lambda v: Velocity(v.linear, 0.6), Velocity(0.2, 0.0), Fault.RUNAWAY, BOUND_S),
        # The brakes do nothing.
        (Velocity(0.4, 0.0), lambda _: Velocity(0.4, 0.0), STANDSTILL, Fault.BRAKING, BOUND_S),
        (Velocity(0.0, -0.7), lambda _: Velocity(0.0, -0.7), STANDSTILL, Fault.BRAKING, BOUND_S),
        # It stood, and goes.
        (STANDSTILL, lambda _: Velocity(0.15, 0.0), STANDSTILL, Fault.MOVES, BOUND_S),
        (STANDSTILL, lambda _: Velocity(0.0, 0.4), STANDSTILL, Fault.MOVES, BOUND_S),
        # A wheel is blocked.
        (Velocity(0.4, 0.0), lambda _: STANDSTILL, Velocity(0.4, 0.0), Fault.BLOCKED, BOUND_S + PARAMS.blocked_s),
        (STANDSTILL, lambda _: STANDSTILL, Velocity(0.0, 0.8), Fault.BLOCKED, BOUND_S + PARAMS.blocked_s),
    ],
)
def test_each_fault_is_found_in_time_and_named(before, fault, after, kind, within, seed):
    bench = Bench(Wheels(noise=0.3, seed=seed))
    bench.drive(before, 3.0)
    assert bench.faults == []
    began, bench.wheels.fault = bench.now, fault
    bench.drive(after, 4.0)
    at, found, detail = bench.faults[0]
    assert found is kind
    assert at - began <= within
    assert "was told" in detail


def test_a_slope_slows_the_wheels_and_is_no_fault():
    bench = Bench(Wheels(fault=lambda v: Velocity(0.6 * v.linear, v.angular)))
    bench.drive(Velocity(0.4, 0.0), 5.0)
    assert bench.faults == []


def test_a_gap_counts_as_standstill_and_as_what_was_told():
    """The gate was frozen for a second: the guard braked, when exactly is not known."""
    bench = Bench(Wheels())
    bench.drive(Velocity(0.4, 0.0), 3.0)
    bench.now += 1.0
    bench.wheels.velocity = STANDSTILL
    bench.wheels.told.append((bench.now - 0.9, STANDSTILL))
    bench.wheels.shown.append((bench.now - 0.5, STANDSTILL))
    bench.drive(Velocity(0.4, 0.0), 3.0)
    assert bench.faults == []


def test_a_reading_that_comes_first_after_a_long_pause_is_not_judged():
    bench = Bench(Wheels(noise=0.0))
    bench.drive(Velocity(0.4, 0.0), 3.0)
    for pause in (5.0, 1e6, math.inf, math.nan):
        assert bench.motion.measure(odometry(0.0, 0.0, 5.0 + bench.turns), bench.now + pause) == ""
        bench.turns += 1
    assert bench.motion.estimate(bench.now).fault is None


wild = st.one_of(st.floats(), st.sampled_from([0.0, 0.02, 0.2, math.nan, math.inf, -math.inf, 1e308]))


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.sampled_from(["told", "measure", "estimate"]), wild, wild, wild), max_size=60))
def test_whatever_comes_and_whatever_the_clock_does_nothing_is_raised(events):
    motion, now = Motion(PARAMS, LIMITS, 0.1), 10.0
    for k, (what, first, second, dt) in enumerate(events):
        now = now + dt if math.isfinite(now) else 10.0
        if what == "told":
            motion.told(Velocity(0.2, 0.0) if k % 2 else STANDSTILL, now)
        elif what == "measure":
            motion.measure(odometry(first, second, float(k)), now)
        else:
            motion.estimate(now)


def test_one_reading_outside_is_no_fault():
    bench = Bench(Wheels(noise=0.0))
    bench.drive(STANDSTILL, 2.0)
    for _ in range(20):
        bench.motion.measure(odometry(0.4, 0.0, bench.now + 0.01), bench.now)
        bench.drive(STANDSTILL, 0.14)
    assert bench.faults == []


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_what_is_no_number_is_not_known(bad):
    bench = Bench(Wheels())
    bench.drive(STANDSTILL, 1.0)
    bench.motion.measure(odometry(bad, 0.0, bench.now + 0.01), bench.now)
    seen = bench.motion.estimate(bench.now)
    assert seen.measured is None
    assert "no number" in seen.unknown


def test_silence_and_the_same_reading_again_are_not_known():
    motion = Motion(PARAMS, LIMITS, 0.1)
    assert "nothing has come" in motion.estimate(1.0).unknown
    assert motion.measure(odometry(0.1, 0.0, 5.0), 1.0) == ""
    assert motion.estimate(1.1).measured == Velocity(0.1, 0.0)
    assert "same reading" in motion.measure(odometry(0.1, 0.0, 5.0), 1.3)
    assert "silent for 0.4 s" in motion.estimate(1.4).unknown
    assert motion.estimate(math.nan).unknown
    assert motion.estimate(-50.0).unknown


@pytest.mark.parametrize(
    ("stamps", "wrong"),
    [
        (lambda turn: 50.0 + turn % 2, "older"),  # a driver that sends two readings in turn
        (lambda turn: 50.0 - turn / 10, "older"),
        (lambda turn: 0.0 if turn else 50.0, "without a stamp"),
    ],
)
def test_readings_that_are_not_newer_are_silence_and_hide_no_runaway(stamps, wrong):
    motion, now = Motion(PARAMS, LIMITS, 0.1), 100.0
    for turn in range(200):
        now += READING
        motion.told(Velocity(0.2, 0.0), now)
        said = motion.measure(odometry(0.2, 0.0, stamps(turn)), now)
        if turn > 1:
            assert wrong in said or "same reading" in said
    assert "is silent" in motion.estimate(now).unknown


def test_readings_that_begin_to_come_late_are_as_old_as_they_are():
    for stamps, known in [(StampRule.AUTO, False), (StampRule.ORDER, True)]:
        motion, now = Motion(replace(PARAMS, stamps=stamps), LIMITS, 0.1), 100.0
        for turn in range(100):
            now += READING
            late = min(2.0, READING / 2 * max(0, turn - 20))
            assert motion.measure(odometry(0.2, 0.0, 5000 + now - late), now) == ""
            if turn == 25:
                assert motion.estimate(now).measured, "what is a little late is known"
        seen = motion.estimate(now)
        assert (not seen.unknown) is known
        if not known:
            assert "s late by its stamp" in seen.unknown
            motion.relearn()
            motion.measure(odometry(0.2, 0.0, 5000 + now), now + 2.0)
            assert motion.estimate(now + 2.0).measured, "a person has looked at the robot"


def test_readings_that_are_late_from_the_first_are_as_old_as_they_are_by_our_own_clock():
    for stamps, known in [(StampRule.AUTO, True), (StampRule.OWN, False)]:
        motion, now = Motion(replace(PARAMS, stamps=stamps), LIMITS, 0.1), 100.0
        for _ in range(20):
            now += READING
            assert motion.measure(odometry(0.2, 0.0, 5000 + now - 0.5), now, 5000 + now) == ""
        seen = motion.estimate(now)
        assert (not seen.unknown) is known
    assert "0.5 s late by its stamp" in seen.unknown
    assert "ahead of this computer's clock" in motion.measure(odometry(0.2, 0.0, 5001 + now), now, 5000 + now)


def test_a_reading_that_is_stale_is_no_fault_of_the_wheels():
    motion, now = Motion(PARAMS, LIMITS, 0.1), 100.0
    for turn in range(400):
        now += READING
        motion.told(Velocity(0.2, 0.0) if turn < 100 else STANDSTILL, now)
        late = 3.0 if turn > 100 else 0.0
        if turn != 101 and (turn <= 100 or turn > 101 + 3.0 / READING):
            motion.measure(odometry(0.2, 0.0, now - late), now)
        assert motion.estimate(now).fault is None


def test_a_clock_of_the_readings_that_is_set_back_is_believed_again_after_a_second():
    motion, now = Motion(PARAMS, LIMITS, 0.1), 100.0
    known = []
    for turn in range(100):
        now += READING
        motion.measure(odometry(0.2, 0.0, now - (50.0 if turn > 20 else 0.0)), now)
        known.append(not motion.estimate(now).unknown)
    assert known[:21] == [True] * 21
    lost = known.index(False)
    assert 1.0 <= (known.index(True, lost) - 21) * READING <= 1.2
    assert all(known[known.index(True, lost) :])


def test_the_drives_own_velocity_will_do():
    motion = Motion(PARAMS, LIMITS, 0.1)
    twist = Twist(linear=Vector3(x=0.2), angular=Vector3(z=0.1))
    for message in (twist, TwistStamped(header=Header(stamp=Time(sec=1)), twist=twist)):
        assert motion.measure(message, 1.0) == ""
        assert motion.estimate(1.0).measured == (0.2, 0.1)
    assert "no odometry" in motion.measure(Bool(), 1.0)


def test_a_clock_that_goes_back_forgets_what_was_told():
    bench = Bench(Wheels(noise=0.0))
    bench.drive(Velocity(0.4, 0.0), 3.0)
    bench.now -= 50.0
    bench.wheels = Wheels(noise=0.0)
    bench.drive(STANDSTILL, 3.0)
    assert bench.faults == []


def test_a_wider_window_is_slower_to_say_so():
    late = replace(PARAMS, lag_s=0.5)
    found = []
    for params in (PARAMS, late):
        bench = Bench(Wheels(noise=0.0), params)
        bench.drive(Velocity(0.4, 0.0), 3.0)
        began, bench.wheels.fault = bench.now, lambda _: Velocity(0.4, 0.0)
        bench.drive(STANDSTILL, 6.0)
        found.append(bench.faults[0][0] - began)
    assert found[1] - found[0] == pytest.approx(4 * 0.35, abs=2 * READING)
