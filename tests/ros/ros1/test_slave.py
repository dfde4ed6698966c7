"""What strangers may have of a node: no end of it, no other publishers."""

from __future__ import annotations

import socket
import threading
import time
import xmlrpc.client
from typing import Any

import pytest

from skytether.ros.ros1.slave import MasterHost, SlaveServer


class Node:
    name = "/walker"
    master_uri = "http://127.0.0.1:11311"

    def __init__(self) -> None:
        self.told: list[Any] = []

    def publishers_changed(self, topic: str, uris: list[str]) -> None:
        self.told.append((topic, uris))

    def asked_to_end(self, reason: str) -> None:
        self.told.append(reason)

    def offered(self, topic: str) -> tuple[str, int] | None:
        return ("127.0.0.1", 7) if topic == "/scan" else None

    def publications(self) -> list[list[str]]:
        return []

    subscriptions = connections = publications


def asked(server: SlaveServer, way_from: str) -> xmlrpc.client.ServerProxy:
    """A connection from another address than the one that it goes to: else both are one machine."""

    class Transport(xmlrpc.client.Transport):
        def make_connection(self, host: Any) -> Any:
            connection = super().make_connection(host)
            connection.source_address = (way_from, 0)
            return connection

    return xmlrpc.client.ServerProxy(f"http://127.0.0.1:{server.port}", transport=Transport())


def test_only_the_masters_machine_ends_a_node_or_changes_its_publishers() -> None:
    node = Node()
    server = SlaveServer(node, "127.0.0.1", lambda address: address == "127.0.0.9")
    try:
        with asked(server, "127.0.0.2") as stranger:
            assert stranger.shutdown("/evil", "because") == [
                -1,
                "shutdown is taken from the machine of the master only",
                0,
            ]
            assert stranger.publisherUpdate("/evil", "/scan", ["http://evil:1"])[0] == -1  # type: ignore[index]
            assert stranger.requestTopic("/other", "/scan", [["TCPROS"]])[0] == 1  # type: ignore[index]
        assert node.told == []
        for friend in ("127.0.0.9", "127.0.0.1"):
            with asked(server, friend) as master:
                assert master.publisherUpdate("/master", "/scan", ["http://a:1"]) == [1, "", 0]
                assert master.shutdown("/master", "twice")[0] == 1  # type: ignore[index]
        assert node.told == [("/scan", ["http://a:1"]), "twice"] * 2
    finally:
        server.close()


def test_who_opens_connections_without_end_has_a_few_and_keeps_nobody_else_out() -> None:
    server = SlaveServer(Node(), "127.0.0.1", lambda address: False, most=32)
    threads = threading.active_count()
    held = []
    try:
        held += [socket.create_connection(("127.0.0.1", server.port), 10, ("127.0.0.2", 0)) for _ in range(40)]
        with asked(server, "127.0.0.3") as master:  # accepted after the 40, so these are dealt with
            assert master.getName("/master") == [1, "", "/walker"]
            assert threading.active_count() <= threads + 17
        kept, closed = held[:16], held[16:]
        assert [link.recv(1) for link in closed] == [b""] * 24
        for link in kept:
            link.close()
        end = time.monotonic() + 30
        while threading.active_count() > threads:
            assert time.monotonic() < end
            time.sleep(0.01)
        with asked(server, "127.0.0.2") as stranger:
            assert stranger.getName("/stranger") == [1, "", "/walker"]
    finally:
        for link in held:
            link.close()
        server.close()


def test_all_together_have_no_more_than_there_is() -> None:
    server = SlaveServer(Node(), "127.0.0.1", lambda address: False, most=3)
    try:
        held = [
            socket.create_connection(("127.0.0.1", server.port), 10, (f"127.0.0.{number}", 0)) for number in range(2, 6)
        ]
        assert held[-1].recv(1) == b""
        for link in held:
            link.close()
    finally:
        server.close()


def test_the_master_is_known_by_its_name(monkeypatch: pytest.MonkeyPatch) -> None:
    lookups: list[str] = []
    addresses = ["192.0.2.7", "2001:db8::7"]

    def look_up(host: str, _port: None) -> list[Any]:
        lookups.append(host)
        if not addresses:
            raise OSError
        return [(0, 0, 0, "", (address, 0)) for address in addresses]

    monkeypatch.setattr(socket, "getaddrinfo", look_up)
    now = [100.0]
    master = MasterHost("http://robot:11311", lambda: now[0])
    assert master("127.0.0.1")
    assert master("192.0.2.7")
    assert master("2001:db8::7")
    assert not any(master(f"198.51.100.{i}") for i in range(100))
    assert lookups == ["robot"], "others cannot make it ask again and again"
    now[0] += 11
    addresses.clear()
    assert master("192.0.2.7"), "the name server is away"
