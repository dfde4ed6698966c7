"""One-way delays against the truth: both ends run on this machine, so they read the same clock."""

import struct
import time

import pytest
from recording_port import RecordingPort

from skytether.emulator.udp_link import LinkConditions, LinkEmulator
from skytether.wire.topic import Role

ROUNDING = 2e-6
"""Time stamps travel as whole microseconds."""


class TimedPort(RecordingPort):
    """Compares what the bridge says of each message's time with what the message says itself."""

    def __init__(self):
        super().__init__()
        self.said = {}
        self.errors = []

    def deliver(self, message):
        (number,) = struct.unpack("i", message.payload)
        self.said[number] = (message.sent_at, message.sent_at_error)
        self.errors.append(message.sent_at_error)
        super().deliver(message)

    def wrong(self, published):
        """What was said that cannot be true of a message that was published between two moments."""
        return [
            (said, published[number])
            for number, said in self.said.items()
            if not published[number][0] <= said[0] + said[1] or not said[0] - said[1] <= published[number][1]
        ]


def publish(end, topic, number):
    """When it was published: not before, not after. A busy machine takes its time between any two lines."""
    before = time.monotonic()
    end.publish(topic, struct.pack("i", number))
    return before, time.monotonic()


@pytest.mark.slow
@pytest.mark.parametrize(("up", "down"), [(0.0, 0.0), (0.005, 0.04), (0.04, 0.005)])
def test_the_stated_error_holds_whatever_the_asymmetry(ends, up, down):
    service, robot = ends.make(Role.SERVICE, TimedPort()), ends.make(Role.ROBOT, TimedPort())
    service.start()
    conditions = {"up": LinkConditions(delay=up, jitter=0.005), "down": LinkConditions(delay=down, jitter=0.005)}
    with LinkEmulator(service.address, **conditions) as link:
        robot.set_peer(*link.address)
        robot.start()
        robot.graph.wait_connected()
        service.graph.wait_connected()
        by_robot, by_service = {}, {}
        for number in range(100):
            by_robot[number] = publish(robot, "force", number)
            by_service[number] = publish(service, "cmd_vel", number)
            time.sleep(0.01)
        robot.graph.wait_messages(90)
        service.graph.wait_messages(90)
        for end, published in ((service, by_robot), (robot, by_service)):
            stats = end.stats()
            assert abs(stats.clock_offset) <= stats.clock_error + ROUNDING
            # Half the shortest round trip, and what this machine's threads add to it.
            assert stats.clock_error <= (up + down) / 2 + 0.01
            assert end.graph.wrong(published) == []
            assert end.graph.errors[-1] <= (up + down) / 2 + 0.01
