"""Sessions through relays, on real sockets."""

import os
import socket

import pytest

from skytether.bridge import BridgeError, Relay, RelayLimits
from skytether.bridge.datagrams import DatagramSocket
from skytether.emulator.udp_link import LinkEmulator
from skytether.wire.codec import packet
from skytether.wire.events import Connected, PeerMoved
from skytether.wire.topic import Role

LOCAL = ("127.0.0.1", 0)
HELLO = bytes([packet.HELLO])
SESSION = "0000000000000007"
"""Of the fixture `ends`."""


@pytest.fixture
def relays():
    """Starts relays on loopback, and stops them."""
    made = []

    def start(*routes, **options):
        relay = Relay(options.pop("bind", LOCAL), **options)
        made.append(relay)
        relay.start()
        for sessions, (host, port) in routes:
            relay.add(sessions, host, port)
        return relay

    yield start
    for relay in made:
        relay.stop()


@pytest.fixture
def through(ends):
    """A service and a robot that speaks to some relay, connected."""

    def join(service, address):
        robot = ends.start(Role.ROBOT, peer=address)
        robot.graph.wait_connected()
        service.graph.wait_connected()
        return robot

    return join


def exchange(service, robot, size=50_000):
    """A message each way."""
    up, down = os.urandom(size), os.urandom(size)
    seen = len(service.graph.messages), len(robot.graph.messages)
    assert robot.publish("camera", up)
    assert service.publish("cmd_vel", down)
    service.graph.wait(lambda port: ("camera", up) in port.messages[seen[0] :])
    robot.graph.wait(lambda port: ("cmd_vel", down) in port.messages[seen[1] :])


def test_messages_of_every_size_arrive_both_ways(ends, relays, through):
    service = ends.start(Role.SERVICE)
    relay = relays((SESSION, service.address))
    robot = through(service, relay.address)
    for size in (0, 1200, 47_611, 1_000_000):
        exchange(service, robot, size)
    stats = relay.stats()
    assert set(stats.sessions) == {SESSION}
    flow = stats.sessions[SESSION]
    assert flow.bytes_up > 1_048_811
    assert flow.bytes_down > 1_048_811
    assert flow.packets_up > 700  # of up to 1,400 bytes
    assert flow.addresses == (f"127.0.0.1:{robot.address[1]}",)
    assert not stats.rejected


def test_robot_to_robot_to_cloud(ends, relays, through, wait_for):
    service = ends.start(Role.SERVICE)
    cloud = relays(("*", service.address))
    buddy = relays((SESSION, cloud.address))
    robot = through(service, buddy.address)
    exchange(service, robot)
    for relay in (cloud, buddy):
        wait_for(lambda relay=relay: set(relay.stats().sessions) == {SESSION})


def test_two_sessions_on_one_port_go_to_their_services(ends, relays):
    services = [ends.start(Role.SERVICE, session_id=i) for i in (1, 2)]
    relay = relays(*((f"{i:016x}", s.address) for i, s in enumerate(services, 1)))
    robots = [ends.start(Role.ROBOT, session_id=i, peer=relay.address) for i in (1, 2)]
    for service, robot in zip(services, robots, strict=True):
        robot.graph.wait_connected()
        service.graph.wait_connected()
    for service, robot in zip(services, robots, strict=True):
        exchange(service, robot)
    assert set(relay.stats().sessions) == {"0000000000000001", "0000000000000002"}
    assert all(len(end.graph.messages) == 1 for end in (*services, *robots))
    # A greedy session meets its own bound; the other one is not held up by it.
    services[0].stop()
    exchange(services[1], robots[1])


def test_a_robot_that_roams_behind_a_relay_stays_in_its_session(ends, relays, through):
    service = ends.start(Role.SERVICE)
    relay = relays((SESSION, service.address))
    with LinkEmulator(relay.address) as nat:
        robot = through(service, nat.address)
        exchange(service, robot)
        for _ in range(3):
            before = service.graph.count(PeerMoved)
            nat.rebind()
            service.graph.wait(lambda port, before=before: port.count(PeerMoved) > before)
            exchange(service, robot)
        assert robot.graph.count(Connected) == service.graph.count(Connected) == 1


def test_a_relay_that_restarts_is_found_again_and_the_session_goes_on(ends, relays, through, wait_for):
    service = ends.start(Role.SERVICE)
    relay = relays((SESSION, service.address))
    robot = through(service, relay.address)
    relay.stop()
    again = relays((SESSION, service.address), bind=relay.address)
    service.graph.wait(lambda port: port.count(PeerMoved))
    wait_for(lambda: again.stats().sessions)  # the robot's next ping after the first answer
    exchange(service, robot)
    assert robot.graph.count(Connected) == service.graph.count(Connected) == 1
    assert again.address == relay.address


def test_a_service_that_moves_is_followed_by_its_route(ends, relays, through):
    first = ends.start(Role.SERVICE)
    relay = relays((SESSION, first.address))
    robot = through(first, relay.address)
    first.stop()
    second = ends.start(Role.SERVICE)
    relay.add(SESSION, *second.address)
    second.graph.wait_connected()
    robot.graph.wait_connected(2)
    exchange(second, robot)


