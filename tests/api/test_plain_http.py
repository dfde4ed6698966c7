"""Tokens do not leave the machine in clear, unless somebody said so."""

from __future__ import annotations

import pytest

from skytether.api.client import Client, Unreachable
from skytether.api.plain_http import is_allowed, is_loopback, is_readable_on_the_way
from skytether.cli.connection import transport

HERE = ["http://127.0.0.1:8600", "http://[::1]:1", "http://localhost:8600", "http://0.0.0.0:8600", "http://[::]:8600"]
AWAY = [
    "http://192.0.2.7:8600",
    "HTTP://192.0.2.7",
    "http://[2001:db8::1]:8600",
    "http://cloud:8600",
    "http://127.0.0.1@192.0.2.7",
    "http://localhost.example.org",
    "http://127.0.0.1.example.org",
    " http://192.0.2.7",
]


@pytest.mark.parametrize("url", [*HERE, "https://192.0.2.7", "ftp://x", "http://[::1", ""])
def test_what_nobody_on_the_way_can_read(url: str) -> None:
    assert not is_readable_on_the_way(url)


@pytest.mark.parametrize("url", AWAY)
def test_a_client_asks_nobody_elsewhere_without_tls(url: str) -> None:
    assert is_readable_on_the_way(url)
    for urls in (url, f"https://a:1,{url}", f"{HERE[0]}, {url}"):
        with pytest.raises(
            Unreachable, match=r"could be read on the way: write https://.*SKYTETHER_INSECURE_HTTP=true"
        ):
            Client(urls, "token")
    Client(url, "token", insecure_http=True).close()


def test_what_the_environment_allows(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("SKYTETHER_INSECURE_HTTP", raising=False)
    assert not transport("http://cloud:8600")["insecure_http"]
    assert transport(None)["insecure_http"], "the orchestrator of this machine, by the address that it wrote down"
    monkeypatch.setenv("SKYTETHER_INSECURE_HTTP", "true")
    assert transport("http://cloud:8600")["insecure_http"]
    assert not any(map(is_allowed, (None, "", "0", "false", "no", "maybe")))


def test_only_loopback_is_loopback() -> None:
    assert all(map(is_loopback, ("127.0.0.1", "127.1.2.3", "::1", "localhost")))
    assert not any(map(is_loopback, ("0.0.0.0", "::", "192.0.2.7", "cloud", "")))
