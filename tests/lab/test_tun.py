"""Namespaces and the packet-level emulator, with real sockets in real namespaces."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Callable, Iterator

import pytest

from skytether.emulator.link_model import LinkConditions
from skytether.lab.netns import Namespace, NetworkError, enter
from skytether.lab.tun import ROBOT, SERVICE, TunEmulator

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("netns")]

UP, DOWN = 0.03, 0.01


@pytest.fixture
def link(netns: None) -> Iterator[TunEmulator]:
    with TunEmulator(up=LinkConditions(delay=UP), down=LinkConditions(delay=DOWN)) as emulator:
        yield emulator


def _bound(address: str, kind: int = socket.SOCK_DGRAM) -> Callable[[], socket.socket]:
    def make() -> socket.socket:
        sock = socket.socket(socket.AF_INET, kind)
        sock.settimeout(5)
        sock.bind((address, 0))
        return sock

    return make


def test_a_datagram_takes_the_delay_of_its_direction(link: TunEmulator) -> None:
    with link.robot.run(_bound(ROBOT)) as robot, link.service.run(_bound(SERVICE)) as service:
        start = time.monotonic()
        robot.sendto(b"up", service.getsockname())
        assert service.recvfrom(10) == (b"up", robot.getsockname())
        arrived = time.monotonic()
        service.sendto(b"down", robot.getsockname())
        assert robot.recv(10) == b"down"
        assert arrived - start >= UP
        assert time.monotonic() - arrived >= DOWN


def test_tcp_passes_whole_and_is_slowed_by_two_delays(link: TunEmulator) -> None:
    data = bytes(range(256)) * 400
    with link.service.run(_bound(SERVICE, socket.SOCK_STREAM)) as listener:
        listener.listen()
        start = time.monotonic()
        robot = link.robot.run(_bound(ROBOT, socket.SOCK_STREAM))
        with robot:
            robot.connect(listener.getsockname())
            assert time.monotonic() - start >= UP + DOWN
            peer, _ = listener.accept()
            with peer, peer.makefile("rb") as stream:
                robot.sendall(data)
                assert stream.read(len(data)) == data
    counters = link.counters()["up"]
    assert counters.forwarded > len(data) / 1500
    assert counters.bytes_received >= counters.bytes_forwarded > len(data)
    assert counters.lost == counters.failed == 0


def test_a_large_datagram_is_lost_with_any_of_its_fragments(link: TunEmulator) -> None:
    link.set(up=LinkConditions(loss=0.3))
    with link.robot.run(_bound(ROBOT)) as robot, link.service.run(_bound(SERVICE)) as service:
        for _ in range(20):
            robot.sendto(bytes(40_000), service.getsockname())
        service.settimeout(0.3)
        with pytest.raises(TimeoutError):
            service.recv(65_535)  # 28 fragments all arrive once in 20,000 times; the link's chances are seeded
        counters = link.counters()["up"]
        assert counters.received == 20 * 28
        assert 0 < counters.lost < counters.received


def test_a_cut_stops_what_is_under_way(link: TunEmulator) -> None:
    with link.robot.run(_bound(ROBOT)) as robot, link.service.run(_bound(SERVICE)) as service:
        robot.sendto(b"never", service.getsockname())
        link.set(up=LinkConditions(cut=True))
        service.settimeout(2 * UP)
        with pytest.raises(TimeoutError):
            service.recv(10)
        link.set(up=LinkConditions())
        service.settimeout(5)
        robot.sendto(b"again", service.getsockname())
        assert service.recv(10) == b"again"


def test_nothing_stays_behind(netns: None) -> None:
    with TunEmulator() as link:
        path = link.robot.path
        inode = os.stat(path).st_ino
        assert link.robot.run(_devices) == {"lo", "link0"}
    # the descriptor's number may be in use again by now, but not for that namespace
    assert not os.path.exists(path) or os.stat(path).st_ino != inode
    assert "link0" not in _devices()


def test_a_program_enters_by_path(netns: None) -> None:
    with Namespace() as outer, Namespace() as inner:

        def move() -> set[str]:
            enter(inner.path)
            return _devices()

        inner.ip("tuntap", "add", "dev", "here", "mode", "tun")
        assert outer.run(move) == {"lo", "here"}
        assert outer.run(_devices) == {"lo"}


def test_what_the_system_refuses_is_said_in_a_sentence(netns: None) -> None:
    with Namespace() as namespace:
        with pytest.raises(NetworkError, match="'ip link set nothing up' failed: Cannot find device"):
            namespace.ip("link", "set", "nothing", "up")
        with pytest.raises(NetworkError, match=r"sysctl net\.ipv4\.tcp_congestion_control=none failed"):
            namespace.sysctl("net.ipv4.tcp_congestion_control", "none")
        namespace.sysctl("net.ipv4.tcp_congestion_control", "reno")


def _devices() -> set[str]:
    return {name for _, name in socket.if_nameindex()}
