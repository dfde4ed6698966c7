"""Who may come in, and who gives way."""

from __future__ import annotations

import math
from typing import Any

from skytether.orchestrator.door import Book, Guest, _place_of
from skytether.orchestrator.settings import Limits


def book(most: int = 100, **limits: int) -> Book:
    return Book(Limits(**limits), most)


def came(at: Book, address: str = "a", owner: str = "", deadline: float = math.inf) -> Guest:
    guest = Guest(address, deadline, lambda *_: None)
    at.come(guest)
    if owner:
        at.know(guest, owner)
    return guest


def test_of_all_the_oldest_without_a_token_gives_way_and_nobody_with_one() -> None:
    at = book(most=3)
    came(at, owner="robot:a")
    old = came(at, "b")
    came(at, "c")
    assert at.room("d") == (True, old)
    at.leave(old)
    assert at.room("d") == (True, None)
    came(at, "d", owner="robot:d")
    assert at.room("e") == (True, at.stranger())
    stranger = at.stranger()
    assert stranger is not None
    at.know(stranger, "robot:c")
    assert at.room("e") == (False, None)


def test_one_address_has_its_share_unless_it_is_a_proxys() -> None:
    at = book(connections_per_address=2)
    first = came(at, "a")
    came(at, "a")
    assert at.room("a") == (True, first)
    assert at.room("b") == (True, None)
    assert at.room("a", free=True) == (True, None)
    for guest in list(at.guests):
        at.know(guest, "robot:x")
    assert at.room("a") == (False, None)


def test_of_a_robots_connections_the_one_that_was_quiet_for_longest_gives_way() -> None:
    at = book(connections_per_robot=2)
    first, second = came(at, owner="robot:a"), came(at, owner="robot:a")
    at.know(first, "robot:a")
    third = came(at)
    assert at.know(third, "robot:a") is second
    at.leave(second)
    first.busy = True
    fourth = came(at)
    assert at.know(fourth, "robot:a") is third
    many: list[Any] = [came(at, owner="operator") for _ in range(5)]
    assert all(at.know(one, "operator") is None for one in many)


def test_those_who_left_are_forgotten() -> None:
    at = book()
    guests = [came(at, "a"), came(at, "b", "robot:b"), came(at, "b", "robot:c")]
    at.know(guests[2], "robot:b")
    for guest in [*guests, *guests]:
        at.leave(guest)
    at.know(guests[0], "robot:a")
    assert (at.guests, at._at, at._of, list(at._strangers)) == (set(), {}, {}, [])


def test_late_is_who_owes_something_or_does_not_take_what_it_was_sent() -> None:
    at = book()
    owes, takes, waits = came(at, deadline=5), came(at), came(at)
    takes.takes_by = 7
    assert at.late(4.9) == []
    assert at.late(5) == [owes]
    assert set(at.late(7)) == {owes, takes}
    assert waits not in at.late(1e9)


def test_one_customers_network_is_one_address() -> None:
    assert _place_of("2001:db8:1:2:aaaa::1") == _place_of("2001:db8:1:2::9") != _place_of("2001:db8:1:3::9")
    assert _place_of("::ffff:192.0.2.7") == "192.0.2.7" == _place_of("192.0.2.7")
    assert _place_of("fe80::1%eth0") == _place_of("fe80::2%eth0")
    assert _place_of("unix") == "unix"
