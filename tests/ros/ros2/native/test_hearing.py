"""Whether whoever listens hears, from what DDS says of acknowledgements."""

import pytest

from skytether.ros.ros2.native.side.hearing import HEARS_S, SILENT_S, Hearing

TICK = 0.02


class Publisher:
    """One message each tick, to so many who listen, some of whom acknowledge nothing."""

    def __init__(self):
        self.hearing = Hearing()
        self.now = 100.0

    def publish(self, listeners, read, ticks=1):
        for _ in range(ticks):
            self.now += TICK
            self.hearing.update(listeners, read, self.now)
            self.hearing.tell(listeners, self.now)
        return self.hearing


@pytest.fixture
def publisher():
    return Publisher()


def test_it_is_heard_once_somebody_has_acknowledged_a_message(publisher):
    assert not publisher.publish(0, True, 10).heard
    assert not publisher.publish(1, True).heard, "nothing was published yet"
    assert publisher.publish(1, True).heard
    assert not publisher.publish(0, True).heard


def test_one_who_acknowledges_nothing_counts_as_hearing_after_a_while(publisher):
    ticks = int(HEARS_S / TICK)
    assert not publisher.publish(1, False, ticks).heard
    assert publisher.publish(1, False, 3).heard
    assert publisher.hearing.unread_s == 0.0, "of one who never did it is not known"


def test_how_long_nobody_has_acknowledged_is_known_of_one_who_did(publisher):
    publisher.publish(1, True, 5)
    assert publisher.publish(1, False, 10).unread_s == pytest.approx(10 * TICK)
    assert publisher.hearing.heard
    assert publisher.publish(1, True).unread_s == 0.0
    publisher.publish(1, False, 5)
    publisher.publish(0, True)
    assert publisher.publish(1, False, 5).unread_s == 0.0, "another one, who has not yet"


def test_who_comes_to_watch_stops_nobody(publisher):
    publisher.publish(1, True, 5)
    assert publisher.publish(2, True).heard
    assert publisher.publish(1, True).heard, "and who goes"


@pytest.mark.parametrize("left", [True, False])
def test_who_comes_in_somebody_s_place_is_to_hear_a_first_word(publisher, left):
    publisher.publish(2, True, 5)
    if left:
        publisher.publish(1, True, 5)
    else:
        publisher.publish(2, False, int(SILENT_S / TICK) + 2)
    assert publisher.hearing.heard
    assert not publisher.publish(2 if left else 3, False).heard
    assert publisher.publish(2 if left else 3, True).heard
