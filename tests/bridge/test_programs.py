"""Ends of a session as the programs that people start, each in a network of its own, on one clock."""

import contextlib

import pytest
from networks import Program, cable, masquerade

from skytether.cli.commands.bridge.config import write_new_key
from skytether.emulator.link_model import LinkConditions
from skytether.lab.netns import Namespace
from skytether.lab.tun import SERVICE, TunEmulator

pytestmark = pytest.mark.slow

ID = "00000000000000a7"
TOPICS = [
    {"name": "up", "type": "t/msg/T", "direction": "in", "priority": 100, "lifespan_ms": 500, "depth": 10,
     "delivery": 0.9999, "paths": "redundant"},
    {"name": "down", "type": "t/msg/T", "direction": "out", "priority": 100, "lifespan_ms": 500, "depth": 10,
     "delivery": 0.9999, "paths": "redundant"},
]  # fmt: skip
CLOUD = "198.51.100.9"


class Ends:
    """Starts programs and sees to it that none is left."""

    def __init__(self, folder):
        self.folder = folder
        self.programs = []
        write_new_key(folder / "key")

    def start(self, where, command, **config):
        program = Program(where, command, self.folder, config)
        self.programs.append(program)
        return program

    def end(self, where, role, topic, **config):
        """One end, which publishes 128 bytes at 100 Hz."""
        sources = [{"topic": topic, "size": 128, "rate_hz": 100}]
        return self.start(
            where, "bridge", role=role, id=ID, key_file="key", topics=TOPICS, sources=sources, **config
        )  # fmt: skip

    def service(self, where, address, port=8700):
        return self.end(where, "service", "down", bind={"host": address, "port": port})

    def robot(self, where, address, port=8700, **config):
        return self.end(
            where, "robot", "up", bind={"host": "0.0.0.0"}, peer={"host": address, "port": port}, **config
        )  # fmt: skip


@pytest.fixture
def ends(tmp_path):
    made = Ends(tmp_path)
    yield made
    for program in made.programs:
        program.kill()


def row(told, topic):
    return next(t for t in told["topics"] if t["topic"] == topic)


def connected(told):
    return told["connected"] and told["paths"][0]["rtt"] is not None


@pytest.fixture
def homes(nftables):
    """A robot with two networks, each behind a router that masquerades, and a cloud."""
    with contextlib.ExitStack() as stack:
        robot, cloud, *routers = (stack.enter_context(Namespace()) for _ in range(4))
        for i, (router, device) in enumerate(zip(routers, ("wlan0", "wwan0"), strict=True)):
            router.sysctl("net.ipv4.ip_forward", "1")
            cable(router, robot, ("lan", f"10.0.{i}.1/24"), (device, f"10.0.{i}.2/24"))
            cable(router, cloud, ("wan", f"192.0.2.{100 * i + 1}/30"), (f"eth{i}", f"192.0.2.{100 * i + 2}/30"))
            robot.ip("route", "add", "default", "via", f"10.0.{i}.1", "dev", device, "metric", str(i + 1))
            router.ip("route", "add", f"{CLOUD}/32", "via", f"192.0.2.{100 * i + 2}")
            masquerade(router, "wan", 20_000 + 1000 * i)
        cloud.ip("address", "add", f"{CLOUD}/32", "dev", "lo")
        yield robot, cloud, routers


def test_an_address_that_changes_in_mid_stream(homes, ends):
    robot_home, cloud, routers = homes
    service = ends.service(cloud, CLOUD)
    robot = ends.robot(robot_home, CLOUD)
    before = service.wait(lambda told: connected(told) and row(told, "up")["delivered"] > 50)
    robot.wait(lambda told: connected(told) and row(told, "down")["delivered"] > 50)
    first = before["paths"][0]["address"]
    masquerade(routers[0], "wan", 40_000)
    after = service.wait(lambda told: told["paths"][0]["address"][1] >= 40_000)
    assert after["paths"][0]["address"][1] != first[1]
    for program, topic in ((service, "up"), (robot, "down")):
        told = program.wait_more(2)
        assert told["connected"]
        assert told["handshakes"] == 1
        # The router has no rules for some milliseconds, or for as long as a busy machine takes to load others.
        assert row(told, topic)["lost"] <= 100
        assert row(told, topic)["delivered"] > 150
        # One machine has one clock, so the true offset is 0.
        assert abs(told["clock_offset"]) <= told["clock_error"] + 2e-6


def test_one_way_delays_are_true_within_their_error_at_both_ends(netns, ends):
    up, down = 0.03, 0.01
    with TunEmulator(up=LinkConditions(delay=up), down=LinkConditions(delay=down)) as link:
        service = ends.service(link.service, SERVICE)
        robot = ends.robot(link.robot, SERVICE)
        for program, other in ((service, robot), (robot, service)):
            other.wait(connected)
            told = program.wait(lambda told: connected(told) and min(t["delivered"] for t in told["topics"]) > 100)
            assert abs(told["clock_offset"]) <= told["clock_error"] + 2e-6
            for topic, true in (("up", up), ("down", down)):
                measured = row(told, topic)
                # Never less than the truth by more than the error; more by what threads of a busy machine add.
                assert measured["delay_p50"] >= true - measured["delay_error"] - 0.002
                assert measured["delay_p50"] <= true + measured["delay_error"] + 0.03
                assert measured["delay_error"] <= (up + down) / 2 + 0.03


def test_a_robot_with_two_networks_two_routers_and_a_relay(homes, ends):
    robot_home, cloud, routers = homes
    service = ends.service(cloud, "127.0.0.1", 8701)
    ends.start(
        cloud, "relay", listen={"host": CLOUD, "port": 8700},
        routes=[{"id": ID, "target": {"host": "127.0.0.1", "port": 8701}}],
    )  # fmt: skip
    robot = ends.robot(robot_home, CLOUD, paths=[{"local": "wlan0"}, {"local": "wwan0", "cost": 10}])

    def both(told):
        return [path["health"] for path in told["paths"]] == ["live", "live"]

    for program, topic in ((service, "up"), (robot, "down")):
        program.wait(lambda told, topic=topic: both(told) and row(told, topic)["delivered"] > 50)
    masquerade(routers[1], "wan", 50_000)  # the second network's binding changes, then the first network breaks
    robot.wait_more(2)
    service.wait(both)
    before = {program: row(program.told[-1], topic)["lost"] for program, topic in ((service, "up"), (robot, "down"))}
    routers[0].ip("link", "set", "lan", "down")
    for program in (service, robot):
        program.wait(lambda told: [p["active"] for p in told["paths"] if p["path"] == 1] == [True])
    for program, topic in ((service, "up"), (robot, "down")):
        told = program.wait_more(2)
        assert told["connected"]
        assert told["handshakes"] == 1
        assert row(told, topic)["lost"] - before[program] <= 5  # none, but for a machine too busy to send
