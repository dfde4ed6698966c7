"""Links with a small MTU, for real: two network namespaces and a veth pair."""

import subprocess

import pytest

from skytether.lab.netns import Namespace
from skytether.wire.topic import Role

pytestmark = pytest.mark.slow

ROBOT, CLOUD = "10.0.2.2", "10.0.2.1"
LARGE = bytes(range(256)) * 200


class Link:
    """A robot and a cloud, one cable."""

    def __init__(self, robot, cloud):
        self.robot, self.cloud = robot, cloud
        cloud.ip("link", "add", "eth0", "type", "veth", "peer", "name", "eth0", "netns", robot.path)
        for end, address in ((robot, ROBOT), (cloud, CLOUD)):
            end.ip("address", "add", f"{address}/24", "dev", "eth0")
            end.ip("link", "set", "eth0", "up")

    def narrow(self, mtu):
        for end in (self.robot, self.cloud):
            end.ip("link", "set", "eth0", "mtu", str(mtu))

    def swallow(self, mtu):
        """Drop what is larger on its way to the cloud, and tell nobody."""
        rules = f"""table ip f {{
            chain i {{
                type filter hook input priority 0; policy accept;
                meta length > {mtu} drop
            }}
        }}"""
        self.robot.ip("link", "set", "eth0", "gso_max_segs", "1")  # or the rule would see batches before they are cut
        self.cloud.run(lambda: subprocess.run(["nft", "-f", "-"], input=rules, text=True, check=True))


@pytest.fixture
def link(nftables):
    with Namespace() as robot, Namespace() as cloud:
        yield Link(robot, cloud)


def start(link, ends):
    service = ends.make(Role.SERVICE, bind=(CLOUD, 0))
    link.cloud.run(service.start)
    robot = ends.make(Role.ROBOT, bind=("0.0.0.0", 0), peer=service.address)
    link.robot.run(robot.start)
    robot.graph.wait_connected()
    service.graph.wait_connected()
    return service, robot


def mtu_of(end):
    return end.stats().paths[0].mtu


def arrives(robot, service):
    before = len(service.graph.messages)
    assert robot.publish("camera", LARGE)
    service.graph.wait_messages(before + 1)


def test_what_this_machine_knows_to_be_small_is_never_exceeded_for_long(link, ends, wait_for):
    link.narrow(900)
    service, robot = start(link, ends)
    wait_for(lambda: mtu_of(robot) == mtu_of(service) == 800)
    arrives(robot, service)
    assert robot.stats().rejected["socket_emsgsize"] > 0


def test_a_path_that_swallows_large_packets_in_silence_is_found_out(link, ends, wait_for):
    link.swallow(900)
    service, robot = start(link, ends)
    wait_for(lambda: mtu_of(robot) == 800)
    arrives(robot, service)


def test_one_that_gets_small_in_mid_stream_is_found_out_too(link, ends, wait_for):
    service, robot = start(link, ends)
    wait_for(lambda: mtu_of(robot) == mtu_of(service) == 1400)
    arrives(robot, service)
    link.swallow(700)
    robot.publish("camera", LARGE)  # lost: its packets fit no longer
    wait_for(lambda: mtu_of(robot) == 600, 10)
    arrives(robot, service)
