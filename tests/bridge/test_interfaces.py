"""Which networks are used, and what happens as they come and go."""

import socket
import threading

import pytest

from skytether.bridge import interfaces
from skytether.bridge.interfaces import LocalPath, Network, Watcher, addresses, select
from skytether.emulator.udp_link import LinkConditions, LinkEmulator
from skytether.wire import PathSwitched, Role

PRESENT = {
    "lo": ["127.0.0.1"],
    "eth0": ["10.0.0.5"],
    "wlan0": ["192.168.1.7", "169.254.3.3"],
    "wwan0": ["100.64.0.9"],
    "docker0": ["172.17.0.1"],
}
TWO = (LocalPath("127.0.0.1"), LocalPath("127.0.0.2", cost=1))


def test_all_that_lead_out_are_found_wired_ones_first():
    assert select("auto", PRESENT) == {
        Network("eth0", "10.0.0.5"): LocalPath("eth0", 0),
        Network("wlan0", "192.168.1.7"): LocalPath("wlan0", 10),
        Network("wwan0", "100.64.0.9"): LocalPath("wwan0", 20),
    }


def test_listed_ones_are_found_by_name_or_address():
    wlan, wire, gone = LocalPath("wlan0", 3), LocalPath("10.0.0.5"), LocalPath("eth9")
    assert select((wlan, wire, gone), PRESENT) == {
        Network("wlan0", "192.168.1.7"): wlan,
        Network("eth0", "10.0.0.5"): wire,
    }
    assert set(select(TWO, PRESENT)) == {Network("lo", "127.0.0.1"), Network("lo", "127.0.0.2")}


@pytest.mark.parametrize(("fields", "says"), [({"local": ""}, "local"), ({"local": "a", "cost": 256}, "cost of a")])
def test_what_no_network_can_be_is_refused(fields, says):
    with pytest.raises(ValueError, match=says):
        LocalPath(**fields)


def test_this_machine_has_the_loopback_interface():
    assert "127.0.0.1" in [a for found in addresses(socket.AF_INET).values() for a in found]


def test_the_watcher_tells_changes_only(monkeypatch):
    monkeypatch.setattr(interfaces, "POLL_INTERVAL", 0.001)
    one, other = ({Network("a", "1"): LocalPath("a")}, {})
    looks, told, done = iter([one, one, other, other, one]), [], threading.Event()

    def look():
        found = next(looks, None)
        if found is None:
            done.set()
        return one if found is None else found

    watcher = Watcher(look, lambda found: told.append(found) or found, one)
    assert done.wait(5)
    watcher.close()
    assert told == [other, one]


def test_two_networks_one_of_which_is_cut(ends, wait_for):
    service = ends.start(Role.SERVICE)
    with (
        LinkEmulator(service.address, bind=("127.0.0.1", 0)) as first,
        LinkEmulator(service.address, bind=("127.0.0.2", 0)) as second,
    ):
        paths = [LocalPath(link.address[0], cost, link.address) for cost, link in enumerate((first, second))]
        robot = ends.start(Role.ROBOT, peer=first.address, paths=paths)
        robot.graph.wait_connected()
        wait_for(lambda: [p.health for p in robot.stats().paths] == ["live", "live"])
        wait_for(lambda: len(service.stats().paths) >= 2)
        assert robot.publish("force", b"before")
        cut = LinkConditions(cut=True)
        first.set(up=cut, down=cut)
        for i in range(20):
            assert robot.publish("force", str(i).encode())
        service.graph.wait_messages(21)
        wait_for(lambda: PathSwitched(2, "lost") in robot.graph.events)
        assert robot.graph.count(PathSwitched) == 1
        service.publish("cmd_vel", b"after")
        robot.graph.wait_messages(1)
    assert service.graph.messages[0] == ("force", b"before")


def test_networks_that_come_and_go_are_followed(ends, wait_for, monkeypatch):
    present = {"lo": ["127.0.0.1"]}
    monkeypatch.setattr(interfaces, "POLL_INTERVAL", 0.01)
    monkeypatch.setattr("skytether.bridge.endpoint.addresses", lambda _family: dict(present))
    service = ends.start(Role.SERVICE)
    robot = ends.start(Role.ROBOT, peer=service.address, paths=(LocalPath("eth7"), LocalPath("127.0.0.1")))
    robot.graph.wait_connected()
    assert [p.path for p in robot.stats().paths] == [1]
    present["eth7"] = ["127.0.0.3"]
    wait_for(lambda: [p.path for p in robot.stats().paths] == [1, 2])
    wait_for(lambda: any(p.address and p.address[0] == "127.0.0.3" for p in service.stats().paths))
    del present["lo"]
    wait_for(lambda: [p.path for p in robot.stats().paths] == [2])
    assert robot.publish("force", b"still here")
    service.graph.wait_messages(1)


def test_a_name_server_that_never_answers_keeps_no_path_waiting(ends, wait_for, monkeypatch):
    """A network comes whose peer has a name of its own: what is under way on the others goes on."""
    present = {"lo": ["127.0.0.1"]}
    monkeypatch.setattr(interfaces, "POLL_INTERVAL", 0.01)
    monkeypatch.setattr("skytether.bridge.endpoint.addresses", lambda _family: dict(present))
    asked, dead = threading.Event(), threading.Event()
    real = socket.getaddrinfo

    def ask(name, *arguments, **more):
        if name == "service.example":
            if more.get("flags", 0) & socket.AI_NUMERICHOST:
                raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")
            asked.set()
            dead.wait(60)
            name = "127.0.0.1"
        return real(name, *arguments, **more)

    monkeypatch.setattr(socket, "getaddrinfo", ask)
    service = ends.start(Role.SERVICE)
    paths = (LocalPath("127.0.0.1"), LocalPath("eth7", 1, ("service.example", service.address[1])))
    robot = ends.start(Role.ROBOT, peer=service.address, paths=paths)
    robot.graph.wait_connected()
    present["eth7"] = ["127.0.0.3"]
    assert asked.wait(30)
    for i in range(20):
        assert robot.publish("force", b"%d" % i)
        service.graph.wait_messages(i + 1)
    assert [p.path for p in robot.stats().paths] == [1]
    dead.set()
    wait_for(lambda: [p.path for p in robot.stats().paths] == [1, 2])


def test_without_any_network_the_first_socket_serves(ends):
    service = ends.start(Role.SERVICE)
    robot = ends.start(Role.ROBOT, peer=service.address, paths=(LocalPath("eth-none"),))
    robot.graph.wait_connected()
    assert [p.path for p in robot.stats().paths] == [0]


def test_only_the_robot_has_paths(ends):
    with pytest.raises(ValueError, match="only the robot's end"):
        ends.make(Role.SERVICE, paths="auto")
