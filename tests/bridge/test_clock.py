"""One-way delays against the truth: both ends run on this machine, so they read the same clock."""

import struct
import time

import pytest

from skytether.lab.link import LinkConditions, LinkEmulator
from skytether.wire.topic import Role

ROUNDING = 2e-6
"""Time stamps travel as whole microseconds."""


class TimedPort:
    """Compares what the bridge says of each message's time with what the message says itself."""

    def __init__(self, inner):
        self._inner = inner
        self.wrong = []
        self.errors = []

    def __getattr__(self, name):
        return getattr(self._inner, name)

    def deliver(self, message):
        (published,) = struct.unpack("d", message.payload)
        if not abs(message.sent_at - published) <= message.sent_at_error + 0.0005:  # until `publish` took its time
            self.wrong.append((message.sent_at - published, message.sent_at_error))
        self.errors.append(message.sent_at_error)
        self._inner.deliver(message)


@pytest.mark.slow
@pytest.mark.parametrize(("up", "down"), [(0.0, 0.0), (0.005, 0.04), (0.04, 0.005)])
def test_the_stated_error_holds_whatever_the_asymmetry(ends, up, down):
    service, robot = ends.make(Role.SERVICE), ends.make(Role.ROBOT)
    for end in (service, robot):
        end._port = end.graph = TimedPort(end.graph)
    service.start()
    conditions = {"up": LinkConditions(delay=up, jitter=0.005), "down": LinkConditions(delay=down, jitter=0.005)}
    with LinkEmulator(service.address, **conditions) as link:
        robot.set_peer(*link.address)
        robot.start()
        robot.graph.wait_connected()
        service.graph.wait_connected()
        for _ in range(100):
            robot.publish("force", struct.pack("d", time.monotonic()))
            service.publish("cmd_vel", struct.pack("d", time.monotonic()))
            time.sleep(0.01)
        robot.graph.wait_messages(90)
        service.graph.wait_messages(90)
        for end in (service, robot):
            stats = end.stats()
            assert abs(stats.clock_offset) <= stats.clock_error + ROUNDING
            # Half the shortest round trip, and what this machine's threads add to it.
            assert stats.clock_error <= (up + down) / 2 + 0.01
            assert end.graph.wrong == []
            assert end.graph.errors[-1] <= (up + down) / 2 + 0.01
