"""Sessions through the NAT that Linux routers use: three network namespaces, nftables masquerade, conntrack.

    robot 10.0.1.2 ── 10.0.1.1 router 203.0.113.1 ── 203.0.113.9 cloud

The cloud has no way to 10.0.1.0: what reaches the robot went through the router's table of bindings.
"""

import contextlib
import socket
import subprocess
import threading
import time

import pytest
from networks import cable, masquerade, nft

from skytether.bridge import Relay, driver
from skytether.lab.netns import Namespace
from skytether.wire.events import Connected, Disconnected, PeerMoved
from skytether.wire.topic import Role

pytestmark = pytest.mark.slow

ROBOT, ROUTER_IN, ROUTER_OUT, CLOUD = "10.0.1.2", "10.0.1.1", "203.0.113.1", "203.0.113.9"
PERIOD = 0.01


class Nat:
    """The three namespaces."""

    def __init__(self, stack):
        self.robot, self.router, self.cloud = (stack.enter_context(Namespace()) for _ in range(3))
        cable(self.router, self.robot, ("lan", f"{ROUTER_IN}/24"), ("eth0", f"{ROBOT}/24"))
        cable(self.router, self.cloud, ("wan", f"{ROUTER_OUT}/24"), ("eth0", f"{CLOUD}/24"))
        self.robot.ip("route", "add", "default", "via", ROUTER_IN)
        self.router.sysctl("net.ipv4.ip_forward", "1")
        self.masquerade(20_000)

    def masquerade(self, first_port):
        masquerade(self.router, "wan", first_port)


@pytest.fixture
def nat(nftables):
    with contextlib.ExitStack() as stack:
        yield Nat(stack)


class Stream:
    """Publishes numbered messages at 100 Hz at one end, and keeps when."""

    def __init__(self, end, topic):
        self._end, self._topic = end, topic
        self.published = {}
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self):
        due = time.monotonic()
        while not self._stopped.is_set():
            number = len(self.published).to_bytes(4, "big")
            self.published[number] = time.monotonic()
            self._end.publish(self._topic, number)
            due += PERIOD
            self._stopped.wait(max(0.0, due - time.monotonic()))

    def lost(self, receiver):
        """When those messages were published that did not arrive."""
        self._stopped.set()
        self._thread.join()
        last = max(self.published)
        with contextlib.suppress(AssertionError):
            receiver.graph.wait(lambda port: (self._topic, last) in port.messages, 5)
        arrived = {payload for topic, payload in receiver.graph.messages if topic == self._topic}
        return [when for number, when in self.published.items() if number not in arrived]


@pytest.fixture
def session(nat, ends):
    """Service in the cloud and robot behind the router, connected."""
    service = ends.make(Role.SERVICE, bind=(CLOUD, 0))
    nat.cloud.run(service.start)
    robot = ends.make(Role.ROBOT, bind=("0.0.0.0", 0), peer=service.address)
    nat.robot.run(robot.start)
    robot.graph.wait_connected()
    service.graph.wait_connected()
    return service, robot


def peer_of(service):
    return service.stats().paths[0].address[:2]


def flow(service, robot, *events):
    """Both directions at 100 Hz through some events: what was lost, up and down, and when each began and ended."""
    up, down = Stream(robot, "force"), Stream(service, "cmd_vel")
    times = []
    time.sleep(0.2)
    for event in events:
        moved = service.graph.count(PeerMoved)
        began = time.monotonic()
        event()
        times.append((began, time.monotonic()))
        service.graph.wait(lambda port, moved=moved: port.count(PeerMoved) > moved, 30)
        time.sleep(0.3)
    return up.lost(service), down.lost(robot), times


def around(when, times):
    """Whether it happened in one of these times, or so little later as a busy machine needs to notice their end."""
    return any(began <= when < ended + 1.0 for began, ended in times)


def test_a_robot_behind_a_masquerade_is_served_where_the_router_says(nat, session):
    service, robot = session
    up, down, _ = flow(service, robot)
    assert up == down == []
    host, port = peer_of(service)
    assert host == ROUTER_OUT
    assert 20_000 <= port < 21_000


def test_bindings_changed_in_mid_stream_cost_what_was_in_flight_at_most(nat, session):
    service, robot = session
    changes = [lambda first=first: nat.masquerade(first) for first in (30_000, 40_000, 50_000)]
    up, down, times = flow(service, robot, *changes)
    assert peer_of(service)[1] // 1000 == 50
    # The router's rules are gone for some milliseconds while they are exchanged.
    for lost in (up, down):
        assert all(around(when, times) for when in lost)
    assert robot.graph.count(Connected) == service.graph.count(Connected) == 1
    assert robot.graph.count(Disconnected) == service.graph.count(Disconnected) == 0