def test_a_removed_route_ends_its_sessions_and_frees_their_ports(ends, relays, through, wait_for):
    service = ends.start(Role.SERVICE)
    relay = relays((SESSION, service.address))
    through(service, relay.address)
    files = len(os.listdir("/proc/self/fd"))
    assert relay.remove(SESSION)
    assert not relay.remove(SESSION)
    assert len(os.listdir("/proc/self/fd")) == files - 1
    wait_for(lambda: relay.stats().rejected.get("unknown", 0) > 0)
    assert relay.stats().sessions == {}


def test_floods_of_unknown_and_forged_packets_disturb_no_session(ends, relays, through):
    service = ends.start(Role.SERVICE)
    relay = relays((SESSION, service.address), limits=RelayLimits(rate_bps=80e6))
    robot = through(service, relay.address)
    answered = relay.stats().newcomers.packets_down  # the handshake
    strangers = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(100)]
    try:
        unknown, forged = b"\x10" + bytes(1100), HELLO + bytes.fromhex(SESSION) + os.urandom(1100)
        for _ in range(20):
            for stranger in strangers:
                stranger.sendto(unknown, relay.address)
                stranger.sendto(forged, relay.address)
            exchange(service, robot, 2000)
        stats = relay.stats()
        # Of 2,000 each; on a busy machine the system's own buffers drop a share of a flood.
        assert stats.rejected["unknown"] > 200
        assert stats.rejected["newcomers"] > 100  # made-up addresses begin at a bounded rate
        assert stats.legs <= 1 + RelayLimits().newcomers
        assert stats.newcomers.packets_down == answered  # no stranger was ever answered
        for stranger in strangers:
            stranger.setblocking(False)
            with pytest.raises(BlockingIOError):
                stranger.recv(2000)
        assert sum(n for reason, n in service.stats().rejected.items() if reason != "evicted") > 200
        assert robot.graph.count(Connected) == service.graph.count(Connected) == 1
        assert service.graph.count(PeerMoved) == 0
    finally:
        for stranger in strangers:
            stranger.close()


def test_who_is_not_the_target_cannot_speak_to_a_robot_through_its_leg(ends, relays, through, wait_for):
    service = ends.start(Role.SERVICE)
    relay = relays((SESSION, service.address))
    robot = through(service, relay.address)
    received = robot.stats().paths[0].packets_received
    leg = service.stats().paths[0].address
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        for _ in range(10):
            stranger.sendto(HELLO + bytes.fromhex(SESSION) + bytes(100), ("127.0.0.1", leg[1]))
    wait_for(lambda: relay.stats().rejected.get("stranger") == 10)
    assert not robot.stats().rejected
    assert robot.stats().paths[0].packets_received >= received


def test_without_descriptors_newcomers_are_refused_and_counted(ends, relays, through, monkeypatch, wait_for):
    service = ends.start(Role.SERVICE)
    relay = relays((SESSION, service.address))
    robot = through(service, relay.address)

    def refuse(*_args, **_options):
        raise OSError(24, "Too many open files")

    monkeypatch.setattr("skytether.bridge.relay.DatagramSocket", refuse)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        stranger.sendto(HELLO + bytes.fromhex(SESSION) + bytes(100), relay.address)
        wait_for(lambda: relay.stats().rejected.get("no_port") == 1)
    exchange(service, robot)
    assert relay.stats().legs == 1


def test_mistakes_are_one_clear_sentence_each(relays):
    relay = relays()
    host, port = relay.address
    with pytest.raises(BridgeError, match=f"cannot listen on UDP 127.0.0.1:{port}: Address already in use"):
        Relay(relay.address).start()
    with pytest.raises(BridgeError, match=r"target no\.such\.host\.invalid:1 has no address"):
        relay.add("*", "no.such.host.invalid", 1)
    with pytest.raises(BridgeError, match="is the relay itself"):
        relay.add("*", host, port)
    with pytest.raises(ValueError, match="16 hexadecimal digits"):
        relay.add("xyz", host, 1)
    with pytest.raises(BridgeError, match="started before"):
        relay.start()
    with pytest.raises(BridgeError, match="not running"):
        Relay(LOCAL).add("*", host, 1)
    relay.stop()
    relay.stop()
    with pytest.raises(BridgeError, match="not running"):
        relay.add("*", host, 1)
    assert relay.stats().sessions == {}


def test_ipv6_robots_reach_an_ipv4_service(ends, relays, through):
    try:
        DatagramSocket(("::1", 0)).close()
    except OSError:
        pytest.skip("no IPv6 here")
    service = ends.start(Role.SERVICE)
    relay = relays((SESSION, service.address), bind=("::1", 0))
    robot = ends.start(Role.ROBOT, bind=("::1", 0), peer=relay.address)
    robot.graph.wait_connected()
    service.graph.wait_connected()
    exchange(service, robot)
