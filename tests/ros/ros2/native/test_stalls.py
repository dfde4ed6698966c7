"""Which velocities are old because our process stood still."""

import pytest

from skytether.ros.ros2.native.side.stalls import DRAINED_S, SENT_AGAIN_S, STOOD_S, TURN_S, Stalls

CMD_VEL, OTHER = 3, 4
CLOCK_S = -700.0
"""By how much the publisher's clock is off."""


class Process:
    """Takes a velocity in each turn."""

    def __init__(self):
        self.now = 50.0
        self.stalls = Stalls(self.now)

    def run(self, seconds, took=0.01):
        """Returns how many velocities were old."""
        old = 0
        for _ in range(round(seconds / TURN_S)):
            self.now += TURN_S
            self.stalls.turn(self.now)
            old += self.take(took)
        return old

    def take(self, took, channel=CMD_VEL):
        self.stalls.note(channel, self.now)
        return self.stalls.is_old(channel, None if took is None else CLOCK_S + took, self.now)


@pytest.fixture
def process():
    process = Process()
    assert process.run(2.0) == 0
    return process


def test_what_waited_for_a_process_that_stood_still_is_old_whoever_looks_first(process):
    process.now += STOOD_S + 0.1
    assert process.take(0.4)
    assert 3 <= process.run(2 * DRAINED_S) <= 5
    assert process.run(1.0) == 0


def test_a_turn_that_came_a_little_late_is_no_stall(process):
    process.now += STOOD_S - 0.01
    assert not process.take(0.2)


@pytest.mark.parametrize("told", [True, False])
def test_what_is_sent_again_later_is_old_where_it_is_told_when_it_was_published(process, told):
    process.now += 2.0
    process.run(1.0)
    assert process.take(2.5 if told else None) is told
    assert not process.take(0.02), "and what is new is not"
    process.run(SENT_AGAIN_S)
    assert not process.take(2.5), "a publisher's clock was put back; there was no stall"


def test_after_a_stall_the_clocks_are_compared_as_they_are_where_none_came_before(process):
    process.now += 2.0
    process.run(1.0)
    assert process.stalls.is_old(OTHER, 2.5, process.now)
    assert not process.stalls.is_old(OTHER, 0.01, process.now)
    assert process.stalls.is_old(OTHER, 2.5, process.now)


@pytest.mark.parametrize("last", [0.0, 10.0])
def test_where_two_publish_by_other_clocks_the_quickest_tells_who_is_old(process, last):
    process.take(10.0)
    process.take(last)
    process.now += 2.0
    process.run(1.0)
    assert process.take(2.5)
    assert process.take(10.0), "whose clock is behind waits with them"
    process.run(SENT_AGAIN_S)
    assert not process.take(10.0)


def test_a_clock_that_drifts_away_is_followed(process):
    for hour in range(5):
        process.now += 3600.0
        process.stalls.turn(process.now)
        process.run(2 * SENT_AGAIN_S, took=0.01 + hour * 0.18)
    process.now += 1.0
    process.stalls.turn(process.now)
    assert process.run(2.0, took=0.01 + 4 * 0.18) <= 5


def test_a_loss_is_explained_by_a_stall_since_the_message_before(process):
    assert not process.stalls.explains(CMD_VEL)
    process.now += 1.0
    for _ in range(100):  # nobody publishes for a while
        process.now += TURN_S
        process.stalls.turn(process.now)
    process.take(0.01)
    assert process.stalls.explains(CMD_VEL)
    assert process.stalls.explains(OTHER), "nothing came before"
    process.run(0.5)
    assert not process.stalls.explains(CMD_VEL)
