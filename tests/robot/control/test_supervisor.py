import math
from dataclasses import replace
from math import inf, nan

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skytether.control.admittance import Velocity
from skytether.robot.control.command import Command, Source
from skytether.robot.control.supervisor import Objection, Supervised, VelocityLimits, admit, max_age, step

LIMITS = VelocityLimits()
MAX_AGE = 0.75
HALF = Command(Source.CLOUD, 0.125, 0.25, epoch=1, sequence=0, sent_at=-0.05, sent_at_error=0.05, received_at=0.0)

wild = st.one_of(
    st.floats(allow_nan=True, allow_infinity=True, width=64),
    st.sampled_from([0.0, -0.0, 5e-324, -5e-324, 1e308, -1e308, inf, -inf, nan, 0.25, 0.5]),
)
tame = st.floats(-1.0, 1.0)


def hold(command: Command, now: float = 0.0, state: Supervised | None = None) -> Supervised:
    state, objection = admit(LIMITS, state or Supervised(), command, MAX_AGE, now)
    assert objection is None
    return state


def drive(state: Supervised, start: float, ticks: int, charge: Source = Source.CLOUD) -> Supervised:
    for i in range(ticks):
        state, _ = step(LIMITS, state, charge, MAX_AGE, start + i * LIMITS.period_s)
    return state


def test_a_good_command_is_reached_at_the_allowed_acceleration():
    state, objections = step(LIMITS, hold(HALF), Source.CLOUD, MAX_AGE, 0.0)
    # The first step counts one period: 1 m/s^2 and 2 rad/s^2 over 10 ms.
    assert state.velocity == pytest.approx((0.01, 0.02))
    assert set(objections) == {Objection.LINEAR_ACCELERATION, Objection.ANGULAR_ACCELERATION}
    # 0.125 m/s at 1 m/s^2 and 0.25 rad/s at 2 rad/s^2: 13 ticks of 10 ms.
    assert drive(hold(HALF), 0.0, 13).velocity == pytest.approx((0.125, 0.25))


def test_a_command_is_repeated_until_too_old_and_then_braked_to_a_standstill():
    state = drive(hold(HALF), 0.0, 16)
    assert state.velocity == pytest.approx((0.125, 0.25))
    state, objections = step(LIMITS, state, Source.CLOUD, MAX_AGE, 0.16)
    assert objections == (Objection.GAP,)
    assert state.velocity == pytest.approx((0.105, 0.21))  # 2 m/s^2 and 4 rad/s^2 over 10 ms
    assert drive(state, 0.17, 6).velocity == (0.0, 0.0)


def test_the_other_sources_command_is_not_followed():
    state, objections = step(LIMITS, hold(HALF), Source.FALLBACK, MAX_AGE, 0.0)
    assert (state.velocity, objections) == ((0.0, 0.0), (Objection.NO_COMMAND,))
    state, objections = step(LIMITS, hold(HALF), Source.STOP, MAX_AGE, 0.0)
    assert (state.velocity, objections) == ((0.0, 0.0), (Objection.NO_COMMAND,))


@pytest.mark.parametrize(
    ("change", "objection"),
    [
        ({"linear": nan}, Objection.NOT_FINITE),
        ({"angular": -inf}, Objection.NOT_FINITE),
        ({"unused": nan}, Objection.NOT_FINITE),
        ({"unused": 0.01}, Objection.UNUSED_AXES),
        ({"sent_at_error": inf}, Objection.CLOCK),
        ({"sent_at_error": nan}, Objection.CLOCK),
        ({"sent_at_error": -1.0}, Objection.CLOCK),
        ({"received_at": nan}, Objection.CLOCK),
        ({"received_at": 0.02}, Objection.FUTURE),
        ({"sent_at": 0.07}, Objection.FUTURE),  # beyond error 0.05 and tolerance 0.01
        ({"sent_at": nan}, Objection.FUTURE),
        ({"received_at": -0.16}, Objection.GAP),
        ({"sent_at": -0.71}, Objection.STALE),  # may be 0.76 s old
    ],
)
def test_what_arrives_bad_is_not_held(change, objection):
    state, found = admit(LIMITS, Supervised(), replace(HALF, **change), MAX_AGE, 0.0)
    assert (state, found) == (Supervised(), objection)


def test_the_sequence_never_goes_back_within_a_handshake_and_starts_anew_with_the_next():
    state = hold(replace(HALF, sequence=7))
    for epoch, sequence in [(1, 7), (1, 6), (1, -1), (0, 100)]:
        assert admit(LIMITS, state, replace(HALF, epoch=epoch, sequence=sequence), MAX_AGE, 0.0) == (
            state,
            Objection.SEQUENCE,
        )
    assert hold(replace(HALF, epoch=2, sequence=0), state=state).held[Source.CLOUD].epoch == 2


def test_sources_have_sequences_of_their_own():
    state = hold(replace(HALF, sequence=7))
    assert hold(replace(HALF, source=Source.FALLBACK, epoch=0, sequence=0), state=state).held.keys() == {
        Source.CLOUD,
        Source.FALLBACK,
    }


def test_a_command_backwards_stops_the_walker():
    state = hold(replace(HALF, linear=-3.0, angular=0.0))
    state, objections = step(LIMITS, replace(state, velocity=Velocity(0.005, 0.0)), Source.CLOUD, MAX_AGE, 0.0)
    assert (state.velocity, objections) == ((0.0, 0.0), (Objection.LINEAR_LIMIT,))


