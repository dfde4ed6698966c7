from dataclasses import replace
from math import inf, nan
from random import Random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skytether.robot.control.arbiter import ArbiterDecision, LinkRequirements, LinkState, Reason, choose, start
from skytether.robot.control.command import Source

NEEDS = LinkRequirements(max_rtt_s=0.6, max_loss=0.2)
TICK = 0.01
GOOD = LinkState(connected=True, rtt=0.1, loss=0.0, clock_error=0.05)


def run(
    choice: ArbiterDecision, link: LinkState, seconds: float, now: float, *, commands: bool = True
) -> tuple[ArbiterDecision, float]:
    """Tick with the same link; a command arrives at each tick unless told otherwise."""
    for _ in range(round(seconds / TICK)):
        now += TICK
        choice = choose(NEEDS, choice, replace(link, command_at=now if commands else link.command_at), now)
    return choice, now


@pytest.fixture
def driving() -> tuple[ArbiterDecision, float]:
    choice, now = run(start(NEEDS, 0.0), GOOD, 1.1, 0.0)
    assert choice.source is Source.CLOUD
    return choice, now


def test_the_robot_is_on_its_own_until_the_link_was_good_for_long_enough():
    choice = start(NEEDS, 0.0)
    assert (choice.source, choice.reason) == (Source.FALLBACK, Reason.START)
    choice, now = run(choice, GOOD, 1.0, 0.0)
    assert choice.source is Source.FALLBACK
    choice, _ = run(choice, GOOD, 0.02, now)
    assert (choice.source, choice.reason) == (Source.CLOUD, Reason.RECOVERED)


def test_the_local_source_may_be_stop_but_not_cloud():
    assert start(replace(NEEDS, local=Source.STOP), 0.0).source is Source.STOP
    with pytest.raises(ValueError, match="local"):
        LinkRequirements(local=Source.CLOUD)
    with pytest.raises(ValueError, match="good_s"):
        LinkRequirements(good_s=0)


def test_without_commands_the_robot_is_on_its_own_after_the_time_out(driving):
    choice, now = driving
    silent = replace(GOOD, command_at=now)
    choice, now = run(choice, silent, 0.14, now, commands=False)
    assert choice.source is Source.CLOUD
    choice, _ = run(choice, silent, 0.02, now, commands=False)
    assert (choice.source, choice.reason) == (Source.FALLBACK, Reason.NO_COMMAND)


def test_a_session_that_ended_counts_at_once(driving):
    choice, now = driving
    choice, _ = run(choice, replace(GOOD, connected=False), TICK, now)
    assert (choice.source, choice.reason) == (Source.FALLBACK, Reason.DISCONNECTED)


@pytest.mark.parametrize(
    ("bad", "reason"),
    [({"rtt": 0.61}, Reason.RTT), ({"loss": 0.21}, Reason.LOSS), ({"clock_error": 0.6}, Reason.CLOCK)],
)
def test_bad_quality_counts_when_it_lasts_and_the_way_back_takes_longer(driving, bad, reason):
    choice, now = driving
    choice, now = run(choice, replace(GOOD, **bad), 0.49, now)
    assert choice.source is Source.CLOUD
    choice, now = run(choice, GOOD, 0.01, now)
    choice, now = run(choice, replace(GOOD, **bad), 0.49, now)
    assert choice.source is Source.CLOUD, "a good moment ends a bad spell"
    choice, now = run(choice, replace(GOOD, **bad), 0.03, now)
    assert (choice.source, choice.reason) == (Source.FALLBACK, reason)
    choice, now = run(choice, GOOD, 0.99, now)
    assert choice.source is Source.FALLBACK
    choice, now = run(choice, GOOD, 0.03, now)
    assert choice.source is Source.CLOUD


@pytest.mark.parametrize("now", [nan, inf, -inf])
def test_a_clock_that_tells_no_time_counts_at_once(driving, now):
    choice, before = driving
    choice = choose(NEEDS, choice, replace(GOOD, command_at=before), now)
    assert (choice.source, choice.reason) == (Source.FALLBACK, Reason.NO_COMMAND)


def test_a_clock_error_that_is_not_known_counts(driving):
    choice, now = driving
    choice, _ = run(choice, replace(GOOD, clock_error=nan), 0.52, now)
    assert (choice.source, choice.reason) == (Source.FALLBACK, Reason.CLOCK)