def test_the_same_through_a_relay(nat, ends):
    service = ends.make(Role.SERVICE, bind=(CLOUD, 0))
    relay = Relay((CLOUD, 0))
    nat.cloud.run(service.start)
    nat.cloud.run(relay.start)
    try:
        relay.add("0000000000000007", *service.address)
        robot = ends.make(Role.ROBOT, bind=("0.0.0.0", 0), peer=relay.address)
        nat.robot.run(robot.start)
        robot.graph.wait_connected()
        service.graph.wait_connected()
        up, down, times = flow(service, robot, lambda: nat.masquerade(30_000))
        assert all(around(when, times) for when in up + down)
        (session,) = relay.stats().sessions.values()
        assert len(session.addresses) >= 2
        assert session.addresses[-1].startswith(f"{ROUTER_OUT}:30")
        assert robot.graph.count(Connected) == service.graph.count(Connected) == 1
    finally:
        relay.stop()


def test_a_router_that_restarts_costs_its_outage(nat, session):
    service, robot = session

    def restart():
        nat.router.ip("link", "set", "wan", "down")
        nat.masquerade(45_000)
        time.sleep(0.3)
        nat.router.ip("link", "set", "wan", "up")

    up, down, times = flow(service, robot, restart)
    assert up
    assert down
    assert all(around(when, times) for when in up + down)
    assert robot.graph.count(Connected) == service.graph.count(Connected) == 1


def test_another_address_of_the_robots_interface_is_the_same_session(nat, session):
    service, robot = session

    def move():
        nat.robot.ip("address", "add", "10.0.1.77/24", "dev", "eth0")
        nat.robot.ip("address", "del", f"{ROBOT}/24", "dev", "eth0")
        # Secondary addresses go with the first one, and routes with the last.
        nat.robot.ip("address", "replace", "10.0.1.77/24", "dev", "eth0")
        nat.robot.ip("route", "replace", "default", "via", ROUTER_IN)

    up, down, times = flow(service, robot, move)
    assert all(around(when, times) for when in up + down)
    assert robot.graph.count(Connected) == service.graph.count(Connected) == 1


def test_an_idle_session_keeps_its_binding_where_others_lose_theirs(nat, session):
    service, robot = session
    nat.router.sysctl("net.netfilter.nf_conntrack_udp_timeout", "1")
    nat.router.sysctl("net.netfilter.nf_conntrack_udp_timeout_stream", "1")
    nat.masquerade(25_000)
    service.graph.wait(lambda port: port.count(PeerMoved))

    def open_socket(address):
        sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        sock.bind((address, 0))
        sock.settimeout(5)
        return sock

    with nat.cloud.run(lambda: open_socket(CLOUD)) as far, nat.robot.run(lambda: open_socket(ROBOT)) as near:
        near.sendto(b"hello", far.getsockname())
        seen = far.recvfrom(100)[1]
        far.sendto(b"at once", seen)
        assert near.recv(100) == b"at once"
        time.sleep(3.5)  # twice what the router waits, which it rounds up
        far.sendto(b"later", seen)
        near.settimeout(0.3)
        with pytest.raises(TimeoutError):
            near.recv(100)
    assert service.publish("cmd_vel", b"later")
    robot.graph.wait(lambda port: ("cmd_vel", b"later") in port.messages)
    assert service.graph.count(PeerMoved) == 1


def test_a_load_balancer_that_comes_later_than_the_robot_is_got_through(nat, ends, monkeypatch):
    """Its rule is for new flows only; a robot that asks again and again from one port never is one."""
    monkeypatch.setattr(driver, "OTHER_PORT_S", 1.0)
    service = ends.make(Role.SERVICE, bind=(CLOUD, 0))
    nat.cloud.run(service.start)
    robot = ends.make(Role.ROBOT, bind=("0.0.0.0", 0), peer=("203.0.113.50", 7600))
    nat.robot.run(robot.start)
    listing = ["conntrack", "-L", "--proto", "udp", "--dst", "203.0.113.50"]
    limit = time.monotonic() + 5
    while not nat.router.run(lambda: subprocess.run(listing, capture_output=True, check=True)).stdout:
        assert time.monotonic() < limit
        time.sleep(0.02)
    chain = "type nat hook prerouting priority dstnat; policy accept;"
    rule = f"ip daddr 203.0.113.50 udp dport 7600 dnat to {CLOUD}:{service.address[1]}"
    nft(nat.router, f"table ip balancer {{\nchain before {{\n{chain}\n{rule}\n}}\n}}")
    robot.graph.wait_connected()
    service.graph.wait_connected()
    assert robot.graph.count(Connected) == 1
