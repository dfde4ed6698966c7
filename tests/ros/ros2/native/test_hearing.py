"""Whether whoever listens hears, from what DDS says of acknowledgements."""

import pytest

from skytether.ros.ros2.native.side.comers import FINDS_S
from skytether.ros.ros2.native.side.hearing import COMES_S, DOUBT_S, HEARS_S, SILENT_S, Hearing

TICK = 0.02


class Publisher:
    """One message each tick, to so many who listen."""

    def __init__(self):
        self.hearing = Hearing()
        self.now = 100.0
        self.came = 0
        self.before = ""
        self.keys = []

    def publish(self, listeners, read, ticks=1, swapped=False, shown=True):
        """``listeners``: letters, each the name of a node; a space has none yet."""
        if len(listeners) < len(self.keys):
            gone = next(i for i, name in enumerate(self.before) if listeners[i : i + 1] != name)
            del self.keys[gone : gone + len(self.keys) - len(listeners)]
        new = 1 if swapped else len(listeners) - len(self.keys)
        keys = self.keys[: len(self.keys) - swapped] + [self.came + i + 1 for i in range(new)]
        self.came += new
        self.before = listeners
        self.keys = keys if shown else self.keys
        nodes = {key: name.strip() for key, name in zip(self.keys, listeners, strict=True)}
        for _ in range(ticks):
            self.now += TICK
            self.hearing.update(len(listeners), self.came, read, self.now, nodes)
            self.hearing.tell(len(listeners), self.now)
        return self.hearing


@pytest.fixture
def publisher():
    return Publisher()


def test_it_is_heard_once_somebody_has_acknowledged_a_message(publisher):
    assert not publisher.publish("", True, 10).heard
    assert not publisher.publish("b", True).heard, "nothing was published yet"
    assert publisher.publish("b", True).heard
    assert not publisher.publish("", True).heard


def test_one_who_acknowledges_nothing_counts_as_hearing_after_a_while(publisher):
    ticks = int(HEARS_S / TICK)
    assert not publisher.publish("b", False, ticks).heard
    assert publisher.publish("b", False, 3).heard
    assert publisher.hearing.unread_s == 0.0, "of one who never did it is not known"


def test_how_long_nobody_has_acknowledged_is_known_of_one_who_did(publisher):
    publisher.publish("b", True, 5)
    assert publisher.publish("b", False, 10).unread_s == pytest.approx(10 * TICK)
    assert publisher.hearing.heard
    assert publisher.publish("b", True).unread_s == 0.0
    publisher.publish("b", False, 5)
    publisher.publish("", True)
    assert publisher.publish("b", False, 5).unread_s == 0.0, "another one, who has not yet"


def test_who_comes_to_watch_stops_nobody(publisher):
    publisher.publish("b", True, 5)
    assert publisher.publish("be", True).heard
    assert publisher.publish("b", True).heard, "and who goes"


def test_while_it_is_not_known_who_came_nothing_is_said_but_a_first_word(publisher):
    publisher.publish("b", True, 5)
    renewed = publisher.hearing.renewed
    assert publisher.publish("b ", True).holds
    assert publisher.publish("b ", True, 5).holds
    assert not publisher.publish("be", True).holds, "one who only listens"
    assert publisher.hearing.renewed == renewed
    assert publisher.publish("be ", True).holds
    assert not publisher.publish("bee", True).holds
    assert publisher.hearing.renewed == renewed + 1, "one who was there, by another process"


def test_whoever_is_found_soon_after_the_publisher_began_is_to_hear_a_first_word(publisher):
    """One before it was killed, and this one finds the wheels later than a recorder."""
    publisher.hearing = Hearing(began=publisher.now)
    publisher.publish("e", True, 5)
    before = publisher.hearing.renewed
    assert publisher.publish("eb", True).renewed == before + 1
    publisher.publish("eb", True, int(FINDS_S / TICK))
    assert publisher.publish("ebn", True).renewed == before + 1


def test_the_first_whom_the_graph_shows_later_counts_once():
    hearing = Hearing(began=100.0)
    for now, came, nodes in ((100.0, 0, {}), (100.1, 1, {}), (100.2, 1, {1: "b"}), (100.3, 1, {1: "b"})):
        hearing.update(1, came, True, now, nodes)
        hearing.tell(1, now, first=not nodes)
    assert hearing.renewed == 1
    assert not hearing.holds
    hearing.update(2, 2, True, 100.4, {1: "b", 2: "e"})
    assert hearing.renewed == 2, "this one came after that word"


def test_who_is_shown_in_the_place_of_the_first_is_to_hear_a_first_word():
    hearing = Hearing(began=100.0)
    hearing.update(1, 0, True, 100.0, {})
    hearing.update(1, 2, True, 100.1, {2: "b"})
    assert hearing.renewed == 2


def test_who_has_no_name_for_long_is_to_hear_a_first_word(publisher):
    publisher.publish("b", True, 5)
    renewed = publisher.hearing.renewed
    assert publisher.publish("b ", True, int(DOUBT_S / TICK)).holds
    assert not publisher.publish("b ", True, 2).holds
    assert publisher.hearing.renewed == renewed + 1
    assert not publisher.publish("be", True).holds
    assert publisher.hearing.renewed == renewed + 1, "he has heard it"


def test_who_has_heard_a_first_word_before_his_name_was_known_needs_no_other(publisher):
    publisher.publish("b", True, 5)
    publisher.publish("b ", True)
    publisher.hearing.tell(2, publisher.now, first=True)
    assert not publisher.hearing.holds
    renewed = publisher.hearing.renewed
    assert publisher.publish("bb", True, 5).renewed == renewed


