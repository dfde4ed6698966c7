"""The agent's log on /rosout: what is said, of whom, how much waits, and that it never says anything of itself."""

import logging
import threading

import pytest
from ros2_nodes import until

from skytether.messages import decode_plain
from skytether.ros.ros2.console import KEPT, LOG, MAX_TEXT, Console

ROOT = "skytether_console_test"


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


def test_the_level_follows_that_of_the_node_s_logger_and_is_as_before_in_the_end(node, log):
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