@pytest.mark.parametrize("bad", [{"rtt": 0.61}, {"connected": False}])
def test_a_bad_moment_on_the_way_back_starts_it_anew(bad):
    choice, now = run(start(NEEDS, 0.0), GOOD, 0.9, 0.0)
    choice, now = run(choice, replace(GOOD, **bad), TICK, now)
    choice, now = run(choice, GOOD, 0.99, now)
    assert choice.source is Source.FALLBACK
    assert run(choice, GOOD, 0.03, now)[0].source is Source.CLOUD


def test_what_nobody_needs_does_not_count():
    needs = LinkRequirements(max_rtt_s=None, max_loss=None)
    choice = start(needs, 0.0)
    for i in range(200):
        now = i * TICK
        choice = choose(needs, choice, replace(GOOD, command_at=now, rtt=3.0, loss=0.9), now)
    assert choice.source is Source.CLOUD
    for i in range(200, 260):
        now = i * TICK
        choice = choose(needs, choice, replace(GOOD, command_at=now, loss=1.0), now)
    assert choice.reason is Reason.LOSS, "but a way on which nothing arrives is no way"


def test_what_was_not_measured_yet_does_not_count():
    choice, _ = run(start(NEEDS, 0.0), replace(GOOD, rtt=nan, loss=nan), 1.1, 0.0)
    assert choice.source is Source.CLOUD


@given(st.integers(0, 2**32))
@settings(max_examples=20, deadline=None)
def test_half_a_second_of_round_trip_with_jitter_and_loss_within_needs_does_not_flap(seed):
    """100 Hz of commands, 24 ms of jitter one way, 10 % lost, a round trip now and then above the limit."""
    random = Random(seed)
    arrivals = sorted(i * TICK + 0.25 + abs(random.gauss(0, 0.024)) for i in range(1000) if random.random() > 0.1)
    choice, command_at, changes = start(NEEDS, 0.0), None, 0
    for i in range(1000):
        now = i * TICK
        while arrivals and arrivals[0] <= now:
            command_at = arrivals.pop(0)
        rtt = 0.5 + abs(random.gauss(0, 0.03))
        link = LinkState(True, command_at, rtt=rtt, loss=0.1, clock_error=0.25)
        before, choice = choice, choose(NEEDS, choice, link, now)
        changes += before.source is not choice.source
    assert changes == 1
    assert choice.source is Source.CLOUD


wild = st.sampled_from([nan, inf, -inf, 0.0, 1e300, 5e-324, -1.0])
links = st.builds(
    LinkState,
    connected=st.booleans() | st.just(True),
    command_at=st.none() | st.floats(-0.5, 0.01) | st.just(0.0) | wild,  # relative to now
    rtt=st.floats(0, 1) | st.just(0.1) | wild,
    loss=st.floats(0, 1) | st.just(0.0) | wild,
    clock_error=st.floats(0, 1) | st.just(0.0) | wild,
)
spells = st.lists(st.tuples(links, st.floats(0.001, 2.5)), max_size=12)


@pytest.mark.slow
@given(spells)
@settings(max_examples=100, deadline=None)
def test_it_never_goes_to_the_cloud_faster_than_the_hysteresis_and_never_on_stale_commands(spells):
    choice, now, last_change = start(NEEDS, 0.0), 0.0, 0.0
    for link, seconds in spells:
        for _ in range(max(1, round(seconds / 0.05))):
            now += 0.05
            current = link if link.command_at is None else replace(link, command_at=now + link.command_at)
            before, choice = choice, choose(NEEDS, choice, current, now)
            if choice.source is not before.source:
                assert choice.since == now
                if choice.source is Source.CLOUD:
                    assert now - last_change >= NEEDS.good_s
                last_change = now
            if choice.source is Source.CLOUD:
                assert current.connected
                assert now - current.command_at <= NEEDS.command_timeout_s


def test_a_clock_that_jumps_back_starts_the_spells_anew():
    choice, _ = run(start(NEEDS, 100.0), GOOD, 0.9, 100.0)
    choice, now = run(choice, GOOD, 0.99, 50.0)
    assert choice.source is Source.FALLBACK
    choice, _ = run(choice, GOOD, 0.03, now)
    assert choice.source is Source.CLOUD
