"""The agent's log on /rosout: what is said, of whom, how much waits, and that it never says anything of itself."""

import logging
import struct
import threading

import pytest
import yaml
from ros2_nodes import until

from skytether.messages import decode_plain
from skytether.robot.config.robot_config import load_config
from skytether.ros.ros1.arguments import RosArguments
from skytether.ros.ros2 import console
from skytether.ros.ros2.console import KEPT, LOG, MAX_TEXT, Console

ROOT = "skytether_console_test"


DDS_LOG = "rcl_interfaces::msg::dds_::Log_"
RIHS_LOG = "RIHS01_e28ce254ca8abc06abf92773b74602cdbf116ed34fbaf294fb9f81da9f318eac"
"""As rmw_zenoh_cpp has it in the key of /rosout: 0/rosout/rcl_interfaces::msg::dds_::Log_/RIHS01_e28ce2..."""


class PlayedNode:
    """A graph that is joined when the test says so, and that logs whatever it publishes."""

    def __init__(self):
        self.log_level = logging.INFO
        self.joined = threading.Event()
        self.endpoint = None
        self.published = []

    def publish(self, endpoint):
        self.endpoint = endpoint
        return self

    def put(self, payload):
        self.published.append(decode_plain(LOG, payload))
        logging.getLogger(f"{ROOT}.graph").error("the graph is slow")
        return True

    def wait_until_joined(self, timeout):
        return self.joined.wait(timeout)


@pytest.fixture
def node():
    return PlayedNode()


@pytest.fixture
def log():
    return logging.getLogger(f"{ROOT}.agent")


def texts(node):
    return [message.msg for message in node.published]


def test_what_is_said_before_the_graph_is_joined_waits_the_newest_of_it(node, log):
    with Console(node, "/one/skytether", ROOT):
        for number in range(KEPT + 50):
            log.warning("trouble %d", number)
        assert not node.published
        node.joined.set()
        until(lambda: len(node.published) >= KEPT, "the log")
        log.info("the service drives")
        until(lambda: len(node.published) > KEPT, "what is said then")
    assert texts(node) == [f"trouble {number}" for number in range(50, KEPT + 50)] + ["the service drives"]
    assert (node.endpoint.name, node.endpoint.qos.transient_local) == ("/rosout", True)


def test_a_message_has_the_node_s_logger_the_level_and_a_bound(node, log):
    node.joined.set()
    with Console(node, "/one/skytether", ROOT, clock=lambda: 1234.5):
        log.warning("x" * MAX_TEXT * 2)
        log.log(logging.ERROR + 5, "between two levels")
    first, second = node.published
    assert (first.name, first.level, len(first.msg)) == ("one.skytether", 30, MAX_TEXT)
    assert (first.stamp.sec, first.stamp.nanosec) == (1234, 500_000_000)
    assert first.file == __file__
    assert second.level == 40


def test_the_level_follows_that_of_the_node_s_logger_and_is_as_before_in_the_end(node, log, monkeypatch):
    monkeypatch.setattr(console, "LOOK_S", 0.02)
    node.joined.set()
    with Console(node, "/one/skytether", ROOT):
        log.debug("not this")
        node.log_level = logging.DEBUG
        until(lambda: log.isEnabledFor(logging.DEBUG), "the level")
        log.debug("this")
        node.log_level = logging.ERROR
        until(lambda: not log.isEnabledFor(logging.WARNING), "the level")
        log.warning("nor this")
    assert texts(node) == ["this"]
    assert logging.getLogger(ROOT).level == logging.NOTSET
    assert not logging.getLogger(ROOT).handlers


def log_of_cdr(data):
    """rcl_interfaces/msg/Log, little-endian, read by hand: level, name, text, line; the stamp in seconds."""
    assert data[:4] == b"\0\1\0\0"
    body, at = data[4:], 0
    seconds, nanoseconds, level = struct.unpack_from("<iIB", body)
    at, texts = 9, []
    for _ in ("name", "msg", "file", "function"):
        at = -(-at // 4) * 4
        (size,) = struct.unpack_from("<I", body, at)
        texts.append(body[at + 4 : at + 3 + size].decode())
        at += 4 + size
    (line,) = struct.unpack_from("<I", body, -(-at // 4) * 4)
    return (level, *texts[:2], texts[2], line), seconds + nanoseconds / 1e9


@pytest.mark.slow
def test_a_warning_arrives_by_a_zenoh_router_as_log_in_cdr_also_at_who_comes_late(stage, tmp_path):
    robot = {"robot": "one", "orchestrator": "http://127.0.0.1:9", "token_file": "one.token", "service": "wall-stop"}
    graph = {"dialect": "rmw_zenoh", "router": stage.router.address, "domain": stage.domain}
    path = tmp_path / "robot.yaml"
    path.write_text(yaml.safe_dump(robot | {"safety": "none", "ros2": graph}))
    settings = load_config(path)
    warned = logging.getLogger("skytether.robot.test")

    def heard_by(node):
        return node.subscribe("/rosout", DDS_LOG, RIHS_LOG, depth=1000)

    def said(received):
        return [found for found, _ in map(log_of_cdr, received.payloads) if found[3] == __file__]

    early = heard_by(stage.rmw("console"))
    with settings.kind.join(settings.graph, settings.graph_config, tmp_path, RosArguments(), lambda _: None):
        warned.warning("the wheels are not told: %s", "é")
        stage.until(lambda: said(early), "no warning arrived")
        late = heard_by(stage.rmw("late"))
        stage.until(lambda: said(late), "who comes late heard nothing")
    (one,), (same,) = said(early), said(late)
    assert one == same
    assert one[:3] == (logging.WARNING, "one.skytether", "the wheels are not told: é")
    assert one[4] > 0
    assert all(stamp > 1_700_000_000 for _, stamp in map(log_of_cdr, early.payloads))
