"""An authentic peer may be hostile or mistaken: what it says is believed within bounds, and breaks nothing."""

import math

import numpy as np
import pytest
from insider import epoch_of, next_number

from skytether.emulator.link_model import LinkConditions
from skytether.wire import Role
from skytether.wire.codec import frames, packet
from skytether.wire.codec.ciphers import HandshakeTags
from skytether.wire.codec.plaintext import INNER
from skytether.wire.connect.paths import MAX_PATHS
from skytether.wire.send.message import Message

ROBOT, SERVICE = Role.ROBOT, Role.SERVICE


def say(link, role, message, *, stamp=None, path=0, address=None):
    """Let an end hear a frame that its peer sealed, by any path and with any time stamp."""
    receiver = SERVICE if role is ROBOT else ROBOT
    epoch = epoch_of(link.sessions[role])
    epoch.next_number += 1
    number, stamp = epoch.next_number, round(link.now * 1e6) if stamp is None else stamp
    plaintext = INNER.pack(0, stamp) + message
    own = Message(epoch.ciphers, epoch.id, number, 0, plaintext)
    packet_number = next_number(link.sessions[role], path)
    link.inject(
        receiver,
        own.packet(path, number if packet_number is None else packet_number, 0),
        address or link.addresses[role],
    )


NOTHING = frames.Feedback(math.inf, 0.0, 0.0, 0, 0, 0, 0.0, 0.0)


def ping(path=0, **fields):
    return frames.push_ping(
        frames.Ping(
            **{
                "path": path,
                "cost": 0,
                "ask": True,
                "size": 0,
                "echo": None,
                "challenge": 0,
                "hold": 0,
                "feedback": NOTHING,
            }
            | fields
        )
    )


@pytest.mark.parametrize("role", Role)
@pytest.mark.parametrize("stamp", [0, 1, 2**63, 2**64 - 1])
def test_any_time_stamp_is_echoed(world, role, stamp):
    link = world.link()
    say(link, role, ping(), stamp=stamp)
    link.run(1.0)
    assert all(end.stats(link.now).connected for end in link.sessions.values())


def test_who_has_the_key_cannot_have_somebody_else_flooded_by_guessing_challenges(world):
    """Every time that the question may have been asked at, and some bits, as answers from an address that got it."""
    link = world.link(record=True)
    link.publish(SERVICE, "cmd_vel", b"x")
    before = len(link.sent[SERVICE])
    say(link, ROBOT, ping(), address="victim")
    assert len(link.sent[SERVICE]) > before  # the question
    asked_at = round(link.now * 1e6)
    for guess in range(asked_at - 5, asked_at + 6):
        for challenge in (0, 1, guess):
            say(link, ROBOT, ping(ask=False, echo=guess, challenge=challenge), address="victim")
    assert link.sessions[SERVICE].stats(link.now).paths[0].address == "robot"


def test_a_question_from_two_addresses_proves_neither_whatever_paths_it_names(world):
    """HELLO names a path: by one from a victim's address, by another from where the answer is read."""
    slow = LinkConditions(delay=0.05)
    link = world.link(connect=False, up=slow, down=slow, record=True)
    link.run(0.04)
    hello = bytearray(link.sent[ROBOT][0][1])
    hello[packet.PATH_AT] = 7
    HandshakeTags(world.key, b"hello").put(np.frombuffer(hello, np.uint8).reshape(1, -1))
    link.inject(SERVICE, bytes(hello), "victim")
    link.run(0.066)
    say(link, ROBOT, ping(7), path=7, address="victim")
    addresses = {p.path: p.address for p in link.sessions[SERVICE].stats(link.now).paths}
    assert addresses == {0: None, 7: None}
    link.run(0.5)
    addresses = {p.path: p.address for p in link.sessions[SERVICE].stats(link.now).paths}
    assert "victim" not in addresses.values()


@pytest.mark.parametrize("role", Role)
def test_losses_that_last_for_ever_are_not_reckoned_with(world, role):
    link = world.link()
    for turn in (1, 2):
        bursts = NOTHING._replace(settled=1000 * turn, lost=300 * turn, runs=3 * turn, time=1.0 * turn)
        say(link, role, ping(feedback=bursts._replace(time_squared=math.inf)))
        link.run(0.02)
    assert link.sessions[SERVICE if role is ROBOT else ROBOT].stats(link.now).rejected["control"] == 2


def test_a_robot_with_many_paths(world):
    """Each opens when it is first heard; beyond the most that there may be, one makes room."""
    link = world.link()
    for path in range(2 * MAX_PATHS):
        say(link, ROBOT, ping(path), path=path, address=f"robot {path}")
        link.run(0.05)
        assert len(link.sessions[SERVICE].stats(link.now).paths) == min(path + 1, MAX_PATHS)
    link.publish(SERVICE, "cmd_vel", b"x")
    link.run(1.0)
    assert link.sessions[ROBOT].stats(link.now).connected


def test_a_path_that_was_left_wakes_nobody(world):
    link = world.link()
    for path in (1, 2):
        link.add_path(path)
        link.run(0.05)
    session = link.sessions[SERVICE]
    choice = session._paths.choice  # noqa: SLF001 it tells which is in use, not which is the one after that
    (idle,) = {0, 1, 2} - {choice.active.id, choice.other.id}
    session.close_path(idle, link.now)
    queues = session._sender._path_queues  # noqa: SLF001 an empty queue of no path shows in nothing but time
    assert set(queues) == {p.path for p in session.stats(link.now).paths}
