"""The detector with made-up arrivals; what makes them late was recorded on a busy machine."""

import random
from pathlib import Path

import pytest

from skytether.robot.control.failure_detector import LEAST_PERIODS, AccrualDetector, least_s

FIRST_S = 0.15
LATENESS = [
    int(number) / 10_000
    for line in (Path(__file__).parent / "data" / "busy_lateness.txt").read_text().splitlines()
    if not line.startswith("#")
    for number in line.split()
]
GRID_S = 0.01
PIECE_S = 10.0
"""So much of the record is taken in one piece: pauses come in groups."""


def arrivals(rate, seconds, *, scale=1.0, loss=0.0, seed=1):
    """When commands arrive that are sent ``rate`` times a second."""
    chance = random.Random(seed)
    before = offset = 0
    for k in range(round(seconds * rate)):
        if k % round(PIECE_S * rate) == 0:
            offset = chance.randrange(len(LATENESS))
        if chance.random() < loss:
            continue
        sent = k / rate
        late = scale * LATENESS[(offset + int(sent / GRID_S)) % len(LATENESS)]
        before = max(before + 1e-5, sent + late)
        yield before


def hear(detector, times):
    """When silence was too long though the sender was there, and the longest gap."""
    alarms, last, longest = [], None, 0.0
    for at in times:
        if last is not None:
            longest = max(longest, at - last)
            if at - last > detector.limit_s:
                alarms.append(at)
        detector.arrived(at)
        last = at
    return alarms, longest


def most(rate):
    return max(0.4, 4 / rate)


@pytest.mark.parametrize("rate", [5, 10, 20, 50, 100, 200])
def test_who_is_as_regular_as_a_clock_is_missed_after_two_and_a_half_periods(rate):
    detector = AccrualDetector(1 / rate, most(rate), FIRST_S)
    assert detector.limit_s == max(FIRST_S, LEAST_PERIODS / rate)
    alarms, _ = hear(detector, arrivals(rate, 20, scale=0.0))
    assert alarms == []
    assert detector.limit_s == pytest.approx(max(2.5 / rate, 2 / rate + 0.03))


@pytest.mark.slow
@pytest.mark.parametrize("loss", [0.0, 0.02])
@pytest.mark.parametrize("rate", [5, 10, 20, 50, 100, 200])
def test_an_hour_on_a_busy_machine(rate, loss):
    """The first pauses of their kind may surprise it, in the first minutes; from then on nothing does."""
    detector = AccrualDetector(1 / rate, most(rate), FIRST_S)
    alarms, longest = hear(detector, arrivals(rate, 3600, loss=loss))
    assert len(alarms) <= 5
    assert [at for at in alarms if at >= 300] == []
    jitter = longest - 1 / rate
    assert detector.limit_s <= min(max(3 / rate + 1.25 * jitter, least_s(1 / rate)), most(rate))


@pytest.mark.slow
@pytest.mark.parametrize("rate", [10, 20, 50, 100, 200])
def test_an_hour_over_a_link_that_loses(rate):
    detector = AccrualDetector(1 / rate, most(rate), FIRST_S)
    alarms, longest = hear(detector, arrivals(rate, 3600, scale=0.05, loss=0.05))
    assert [at for at in alarms if at >= 60 and longest <= most(rate)] == []
    assert detector.limit_s <= min(3 / rate + 1.5 * longest, most(rate))


def test_a_busy_time_is_forgotten_and_an_outage_says_nothing():
    detector = AccrualDetector(0.01, 0.4, FIRST_S)
    hear(detector, arrivals(100, 60))
    busy = detector.limit_s
    assert busy > 0.1
    hear(detector, (60 + at for at in arrivals(100, 60, scale=0.0)))
    assert detector.limit_s == pytest.approx(busy, rel=0.1), "it may come again"
    hear(detector, (14_400 + at for at in arrivals(100, 60, scale=0.0)))
    assert detector.limit_s < busy / 5
    calm = detector.limit_s
    hear(detector, (20_000 + 5 * at for at in range(100)))
    assert detector.limit_s == calm
    for i in range(100):
        detector.arrived(30_000 + 0.3 * i, lost=29)
    assert detector.limit_s == calm, "short, but so much was lost that the link was cut"


def test_a_sender_that_does_not_say_how_often_is_learned_too():
    detector = AccrualDetector(None, 0.4, FIRST_S)
    assert detector.limit_s == FIRST_S
    hear(detector, arrivals(50, 20, scale=0.0))
    assert detector.limit_s == pytest.approx(0.07)


def test_a_claimed_period_widens_nothing_beyond_the_most():
    assert AccrualDetector(1000.0, 0.4, FIRST_S).limit_s == 0.4
    detector = AccrualDetector(1000.0, 0.4, FIRST_S)
    hear(detector, arrivals(100, 20, scale=0.0))
    assert detector.limit_s == pytest.approx(0.05), "what is seen counts, not what was claimed"


def test_times_that_go_back_or_stand_still_are_left_out():
    detector = AccrualDetector(0.01, 0.4, FIRST_S)
    for at in (5.0, 5.0, 4.0, float("nan"), 4.01, float("inf"), 4.02):
        detector.arrived(at)
    hear(detector, (100 + at for at in arrivals(100, 20, scale=0.0)))
    assert detector.limit_s == pytest.approx(0.05)
