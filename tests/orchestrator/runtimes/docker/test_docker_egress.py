"""What containers may connect to, as patterns and rules: no engine needed."""

from __future__ import annotations

import socket
import threading
from typing import Any

import pytest
from pydantic import ValidationError

from skytether.api.manifest import Opening, ServiceSpec
from skytether.orchestrator.runtimes.base import RuntimeFailure
from skytether.orchestrator.runtimes.docker.network import rules
from skytether.orchestrator.runtimes.docker.objects import refusal
from skytether.orchestrator.runtimes.docker.options import DockerOptions
from skytether.orchestrator.runtimes.egress import resolve


def options(**given: Any) -> DockerOptions:
    return DockerOptions.model_validate(given)


def spec(**given: Any) -> ServiceSpec:
    return ServiceSpec.model_validate({"image": "toy", **given})


def opens(pattern: str, wanted: str) -> bool:
    return refusal(spec(needs={"egress": [wanted]}), options(egress=[pattern])) is None


@pytest.mark.parametrize(
    ("pattern", "wanted"),
    [
        ("192.0.2.*", "192.0.2.0/0:25"),
        ("192.0.2.*", "192.0.2.0/0:25/tcp"),
        ("192.0.2.*", "192.0.2.evil.com:443"),
        ("192.0.2.*", "192.0.2.0/23:25"),
        ("192.0.2.*:443/tcp", "192.0.2.7:443/udp"),
        ("192.0.2.0/24:*", "192.0.3.7:443"),
        ("192.0.2.?", "192.0.2.0/31:1"),
        ("192.0.2.?", "192.0.2.17:1"),
        ("192.0.2.7*", "192.0.2.7/0:1"),
        ("*.0.2.7", "10.0.2.7.evil.com:1"),
        ("127.*", "127.1:80"),
        ("*.*", "127.1:80"),
        ("*x*", "0x7f000001:80"),
        ("*", "2130706433:80"),
        ("*", "192.0.2.7/24:80"),
        ("*", "[2001:db8::7/32]:80"),
        ("*.example.org:443", "10.0.0.1:443"),
        ("[2001:db8::/32]:123/udp", "[2001:db9::7]:123/udp"),
        ("[2001:db8::*]:123/udp", "[2001:db8::/16]:123/udp"),
        ("[2001:db8::*]", "192.0.2.7:1"),
        ("192.0.2.*", "[2001:db8::7]:1"),
        ("[2001:db8::7]:123/udp", "2:123/udp"),
        ("*.example.org:443/tcp", "api.example.org.evil.com:443"),
        ("api.example.org:443/tcp", "api.example.org:4430"),
        ("*:443/tcp", "192.0.2.7:80"),
    ],
)
def test_a_pattern_opens_nothing_else(pattern: str, wanted: str) -> None:
    assert not opens(pattern, wanted)


@pytest.mark.parametrize(
    ("pattern", "wanted"),
    [
        ("192.0.2.*", "192.0.2.7:25"),
        ("192.0.2.*", "192.0.2.0/25:25/udp"),
        ("192.0.2.*/udp", "192.0.2.7:25/udp"),
        ("10.*:1883", "10.1.0.0/16:1883"),
        ("10.*.*:1883/*", "10.1.2.3:1883"),
        ("10.0.?.7", "10.0.3.7:1"),
        ("192.0.2.0/24:44*/tcp", "192.0.2.128/25:443"),
        ("192.0.2.7:*", "192.0.2.7:1/udp"),
        ("0.0.0.0/0", "192.0.2.7:1"),
        ("*", "0.0.0.0/0:1"),
        ("*:443/tcp", "[::/0]:443"),
        ("[2001:DB8::/32]:123/udp", "[2001:db8:1::/48]:123/udp"),
        ("[2001:db8::*]", "[2001:db8:0::7]:1"),
        ("*.Example.org:443/tcp", "API.example.org:443"),
        ("*.example.org", "a.b.example.org:1/udp"),
        ("localhost:1/tcp", "localhost:1"),
        ("[ab].example.org:1", "b.example.org:1"),
    ],
)
def test_a_pattern_opens_what_it_says(pattern: str, wanted: str) -> None:
    assert opens(pattern, wanted)