@pytest.mark.parametrize("beyond", [0.51, 3.0, 1e300])
@pytest.mark.parametrize("side", [1, -1])
def test_a_command_beyond_the_limits_is_followed_up_to_them_and_no_further(beyond, side):
    state = Supervised()
    for i in range(60):  # 0.25 m/s at 1 m/s^2 and 0.5 rad/s at 2 rad/s^2 are reached after 25 ticks
        now = i * LIMITS.period_s
        command = replace(HALF, linear=beyond, angular=side * beyond, sequence=i, sent_at=now, received_at=now)
        state, objections = step(LIMITS, hold(command, now, state), Source.CLOUD, MAX_AGE, now)
        assert {Objection.LINEAR_LIMIT, Objection.ANGULAR_LIMIT} <= set(objections)
        assert state.velocity.linear <= 0.25
        assert abs(state.velocity.angular) <= 0.5
    assert state.velocity == (0.25, side * 0.5)


def test_a_clock_that_jumps_back_does_not_make_an_old_command_young():
    state = drive(hold(HALF), 0.0, 15)
    assert state.velocity.linear > 0
    state, objections = step(LIMITS, state, Source.CLOUD, MAX_AGE, 0.05)  # 0.14 was the last
    assert objections == (Objection.CLOCK,)
    state = drive(state, 0.06, 8)
    assert state.velocity == (0.0, 0.0)
    # A command that arrives by the new time is followed again.
    state = hold(replace(HALF, sequence=1, sent_at=0.1, received_at=0.14), 0.14, state)
    assert drive(state, 0.14, 3).velocity.linear > 0


def test_a_loop_that_stood_still_goes_on_without_a_jump():
    state = hold(replace(HALF, sent_at=1.0, received_at=1.0), 1.0, replace(Supervised(), now=0.0))
    state, _ = step(LIMITS, state, Source.CLOUD, MAX_AGE, 1.0)
    assert state.velocity.linear == pytest.approx(LIMITS.linear_acceleration * LIMITS.max_step_s)


def test_age_is_judged_by_what_the_service_needs():
    assert max_age(LIMITS, Source.CLOUD, 0.6) == pytest.approx(0.75)
    assert max_age(LIMITS, Source.CLOUD, None) == pytest.approx(1.15)
    assert max_age(LIMITS, Source.FALLBACK, 0.6) == 0.1


@pytest.mark.parametrize(
    ("field", "value"),
    [("linear_max", 0), ("linear_max", nan), ("linear_min", 0.1), ("angular_max", inf), ("linear_braking", 0.5)],
)
def test_limits_that_do_not_limit_are_refused(field, value):
    with pytest.raises(ValueError, match="limits: "):
        VelocityLimits(**{field: value})


events = st.lists(
    st.tuples(
        st.one_of(st.just(0.01), st.floats(0.0, 0.3), wild),  # time between ticks
        st.lists(
            st.builds(
                Command,
                source=st.sampled_from([Source.CLOUD, Source.FALLBACK]),
                linear=st.one_of(tame, wild),
                angular=st.one_of(tame, wild),
                epoch=st.integers(0, 3),
                sequence=st.one_of(st.integers(0, 20), st.sampled_from([2**31, 2**32 - 1, 2**63, -1])),
                sent_at=st.one_of(st.floats(-0.5, 0.1), wild),  # relative to now
                sent_at_error=st.one_of(st.floats(0, 0.3), wild),
                received_at=st.one_of(st.floats(-0.2, 0.02), wild),  # relative to now
            ),
            max_size=3,
        ),
        st.sampled_from(list(Source)),
    ),
    max_size=40,
)


@pytest.mark.slow
@given(events)
@settings(max_examples=100, deadline=None)
def test_no_input_whatever_exceeds_a_limit_jumps_or_moves_on_stale_data(inputs):
    state, now, previous = Supervised(), 100.0, None
    for elapsed, commands, charge in inputs:
        now = now + elapsed if math.isfinite(now + elapsed) else elapsed
        for command in commands:
            arrived = replace(command, sent_at=now + command.sent_at, received_at=now + command.received_at)
            state, _ = admit(LIMITS, state, arrived, MAX_AGE, now)
        before = state.velocity
        state, _ = step(LIMITS, state, charge, MAX_AGE, now)
        linear, angular = state.velocity

        assert 0.0 <= linear <= LIMITS.linear_max
        assert abs(angular) <= LIMITS.angular_max

        advanced = previous is not None and math.isfinite(now) and now > previous
        dt = min(now - previous, LIMITS.max_step_s) if advanced else LIMITS.period_s
        for value, was, acceleration, braking in [
            (linear, before.linear, LIMITS.linear_acceleration, LIMITS.linear_braking),
            (angular, before.angular, LIMITS.angular_acceleration, LIMITS.angular_braking),
        ]:
            assert abs(value - was) <= braking * dt + 1e-9
            if abs(value) > abs(was):
                assert abs(value - was) <= acceleration * dt + 1e-9

        held = state.held.get(charge)
        fresh = (
            held is not None
            and held.source is charge
            and now - held.received_at <= LIMITS.max_gap_s
            and now - held.sent_at + held.sent_at_error <= MAX_AGE
            and (advanced or previous is None)
        )
        if not fresh:
            assert abs(linear) <= max(0.0, abs(before.linear) - LIMITS.linear_braking * dt) + 1e-9
            assert abs(angular) <= max(0.0, abs(before.angular) - LIMITS.angular_braking * dt) + 1e-9
        previous = now if math.isfinite(now) else previous


@given(tame, tame, st.floats(0.001, 0.05))
def test_without_commands_it_comes_to_a_standstill_and_stays_there(linear, angular, period):
    state = drive(hold(replace(HALF, linear=linear, angular=angular)), 0.0, 15)
    now = 0.31
    for i in range(math.ceil(0.2 / period)):
        state, _ = step(LIMITS, state, Source.CLOUD, MAX_AGE, now + i * period)
    assert state.velocity == (0.0, 0.0)
