"""What a subscription of ours asks for where publishers offer this and that; who gets nothing of ours."""

import pytest

from skytether.ros.ros2.qos import MAX_FOLLOWED, Qos, clash, follow, history_missed

SENSOR = Qos(reliable=False, depth=5)
RELIABLE = Qos(depth=20)
LATCHED = Qos(transient_local=True, depth=1)


@pytest.mark.parametrize(
    ("offers", "asked"),
    [
        ([SENSOR], Qos(False, False, 10)),
        ([RELIABLE], Qos(True, False, 20)),
        ([LATCHED], Qos(True, True, 10)),
        ([LATCHED, LATCHED, Qos(transient_local=True, depth=30)], Qos(True, True, 32)),
        ([RELIABLE, SENSOR], Qos(False, False, 25)),
        ([LATCHED, RELIABLE], Qos(True, False, 21)),
        ([Qos(depth=0), Qos(depth=0)], Qos(True, False, 20)),  # DDS does not tell depths
        ([Qos(depth=10_000)], Qos(True, False, MAX_FOLLOWED)),
    ],
)
def test_what_all_of_them_offer_is_asked_for(offers, asked):
    assert follow(Qos(depth=1), offers) == asked
    assert not any(clash(offer, asked) for offer in offers)


def test_what_is_kept_may_be_left_unless_the_row_asks_for_it():
    """An old velocity is worse than none."""
    assert follow(Qos(depth=1), [LATCHED], kept_too=False) == Qos(True, False, 10)
    assert follow(LATCHED, [LATCHED], kept_too=False) == Qos(True, True, 10)


def test_a_row_that_keeps_more_is_given_more():
    assert follow(Qos(depth=200), [SENSOR]).depth == 200


@pytest.mark.parametrize(
    ("offered", "asked", "why"),
    [
        (SENSOR, RELIABLE, "reliable is asked for, best effort is offered"),
        (RELIABLE, LATCHED, "transient local is asked for, volatile is offered"),
        (RELIABLE, Qos(deadline_s=0.1), "a deadline of 0.1 s is asked for, none is offered"),
        (Qos(deadline_s=0.5), Qos(deadline_s=0.1), "a deadline of 0.1 s is asked for, 0.5 s is offered"),
        (RELIABLE, Qos(lease_s=0.5), "a lease of liveliness of 0.5 s is asked for, none is offered"),
        (Qos(lease_s=0.5), Qos(lease_s=0.5), ""),
        (RELIABLE, Qos(manual=True), "liveliness by hand is asked for, automatic liveliness is offered"),
        (Qos(False), LATCHED, "reliable is asked for, best effort is offered, transient local is asked for, volatile"),
        (LATCHED, RELIABLE, ""),
        (Qos(deadline_s=0.1, manual=True), Qos(deadline_s=0.5), ""),
    ],
)
def test_more_than_is_offered_gets_nothing(offered, asked, why):
    assert clash(offered, asked).startswith(why)
    assert bool(clash(offered, asked)) == bool(why)


def test_latched_messages_are_missed_where_others_keep_nothing():
    assert history_missed([LATCHED, RELIABLE])
    assert not history_missed([LATCHED, LATCHED])
    assert not history_missed([RELIABLE, SENSOR])
