"""Links with a small MTU, for real: two network namespaces and a veth pair."""

import pytest
from networks import cable, nft

from skytether.lab.netns import Namespace
from skytether.wire.topic import Role

pytestmark = pytest.mark.slow

FAMILIES = {"ipv4": ("10.0.2.2", "10.0.2.1", 24, "0.0.0.0"), "ipv6": ("fd00:2::2", "fd00:2::1", 64, "::")}
LARGE = bytes(range(256)) * 200


class Link:
    """A robot and a cloud, one cable."""

    def __init__(self, robot, cloud, family):
        self.robot, self.cloud, self.family = robot, cloud, family
        near, self.address, prefix, self.any = FAMILIES[family]
        cable(robot, cloud, ("eth0", f"{near}/{prefix}"), ("eth0", f"{self.address}/{prefix}"))

    def narrow(self, mtu):
        for end in (self.robot, self.cloud):
            end.ip("link", "set", "eth0", "mtu", str(mtu))

    def swallow(self, mtu):
        """Drop what is larger on its way to the cloud, and tell nobody."""
        self.robot.ip("link", "set", "eth0", "gso_max_segs", "1")  # or the rule would see batches before they are cut
        nft(
            self.cloud,
            f"""table inet f {{
                chain i {{
                    type filter hook input priority 0; policy accept;
                    meta length > {mtu} drop
                }}
            }}""",
        )


@pytest.fixture(params=FAMILIES)
def link(nftables, request):
    with Namespace() as robot, Namespace() as cloud:
        yield Link(robot, cloud, request.param)


def start(link, ends):
    service = ends.make(Role.SERVICE, bind=(link.address, 0))
    link.cloud.run(service.start)
    robot = ends.make(Role.ROBOT, bind=(link.any, 0), peer=service.address)
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
    narrow, found = (900, 800) if link.family == "ipv4" else (1280, 1200)  # less than that is no IPv6
    link.narrow(narrow)
    service, robot = start(link, ends)
    wait_for(lambda: mtu_of(robot) == mtu_of(service) == found, 30)
    arrives(robot, service)
    wait_for(lambda: robot.stats().rejected.get("socket_emsgsize", 0) > 0, 30)
    assert robot.stats().rejected["socket_emsgsize"] > 0


def test_a_path_that_swallows_large_packets_in_silence_is_found_out(link, ends, wait_for):
    link.swallow(900)
    service, robot = start(link, ends)
    wait_for(lambda: mtu_of(robot) == 800, 30)
    arrives(robot, service)


def test_one_that_gets_small_in_mid_stream_is_found_out_too(link, ends, wait_for):
    service, robot = start(link, ends)
    wait_for(lambda: mtu_of(robot) == mtu_of(service) == 1400, 30)
    arrives(robot, service)
    link.swallow(700)
    robot.publish("camera", LARGE)  # lost: its packets fit no longer
    wait_for(lambda: mtu_of(robot) == 600, 30)
    arrives(robot, service)
