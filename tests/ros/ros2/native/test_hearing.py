"""Whether whoever listens hears, from what DDS says of acknowledgements."""

import pytest

from skytether.ros.ros2.native.side.hearing import DOUBT_S, HEARS_S, SILENT_S, Hearing

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
            self.hearing.update(len(listeners), self.came, read, self.now, lambda: nodes)
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
    hearing.update(2, publisher.came + 1, True, publisher.now, lambda: {1: "b"})
    assert hearing.holds
    hearing.update(2, publisher.came + 1, True, publisher.now, lambda: {1: "b", 2: "e"})
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


@pytest.mark.parametrize("shown", [True, False], ids=["shown", "not shown by the graph yet"])
def test_who_takes_anothers_place_between_two_messages_is_to_hear_a_first_word(publisher, shown):
    """A driver's subscription was made anew within 2 ms, and the first that it heard was full speed."""
    publisher.publish("rb", True, 5)
    renewed = publisher.hearing.renewed
    assert not publisher.publish("rb", True, swapped=True, shown=shown).heard
    assert publisher.hearing.renewed == renewed + 1
    assert publisher.publish("rb", True).heard


def test_the_first_who_listens_is_to_hear_a_first_word_and_who_comes_to_watch_is_not(publisher):
    assert publisher.publish("", True).renewed == 0
    assert publisher.publish("b", True, 5).renewed == 1
    assert publisher.publish("br", True, 5).renewed == 1
    assert publisher.publish("", True, 5).renewed == 1
    assert publisher.publish("b", True, 5).renewed == 2