def test_the_filter_lets_out_what_is_opened_and_answers() -> None:
    assert "policy drop" in rules({})
    assert rules({}).count(" accept") == 3  # loopback, answers, neighbours
    names = ("192.0.2.7:443", "192.0.2.0/24:53/udp", "[2001:db8::7]:8883", "[2001:db8::/32]:123/udp")
    made = rules(resolve(map(Opening.of, names)))
    for wanted in (
        "ip daddr 192.0.2.7/32 tcp dport 443 accept",
        "ip daddr 192.0.2.0/24 udp dport 53 accept",
        "ip6 daddr 2001:db8::7/128 tcp dport 8883 accept",
        "ip6 daddr 2001:db8::/32 udp dport 123 accept",
    ):
        assert wanted in made


def test_a_name_is_looked_up(monkeypatch: pytest.MonkeyPatch) -> None:
    def look_up(host: str, port: int, **_: Any) -> list[Any]:
        if host == "nowhere.example":
            raise socket.gaierror("unknown")
        return [(0, 0, 0, "", (f"192.0.2.{n}", port)) for n in (1, 2, 1)]

    monkeypatch.setattr(socket, "getaddrinfo", look_up)
    found = resolve([Opening.of("API.example:443")])
    assert found == {Opening("api.example", 443): ("192.0.2.1", "192.0.2.2")}
    with pytest.raises(RuntimeFailure, match=r"needs\.egress: nowhere\.example has no address"):
        resolve([Opening.of("nowhere.example:443")])


def test_two_ports_of_a_name_have_the_same_addresses(monkeypatch: pytest.MonkeyPatch) -> None:
    turns = iter(range(1, 9))  # a server that tells each who asks another address
    monkeypatch.setattr(socket, "getaddrinfo", lambda *_, **__: [(0, 0, 0, "", (f"192.0.2.{next(turns)}", 0))])
    found = resolve(map(Opening.of, ("api.example:443", "api.example:8883", "b.example:1", "api.example:53/udp")))
    assert [found[Opening.of(f"api.example:{port}")] for port in ("443", "8883", "53/udp")] == [("192.0.2.1",)] * 3
    assert found[Opening.of("b.example:1")] == ("192.0.2.2",)


def test_an_address_of_this_machines_own_links_is_none_within(monkeypatch: pytest.MonkeyPatch) -> None:
    told = ["fe80::1%eth0", "2001:db8::7"]
    monkeypatch.setattr(socket, "getaddrinfo", lambda *_, **__: [(0, 0, 0, "", (a, 0, 0, 2)) for a in told])
    assert resolve([Opening.of("near.example:1")]) == {Opening.of("near.example:1"): ("2001:db8::7",)}
    told.pop()
    with pytest.raises(RuntimeFailure, match="no address but of this machine's own links"):
        resolve([Opening.of("near.example:1")])


def test_a_name_server_that_is_silent_holds_a_start_up_for_so_long_only(monkeypatch: pytest.MonkeyPatch) -> None:
    awake = threading.Event()
    monkeypatch.setattr(socket, "getaddrinfo", lambda *_, **__: awake.wait(20) and [])
    with pytest.raises(RuntimeFailure, match=r"needs\.egress: the name server does not answer in time"):
        resolve([Opening.of("slow.example:443"), Opening.of("192.0.2.7:1")], within_s=0.02)
    awake.set()


def test_a_site_opens_what_its_operator_says() -> None:
    wants = spec(needs={"egress": ["api.example.org:443", "192.0.2.7:123/udp"]})
    assert refusal(wants, options()) == (
        "the site lets nobody connect to api.example.org:443/tcp, 192.0.2.7:123/udp: "
        "add it to the site's option 'egress'"
    )
    assert refusal(wants, options(egress=["*.example.org:443/tcp", "192.0.2.*:123/udp"])) is None
    assert refusal(wants, options(egress=["*"])) is None
    for wrong in (
        "api.example.org",
        "api:0",
        "api:70000",
        "http://api:1",
        "192.0.2.300/24:1",
        "a b:1",
        "-x:1",
        "x:1/sctp",
    ):
        with pytest.raises(ValidationError):
            spec(needs={"egress": [wrong]})
