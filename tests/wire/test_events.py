"""What a session tells its owner: small, frozen, in the order of what happened."""

import dataclasses
from typing import get_args

import pytest

import skytether.wire
from skytether.emulator.link_model import LinkConditions
from skytether.wire import Connected, Disconnected, Event, MessageReceived, Role
from skytether.wire.events import PathSwitched, PeerMoved, Refused

ROBOT, SERVICE = Role.ROBOT, Role.SERVICE
EVENTS = (
    Connected(()),
    Disconnected("silent"),
    MessageReceived("scan", b"x", 0, 1.0, 0.01, 1.0),
    PathSwitched(1, "lost"),
    PeerMoved(("192.0.2.1", 4000)),
    Refused("topic scan: types differ"),
)


def test_every_event_is_there_for_users_of_the_package():
    assert {type(event) for event in EVENTS} == set(get_args(Event))
    assert {cls.__name__ for cls in get_args(Event)} <= set(skytether.wire.__all__)


@pytest.mark.parametrize("event", EVENTS, ids=lambda event: type(event).__name__)
def test_an_event_is_final_and_equal_to_one_that_says_the_same(event):
    field = dataclasses.fields(event)[0].name
    with pytest.raises(dataclasses.FrozenInstanceError):
        setattr(event, field, None)
    assert not hasattr(event, "__dict__")
    assert event == dataclasses.replace(event)


def test_a_session_is_connected_before_the_first_message_and_disconnected_after_the_last(world):
    link = world.link(connect=False)
    link.every(0.01, 1.0, lambda: link.publish(ROBOT, "log", b"x"))
    link.run(1.0)
    link.sessions[ROBOT].close(link.now)
    link.run(0.5)
    ((connected, first), (gone, last)) = link.events[SERVICE]
    assert (type(first), type(last)) == (Connected, Disconnected)
    assert last.reason == "goodbye"
    times = [at for at, _ in link.messages[SERVICE]]
    assert times
    assert connected <= min(times) <= max(times) <= gone


def test_silence_is_told_with_its_reason_and_a_new_peer_as_such(world):
    link = world.link()
    for model in link.models.values():
        model.conditions = LinkConditions(cut=True)
    link.run(30.0)
    assert link.events[SERVICE][-1][1] == Disconnected("silent")
    for model in link.models.values():
        model.conditions = LinkConditions()
    link.replace(ROBOT, world.session(ROBOT, now=link.now))
    link.run(5.0)
    again = link.events[SERVICE][-1][1]
    assert isinstance(again, Connected)
    assert again.restarted
