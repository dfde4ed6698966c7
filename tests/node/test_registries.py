"""A pull does not have the engine ask the machine that it runs on, unless whoever joined it said so."""

from __future__ import annotations

import asyncio
import socket
import threading
from typing import Any

import pytest

from skytether.node.machine import own_addresses
from skytether.node.registries import Registries, registry_of


def refusal(image: str, named: tuple[str, ...] = ()) -> str | None:
    return asyncio.run(Registries(named).refusal(image))


@pytest.fixture
def names(monkeypatch: pytest.MonkeyPatch) -> dict[str, list[str]]:
    """Addresses of names."""
    known: dict[str, list[str]] = {}

    def getaddrinfo(host: str, *_: Any, **__: Any) -> list[Any]:
        if host not in known:
            raise socket.gaierror(socket.EAI_NONAME, "not known")
        return [(socket.AF_INET, socket.SOCK_STREAM, 6, "", (address, 0)) for address in known[host]]

    monkeypatch.setattr(socket, "getaddrinfo", getaddrinfo)
    return known


@pytest.mark.parametrize(
    ("image", "registry"),
    [
        ("debian", "docker.io"),
        ("somebody/app", "docker.io"),
        ("localhost/app", "localhost"),
        ("registry.example/a/b", "registry.example"),
        ("walker:5000/app", "walker:5000"),
        ("LOCALHOST/app", "LOCALHOST"),
        ("Walker/app", "Walker"),
    ],
)
def test_the_registry_is_the_one_that_an_engine_asks(image: str, registry: str) -> None:
    assert registry_of(image) == registry


@pytest.mark.parametrize(
    "address", ["127.0.0.1", "127.9.9.9", "0.0.0.0", "169.254.169.254", "::1", "::", "fe80::1%2", "::ffff:127.0.0.1"]
)
def test_a_name_that_leads_to_this_machine_is_refused(names: dict[str, list[str]], address: str) -> None:
    names["evil.example"] = ["192.0.2.7", address]
    assert "is this machine" in str(refusal("evil.example:8080/x"))


def test_its_addresses_in_networks_are_this_machine_too(names: dict[str, list[str]]) -> None:
    for address in own_addresses():
        if ":" not in address and address.count(".") == 3:
            names["evil.example"] = [address]
            assert "is this machine" in str(refusal("evil.example/x"))


def test_this_machine_is_not_asked_by_its_name_in_capitals(names: dict[str, list[str]]) -> None:
    """With a hub that is elsewhere, and that may be all that was named."""
    names["docker.io"], names["LOCALHOST"] = ["192.0.2.8"], ["127.0.0.1"]
    assert "is this machine" in str(refusal("LOCALHOST/app"))
    assert "nobody named the registry" in str(refusal("LOCALHOST/app", ("docker.io",)))


def test_elsewhere_is_good_and_what_is_not_found_is_the_engine_s_to_say(names: dict[str, list[str]]) -> None:
    names["docker.io"] = ["192.0.2.8"]
    assert refusal("debian") is None
    assert refusal("nowhere.example/x") is None


def test_what_is_named_is_all(names: dict[str, list[str]]) -> None:
    named = ("localhost:5000", "registry.example")
    names["localhost"] = ["127.0.0.1"]
    assert refusal("localhost:5000/app", named) is None
    assert refusal("registry.example/app", named) is None
    for image in ("debian", "localhost/app", "localhost:5001/app", "registry.example:444/app", "Walker/app"):
        assert "nobody named the registry" in str(refusal(image, named))


def test_names_that_take_for_ever_hold_up_few_others(monkeypatch: pytest.MonkeyPatch) -> None:
    """As of a domain whose name server does not answer."""
    hang = threading.Event()

    def find(host: str, *_: object, **__: object) -> list[tuple[object, ...]]:
        if "slow" in host:
            hang.wait(60)
        return [(0, 0, 0, "", ("192.0.2.8", 0))]

    monkeypatch.setattr(socket, "getaddrinfo", find)

    async def many() -> None:
        judge = Registries(resolve_s=0.2)
        slow = asyncio.gather(*(judge.refusal(f"a{i}.slow.example/x") for i in range(200)))
        await asyncio.sleep(0.05)
        assert await judge.refusal("good.elsewhere/x") is None
        assert await judge.refusal("192.0.2.9:5000/x") is None
        assert "this machine" in str(await judge.refusal("127.0.0.1:5000/x"))
        assert all("cannot be found in time" in str(one) for one in await slow)
        more = [judge.refusal(f"a.slow{i}/x") for i in range(40)]
        assert all("cannot be found in time" in str(one) for one in await asyncio.gather(*more))
        assert await judge.refusal("good.elsewhere/x") is None, "it was found before"
        assert await asyncio.to_thread(lambda: "elsewhere") == "elsewhere"
        hang.set()

    asyncio.run(many())
