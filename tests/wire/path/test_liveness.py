"""Whether a path works, by questions and answers at made-up times."""

import math

import pytest

from skytether.wire.path.liveness import DEAD_AFTER, PATIENCE_FIRST, PATIENCE_MAX, PATIENCE_MIN, Health, Liveness


def answered(*rtts):
    """A path whose questions, one a second, were answered after these times."""
    liveness = Liveness()
    for second, rtt in enumerate(rtts):
        liveness.ask(second)
        liveness.answer(second, rtt, second + rtt)
    return liveness


def test_a_path_is_new_until_the_first_answer():
    liveness = Liveness()
    assert liveness.health(0.0) is Health.NEW
    liveness.ask(0.0)
    assert liveness.health(0.1) is Health.NEW
    liveness.answer(0.0, 0.1, 0.1)
    assert liveness.health(0.1) is Health.LIVE
    assert liveness.live_since == 0.1
    assert liveness.confirmed_at == 0.0


def test_one_that_never_answers_is_dead_after_a_while():
    liveness = Liveness()
    liveness.ask(1.0)
    assert liveness.health(1.0 + 0.99 * DEAD_AFTER * PATIENCE_FIRST) is Health.NEW
    assert liveness.health(1.0 + DEAD_AFTER * PATIENCE_FIRST) is Health.DEAD


def test_an_overdue_answer_makes_it_suspect_then_dead_at_the_times_that_were_said():
    liveness = answered(0.1, 0.1)
    liveness.ask(10.0)
    suspect_at = liveness.next_change(10.0)
    assert suspect_at == 10.0 + liveness.patience
    assert liveness.health(math.nextafter(suspect_at, 0)) is Health.LIVE
    assert liveness.health(suspect_at) is Health.SUSPECT
    dead_at = liveness.next_change(suspect_at)
    assert dead_at == pytest.approx(10.0 + DEAD_AFTER * liveness.patience)
    assert liveness.health(dead_at) is Health.DEAD
    assert liveness.next_change(dead_at) == math.inf


def test_suspicion_that_came_to_nothing_does_not_count_but_death_does():
    liveness = answered(0.1)
    liveness.ask(10.0)
    assert liveness.health(10.4) is Health.SUSPECT
    liveness.answer(10.0, 0.45, 10.45)
    assert (liveness.health(10.45), liveness.live_since) == (Health.LIVE, 0.1)
    liveness.ask(20.0)
    assert liveness.health(29.0) is Health.DEAD
    liveness.answer(20.0, 9.5, 29.5)
    assert (liveness.health(29.5), liveness.live_since) == (Health.LIVE, 29.5)


def test_an_answer_settles_the_questions_before_it_and_no_later_one():
    liveness = answered(0.1)
    for at in (10.0, 10.1, 10.2):
        liveness.ask(at)
    liveness.answer(10.1, 0.1, 10.2)
    assert liveness.age == 10.2
    liveness.answer(10.0, 0.3, 10.3)  # overtaken
    assert (liveness.age, liveness.confirmed_at) == (10.2, 10.1)


@pytest.mark.parametrize("rtt", [0.0, 0.001, 0.1, 5.0])
def test_patience_is_bounded_beyond_the_round_trip(rtt):
    steady = answered(*[rtt] * 50)
    assert steady.patience - rtt + 1e-9 >= PATIENCE_MIN
    assert steady.patience - rtt <= PATIENCE_MAX + 1e-9
    assert answered(*[rtt, rtt + 0.05] * 25).patience >= steady.patience


def test_nobody_who_is_not_asked_is_missing():
    liveness = answered(0.1)
    liveness.ask(10.0)
    assert liveness.health(99.0) is Health.DEAD
    liveness.calm()
    assert liveness.health(99.0) is Health.LIVE
    assert liveness.age == math.inf