def test_one_whom_the_graph_does_not_show_yet_is_waited_for(publisher):
    publisher.publish("b", True, 5)
    hearing = publisher.hearing
    hearing.update(2, publisher.came + 1, True, publisher.now, {1: "b"})
    assert hearing.holds
    hearing.update(2, publisher.came + 1, True, publisher.now, {1: "b", 2: "e"})
    assert not hearing.holds


def test_the_wheels_whose_name_was_not_known_as_they_came_are_known_as_they_go(publisher):
    for there in ("r", "r ", "rb", "r"):
        publisher.publish(there, True, 5)
    assert not publisher.publish("rb", True).heard
    for there in ("rb", "rb ", "rb"):
        publisher.publish(there, True, 5)
    assert not publisher.publish("rbx", True).heard, "nobody knew who that was"


def test_who_comes_while_nobody_is_heard_is_to_hear_a_first_word(publisher):
    publisher.publish("rb", True, 5)
    publisher.publish("rb", False, int(SILENT_S / TICK) + 2)
    assert publisher.hearing.heard
    assert not publisher.publish("rbx", False).heard
    assert publisher.publish("rbx", True).heard


@pytest.mark.parametrize(
    "listeners",
    [
        ("rb", "r", "rb"),  # started again
        ("rb", "r", "rx"),  # by another name
        ("b", "", "e", "be"),  # somebody else came first
        ("rb", "r", "re", "reb"),
        ("b", "bb"),  # killed: its node is shown still
    ],
)
def test_the_wheels_that_are_back_are_to_hear_a_first_word(publisher, listeners):
    for there in listeners[:-1]:
        publisher.publish(there, True, 5)
    assert publisher.hearing.heard == bool(listeners[-2])
    assert not publisher.publish(listeners[-1], True).heard
    assert publisher.publish(listeners[-1], True).heard


def test_who_takes_anothers_place_between_two_messages_is_to_hear_a_first_word(publisher):
    """A driver's subscription was made anew within 2 ms, and the first that it heard was full speed."""
    publisher.publish("rb", True, 5)
    renewed = publisher.hearing.renewed
    assert not publisher.publish("rb", True, swapped=True).heard
    assert publisher.hearing.renewed == renewed + 1
    assert publisher.publish("rb", True).heard


@pytest.mark.parametrize(("after", "more"), [({1: "r", 3: "b"}, 1), ({2: "b", 3: "r"}, 0)], ids=["wheels", "a tool"])
def test_who_takes_anothers_place_before_the_graph_shows_it_is_waited_for(after, more):
    hearing = Hearing(["b"])
    for _ in range(3):
        hearing.update(2, 2, True, 100.0, {1: "r", 2: "b"})
        hearing.tell(2, 100.0, first=True)
    renewed = hearing.renewed
    hearing.update(2, 3, True, 100.02, {1: "r", 2: "b"})
    assert hearing.holds
    assert hearing.renewed == renewed
    hearing.update(2, 3, True, 100.04, after)
    assert hearing.renewed == renewed + more
    hearing.update(2, 3, True, 100.1, after)
    assert not hearing.holds


def test_of_two_who_come_at_once_the_second_is_waited_for_too():
    hearing = Hearing(["b"])
    for _ in range(3):
        hearing.update(1, 1, True, 100.0, {1: "b"})
        hearing.tell(1, 100.0, first=True)
    hearing.update(3, 3, True, 100.02, {1: "b", 2: "e"})
    assert hearing.holds
    renewed = hearing.renewed
    hearing.update(3, 3, True, 100.04, {1: "b", 2: "e", 3: "b"})
    assert hearing.renewed == renewed + 1


def test_the_first_who_listens_is_to_hear_a_first_word_and_who_comes_to_watch_is_not(publisher):
    assert publisher.publish("", True).renewed == 0
    assert publisher.publish("b", True, 5).renewed == 1
    assert publisher.publish("br", True, 5).renewed == 1
    assert publisher.publish("", True, 5).renewed == 1
    assert publisher.publish("b", True, 5).renewed == 2


def test_who_is_shown_and_not_connected_yet_is_waited_for_and_hears_a_first_word_then(publisher):
    """In between the next velocity reached him, as what counts those who listen is told a little later."""
    publisher.publish("b", True, 5)
    hearing, came, renewed = publisher.hearing, publisher.came, publisher.hearing.renewed
    hearing.update(1, came, True, 200.0, {1: "b", 2: "b"})
    assert hearing.holds
    assert hearing.renewed == renewed
    hearing.update(1, came, True, 200.0 + COMES_S, {1: "b", 2: "b"})
    assert not hearing.holds, "it may never be"
    hearing.update(2, came + 1, True, 201.0, {1: "b", 2: "b"})
    assert hearing.renewed == renewed + 1


def test_who_is_seen_between_two_messages_is_heard_once_he_was_told_something(publisher):
    """A velocity that was refused, as it was for those before him, counted as acknowledged by him."""
    publisher.publish("rb", True, 5)
    hearing, came = publisher.hearing, publisher.came + 1
    hearing.look(2, came, 200.0, {1: "r", 9: "b"})
    hearing.update(2, came, True, 200.01, {1: "r", 9: "b"})
    assert not hearing.heard
    hearing.tell(2, 200.02)
    hearing.update(2, came, True, 200.03, {1: "r", 9: "b"})
    assert hearing.heard
