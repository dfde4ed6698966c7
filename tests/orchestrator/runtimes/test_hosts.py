"""Addresses that robots are told by runtimes."""

from collections import Counter

import pytest

from skytether.orchestrator.runtimes.hosts import parse_address, rendezvous

RELAYS = [f"203.0.113.{n}:8700" for n in range(1, 5)]
SESSIONS = [f"{n:016x}" for n in range(4000)]


def test_each_of_several_is_chosen_about_equally_often_in_whatever_order_they_are_listed() -> None:
    chosen = [rendezvous(session, RELAYS) for session in SESSIONS]
    assert chosen == [rendezvous(session, RELAYS[::-1]) for session in SESSIONS]
    assert all(900 < count < 1100 for count in Counter(chosen).values())


def test_one_that_comes_or_goes_concerns_only_those_who_choose_it() -> None:
    before = {session: rendezvous(session, RELAYS) for session in SESSIONS}
    fewer = {session: rendezvous(session, RELAYS[1:]) for session in SESSIONS}
    assert {session for session in SESSIONS if fewer[session] != before[session]} == {
        session for session in SESSIONS if before[session] == RELAYS[0]
    }


def test_an_address_to_connect_to() -> None:
    assert parse_address("relay.example.org:8700") == ("relay.example.org", 8700)
    assert parse_address("[2001:db8::1]:1") == ("2001:db8::1", 1)
    for text in ("", "h", "h:", ":1", "h:0", "h:65536", "h:x", "2001:db8::1:1", "0.0.0.0:1", "[::]:1"):
        with pytest.raises(ValueError, match=r"HOST:PORT|wildcard"):
            parse_address(text)
