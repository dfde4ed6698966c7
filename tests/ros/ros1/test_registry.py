"""What the master is told, with a made-up master."""

import threading

import pytest

from skytether.ros.ros1.master import MasterError, NonsenseError, RefusedError
from skytether.ros.ros1.node import own_host
from skytether.ros.ros1.registry import Registry


class FakeMaster:
    uri = "http://master:11311"

    def __init__(self):
        self.told = []
        self.here = True
        self.known = set()
        self.at = "http://me/"

    def knows(self, node):
        self.check()
        return self.at if self.known else ""

    def check(self):
        if not self.here:
            raise MasterError("nobody answers at http://master:11311: refused")


class Entry:
    def __init__(self, name, refused=False):
        self.name = name
        self.refused = refused
        self.nonsense = False
        self.missed = False

    def is_missed(self, master):
        self.check(master)
        return self.missed

    def check(self, master):
        master.check()
        if self.nonsense:
            raise NonsenseError("http://master:11311 does not speak as ROS does")

    def register(self, master):
        self.check(master)
        master.told.append(f"+{self.name}")
        if self.refused:
            raise RefusedError(f"{self.name} is not legal")
        master.known.add(self.name)

    def unregister(self, master):
        self.check(master)
        master.told.append(f"-{self.name}")
        master.known.discard(self.name)


@pytest.fixture
def master():
    return FakeMaster()


@pytest.fixture
def registry(master):
    return Registry(master, "/me", lambda: "http://me/")


def test_each_is_told_once_and_taken_back(master, registry):
    a, b = Entry("a"), Entry("b")
    registry.want(a)
    registry.want(b)
    for _ in range(3):
        registry.step()
    registry.drop(a)
    registry.step()
    assert master.told == ["+a", "+b", "-a"]
    assert registry.present


def test_a_master_that_forgot_us_is_told_everything_again(master, registry, caplog):
    registry.want(Entry("a"))
    registry.step()
    master.known.clear()
    registry.step()
    assert master.told == ["+a", "+a"]
    assert "was restarted" in caplog.text


def test_what_is_missed_is_told_the_master_again(master, registry):
    a, b = Entry("a"), Entry("b")
    registry.want(a)
    registry.want(b)
    registry.step()
    a.missed = True
    registry.step()
    a.missed = False
    registry.step()
    assert master.told == ["+a", "+b", "+a"]
    b.nonsense = True
    registry.step()
    assert not registry.present
    b.nonsense = False
    registry.step()
    assert registry.present


def test_another_node_of_our_name_is_told_from_a_master_that_was_restarted(master, registry, caplog):
    registry.want(Entry("a"))
    registry.step()
    master.at = "http://other/"
    registry.step()
    assert master.told == ["+a", "+a"]
    assert "knows /me at http://other/: end that node; registering again" in caplog.text
    assert "was restarted" not in caplog.text


def test_an_absent_master_is_named_once_and_so_is_its_return(master, registry, caplog):
    master.here = False
    registry.want(Entry("a"))
    for _ in range(100):
        registry.step()
    assert registry.present is False
    master.here = True
    for _ in range(100):
        registry.step()
    assert registry.present is True
    assert [record.message for record in caplog.records] == [
        "no ROS master answers: nobody answers at http://master:11311: refused; waiting for it",
        "the ROS master at http://master:11311 answers",
    ]
    assert master.told == ["+a"]


def test_what_the_master_refuses_is_named_once_and_the_others_are_told(master, registry, caplog):
    registry.want(Entry("bad", refused=True))
    registry.want(Entry("good"))
    registry.step()
    registry.step()
    assert master.told == ["+bad", "+good"]
    assert caplog.text.count("bad is not legal") == 1


def test_what_the_master_answers_nonsense_for_is_named_and_the_others_are_told(master, registry, caplog):
    scan, odom, joy = Entry("/scan"), Entry("/odom"), Entry("/joy")
    scan.nonsense = odom.nonsense = True
    for entry in (scan, odom, joy):
        registry.want(entry)
    for _ in range(100):
        registry.step()
    assert master.told == ["+/joy"]
    assert registry.present is False
    assert [record.message for record in caplog.records] == [
        f"the ROS master answers nonsense for {name}: http://master:11311 does not speak as ROS does; it is asked again"
        for name in ("/scan", "/odom")
    ]
    scan.nonsense = odom.nonsense = False
    registry.step()
    assert master.told == ["+/joy", "+/scan", "+/odom"]
    assert registry.present
    assert "answers" in caplog.records[-1].message
    scan.nonsense = True
    registry.drop(scan)
    registry.drop(joy)
    registry.step()
    assert master.told[3:] == ["-/joy"]
    assert caplog.records[-1].message.startswith("the ROS master answers nonsense for /scan")


def test_the_own_address_is_what_ros_says_or_the_way_to_the_master():
    assert own_host("http://localhost:11311", {"ROS_HOSTNAME": "walker", "ROS_IP": "10.0.0.2"}) == "walker"
    assert own_host("http://localhost:11311", {"ROS_IP": "10.0.0.2"}) == "10.0.0.2"
    assert own_host("http://127.0.0.1:11311", {}) == "127.0.0.1"
    assert own_host("http://no.such.host.invalid:11311", {}) == "127.0.0.1"


def test_what_is_wanted_is_taken_back_at_the_end_whatever_round_is_under_way(master, monkeypatch):
    began, go = threading.Event(), threading.Event()

    class Slow(Entry):
        def register(self, master):
            began.set()
            assert go.wait(30)
            super().register(master)

    registry = Registry(master, "/me", lambda: "http://me/")
    registry.want(Slow("a"))
    registry.start()
    assert began.wait(30)
    join = threading.Thread.join
    # The round goes on once `close` waits for its end.
    monkeypatch.setattr(threading.Thread, "join", lambda thread, timeout: (go.set(), join(thread, timeout)))
    registry.close()
    assert master.told == ["+a", "-a"]
