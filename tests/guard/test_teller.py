"""Who tells the wheels, from where they begin, and what each sees of the other: made-up time, no processes."""

import mmap
import os
import signal
import socket
import struct
import subprocess
import sys
from contextlib import closing, contextmanager, suppress
from math import inf, isnan, nan
from pathlib import Path

import pytest

from skytether.guard import board
from skytether.guard.board import Board, Entry, Role, mark
from skytether.guard.kinematics import Bounds
from skytether.guard.protocol import Beat, LastCommand
from skytether.guard.teller import FRESH, Sent, Teller
from skytether.guard.velocity import STANDSTILL, Velocity
from skytether.guard.watch import Watch
from skytether.ros.ros2 import native

BOUNDS = Bounds(0.5, -0.1, 0.8, 1.0, 2.0, 2.0, 4.0)
PERIOD, PATIENCE = 0.02, 0.1
FAST = Velocity(0.4, 0.0)


class Wheels:
    def __init__(self):
        self.told = []
        self.untils = []
        self.nodes = self.names = frozenset({"/base"})
        self.fails: Exception | None = None
        self.room = True
        self.held = None
        self.silent = ""

    def full(self):
        return not self.room

    def sent(self):
        return self.held

    def unread(self):
        return self.silent

    def write(self, velocity, until):
        if self.fails:
            raise self.fails
        if not self.room:
            raise BlockingIOError
        self.told.append(velocity)
        self.untils.append(until)

    def listeners(self):
        return self.nodes

    def hearers(self):
        return self.names


class One:
    """One who tells the wheels, with a clock that may jump in the middle of a turn."""

    def __init__(self, file, role):
        self.board, self.wheels, self.watch = Board(file), Wheels(), Watch(BOUNDS, PERIOD, PATIENCE)
        self.late = 0.0
        self.now = nan
        self.teller = Teller(self.wheels, self.watch, self.board, role, PERIOD, lambda: self.now + self.late)
        self.teller.refresh(self.now)

    def turn(self, now, wanted=None, stopped=False):
        self.now = now
        if wanted is not None:
            self.watch.on_beat(Beat(now, wanted))
        self.teller.refresh(self.now)
        return self.teller.write_velocity(now, stopped)


@pytest.fixture
def both():
    file = board.make()
    with closing(board.Board(file)) as page:
        heard = frozenset({mark("/base")})
        page.put(Role.FIRST, Entry(LastCommand(FAST, 0.98), left_at=0.98, hearers=heard))  # by who had the role before
    first, second = One(file, Role.FIRST), One(file, Role.SECOND)
    yield first, second
    for one in (first, second):
        one.board.close()
    os.close(file)


def test_the_second_is_silent_while_the_first_speaks(both):
    first, second = both
    for i in range(20):
        assert first.turn(1.0 + i * PERIOD, FAST)
        assert not second.turn(1.005 + i * PERIOD)
    assert second.wheels.told == []


def test_the_second_takes_over_from_what_was_told_and_brakes_within_the_limits(both):
    first, second = both
    first.turn(1.0, FAST)
    spoke = [second.turn(1.0 + i * PERIOD) for i in range(1, 16)]
    assert spoke == [False, False, *[True] * 13]  # sees it, claims, speaks
    told = [velocity.linear for velocity in second.wheels.told]
    assert told[0] == pytest.approx(0.4 - 2.0 * 0.06)
    assert told[1] == pytest.approx(told[0] - 2.0 * 0.02)
    assert told[-1] == 0.0


def test_what_had_not_left_the_wheels_were_not_told(both):
    """Programs of both stood still for 0.16 s; the wheels, silent for longer than they turn, heard 0.4 m/s first."""
    first, second = both
    for i in range(3):
        first.turn(1.0 + i * PERIOD, FAST)
    first.wheels.held = Sent(1.0, 1.0, lost=True, stuck=True)  # what was written then had left, and nothing since
    assert not first.turn(1.06, FAST)
    assert first.board.newest().told == LastCommand(first.wheels.told[0], 1.0)
    assert second.turn(1.07) is False
    assert second.turn(1.09) is True
    assert second.wheels.told[-1].linear == pytest.approx(0.4 - 2.0 * 0.09), "from what they were told really"
    first.turn(1.1, FAST)  # sees that, as if they were told so
    second.wheels.held = Sent(-1.0, -1.0, lost=True, stuck=True)
    assert not second.turn(1.11)
    assert second.board.newest().told.at == 1.0
    assert not first.turn(1.12, FAST)
    first.wheels.held = None
    assert any(first.turn(1.16 + i * PERIOD, FAST) for i in range(5))
    assert first.wheels.told[-1] == STANDSTILL, "they have heard nothing for longer than they turn"


def test_what_goes_on_from_something_leaves_while_the_wheels_turn_by_that_or_never(both):
    """The first stood still, and its program had before; what the second said left 0.17 s after what they heard."""
    first, second = both
    first.turn(1.0, FAST)
    first.wheels.held = Sent(1.0, 1.0)
    for i in range(1, 3):
        assert first.turn(1.0 + i * PERIOD, FAST)
    assert first.wheels.untils[-1] == pytest.approx(1.04 + FRESH * PERIOD), "or old"
    second.wheels.held = Sent(-inf, -inf)
    assert not second.turn(1.075)
    assert second.turn(1.091)
    assert second.wheels.told[-1].linear > 0
    assert second.wheels.untils[-1] == pytest.approx(1.0 + PATIENCE), "whatever was told after it may not have left"
    assert not second.turn(1.111), "whether they turn or stand nobody knows"
    assert second.turn(1.2)
    assert second.wheels.told[-1] == STANDSTILL
    assert second.wheels.untils[-1] == pytest.approx(1.2 + FRESH * PERIOD)


def test_who_begins_at_a_standstill_goes_on_within_patience_of_what_was_heard(both):
    """Of the first step it is not known yet; if that was lost, so may be what follows, which would be a jump then."""
    first, _ = both
    first.wheels.held = Sent(-inf, -inf)
    assert first.turn(2.0, FAST)
    assert first.wheels.told == [STANDSTILL]
    first.wheels.held = Sent(2.0, 2.0)
    for i in range(1, 5):
        assert first.turn(2.0 + i * PERIOD, FAST)
    assert first.wheels.told[-1].linear > 0
    assert first.wheels.untils[-1] == pytest.approx(2.0 + PATIENCE)
    first.wheels.held = Sent(2.08, 2.08)
    assert first.turn(2.1, FAST)
    assert first.wheels.untils[-1] == pytest.approx(2.1 + FRESH * PERIOD)


def test_what_is_acknowledged_too_late_to_go_on_is_followed_by_a_standstill(both):
    """A network kept for 0.15 s what goes on from before: the wheels stood, and heard full speed from then on."""
    first, _ = both
    first.wheels.held = Sent(0.8, 0.8)
    for i in range(20):
        first.turn(0.8 + i * PERIOD, FAST)
        first.wheels.held = Sent(0.8 + i * PERIOD, 0.8 + i * PERIOD)
    moving, heard_at = first.wheels.told[-1], 0.8 + 18 * PERIOD
    first.wheels.held = Sent(heard_at, heard_at)
    for at in (1.20, 1.22, 1.24):
        assert first.turn(at, FAST)
    assert first.wheels.told[-1].linear >= moving.linear > 0.3
    first.wheels.held = Sent(1.24, 1.24)
    assert not any(first.turn(at, FAST) for at in (1.31, 1.33)), "they have heard nothing for 0.15 s"
    assert first.turn(1.35, FAST)
    assert first.wheels.told[-1] == STANDSTILL
    first.wheels.held = Sent(1.35, 1.35)
    for i in range(1, 6):
        assert first.turn(1.35 + i * PERIOD, FAST)
        first.wheels.held = Sent(1.35 + i * PERIOD, 1.35 + i * PERIOD)
    assert first.wheels.told[-1].linear == pytest.approx(1.0 * 5 * PERIOD), "what began at a standstill counts"


def test_an_acknowledgement_that_came_while_the_process_stood_still_is_late(both):
    """It was asked for after that, by a look at the clock from before."""
    first, _ = both
    for i in range(20):
        first.wheels.held = Sent(0.8 + i * PERIOD, 0.8 + i * PERIOD)
        first.turn(0.8 + i * PERIOD, FAST)
    first.wheels.held = Sent(1.16, 1.16)
    first.turn(1.2, FAST)
    first.wheels.held, first.late = Sent(1.2, 1.2), 0.1
    assert not first.turn(1.22, FAST)
    first.late = 0.0
    assert not first.turn(1.29, FAST)
    assert first.turn(1.31, FAST)
    assert first.wheels.told[-1] == STANDSTILL


@pytest.mark.parametrize(("late_s", "drives"), [(0.0, True), (0.055, True), (0.1, False)])
def test_acknowledgements_may_take_the_patience_less_two_periods(both, late_s, drives):
    first, _ = both
    told = [0.98]
    for i in range(100):
        now = 1.0 + i * PERIOD
        heard_at = max((at for at in told if at <= now - late_s), default=-inf)
        first.wheels.held = Sent(heard_at, heard_at)
        if first.turn(now, FAST):
            told.append(now)
    assert (first.wheels.told[-1] == FAST) == drives


def test_of_a_first_step_that_nobody_heard_nothing_more_is_told(both):
    first, _ = both
    first.wheels.held = Sent(-inf, -inf)
    assert first.turn(2.0, FAST)
    assert first.turn(2.02, FAST)
    assert first.wheels.told[-1].linear > 0
    assert not first.turn(2.04, FAST)


def test_wheels_that_are_not_known_to_hear_are_told_to_stand_until_they_are(both):
    """The first standstill was missed, and what they heard first was some way up the ramp."""
    first, _ = both
    first.wheels.held = Sent(2.0, 2.0, unheard=True)
    for i in range(10):
        first.wheels.held = Sent(2.0 + (i - 1) * PERIOD, 2.0 + (i - 1) * PERIOD, unheard=True)
        assert first.turn(2.0 + i * PERIOD, FAST)
    assert set(first.wheels.told) == {STANDSTILL}
    first.wheels.held = Sent(2.18, 2.18)
    assert first.turn(2.2, FAST)
    assert first.wheels.told[-1].linear == pytest.approx(1.0 * PERIOD)


def test_standing_wheels_are_told_so_whether_they_acknowledge_it_or_not(both):
    """Or who tells them would fall silent each tenth of a second, and the other one take over."""
    first, _ = both
    first.wheels.held = Sent(2.0, 2.0)
    first.wheels.silent = "hangs"
    assert all(first.turn(2.0 + i * PERIOD, FAST) for i in range(30))
    assert set(first.wheels.told) == {STANDSTILL}


def test_who_takes_over_tells_one_who_came_meanwhile_to_stand_first(both):
    """The wheels' subscription was made anew just before the first was held up: their first word was 0.4 m/s."""
    first, second = both
    for one in (first, second):
        one.wheels.held = Sent(1.0, 1.0)
    assert first.turn(1.0, FAST)
    first.turn(1.02, FAST)
    first.wheels.held = Sent(1.0, 1.0, lost=True)  # its program knew of the one who came
    second.wheels.nodes = frozenset({"/base again"})
    assert not second.turn(1.055)
    assert second.turn(1.071)
    assert second.wheels.told == [STANDSTILL]


@pytest.mark.parametrize("soon", [True, False])
def test_who_takes_over_goes_on_where_the_other_one_has_told_who_came(both, soon):
    """Unless that was just now: the connection to the gate was there 0.25 s sooner, as a packet was lost.

    The writer told a recorder full speed meanwhile, and was killed; the wheels heard that from the gate first.
    """
    first, second = both
    for one in (first, second):
        one.wheels.nodes = frozenset({"/base again"})
    second.turn(0.99 if soon else -8.0)
    for i in range(16):
        first.turn(1.0 + i * PERIOD, FAST)
    assert not second.turn(1.335)
    assert second.turn(1.351)
    assert second.wheels.told[-1].linear == pytest.approx(0.0 if soon else 0.3 - 2.0 * 0.051)


def first_word_after_a_freeze(first, second):
    """Of the first, which stood still for 0.16 s while the second braked."""
    for i in range(20):
        first.turn(1.0 + i * PERIOD, FAST)
    for i in range(1, 9):
        second.turn(1.385 + i * PERIOD)
    assert second.wheels.told[-1].linear > 0
    turn, before = 1.38 + 8 * PERIOD, len(first.wheels.told)
    while len(first.wheels.told) == before:
        first.turn(turn := turn + PERIOD, FAST)
    return first.wheels.told[-1]


@pytest.mark.parametrize("soon", [True, False])
def test_who_came_just_now_may_have_stopped_while_the_other_one_told_others(both, soon):
    """The gate did not reach the wheels yet, and braked for a recorder while the writer stood still for 0.16 s."""
    first, second = both
    first.wheels.nodes = frozenset({"/base again"})
    first.turn(0.5 if soon else -9.0, FAST)
    assert (first_word_after_a_freeze(first, second) == STANDSTILL) == soon


@pytest.mark.parametrize("reached", [True, False])
def test_whom_the_other_one_did_not_reach_hears_a_standstill_first(both, reached):
    """Their connection to the gate had been reset; it braked for a recorder while the writer stood still for 0.16 s."""
    first, second = both
    first.wheels.nodes = first.wheels.names = frozenset({"/base", "/recorder"})
    second.wheels.nodes = second.wheels.names = first.wheels.names if reached else frozenset({"/recorder"})
    for one in (first, second):
        one.turn(-9.0)
    assert (first_word_after_a_freeze(first, second) == STANDSTILL) is not reached


@pytest.mark.parametrize("reached", [True, False])
def test_whom_the_first_did_not_reach_hears_a_standstill_first_of_the_second(both, reached):
    first, second = both
    second.wheels.nodes = second.wheels.names = frozenset({"/base", "/recorder"})
    first.wheels.nodes = first.wheels.names = second.wheels.names if reached else frozenset({"/recorder"})
    for one in (first, second):
        one.turn(-9.0)
    for i in range(20):
        first.turn(1.0 + i * PERIOD, FAST)
    before = len(second.wheels.told)
    for i in range(1, 5):
        second.turn(1.385 + i * PERIOD)
    assert (second.wheels.told[before] == STANDSTILL) is not reached


def test_a_standstill_that_was_not_sent_was_not_told(both):
    """Who was held up in the turn in which it took over found its own entry, and went on from the other one's."""
    first, second = both
    second.wheels.nodes = second.wheels.names = frozenset({"/base", "/recorder"})
    for one in (frozenset[str](), second.wheels.names):
        second.wheels.nodes = one
        second.turn(-9.0)
    for i in range(20):
        first.turn(1.0 + i * PERIOD, FAST)
    assert not second.turn(1.42)
    second.late = 0.016
    assert not second.turn(1.44)
    second.late = 0.0
    first.board.put(Role.FIRST, Entry(LastCommand(FAST, 1.445), left_at=1.445, hearers=frozenset({mark("/base")})))
    turn = 1.44
    while not second.wheels.told:
        second.turn(turn := turn + PERIOD)
    assert second.wheels.told == [STANDSTILL]


def test_who_came_after_the_last_word_did_not_hear_it(both):
    """The gate claims, which it writes down, too, once it has somebody who listens."""
    first, _ = both
    for i in range(20):
        first.turn(1.0 + i * PERIOD, FAST)
    known = first.board.of(Role.FIRST).hearers
    first.wheels.names = frozenset({"/base", "/late"})
    first.board.put(Role.SECOND, Entry(claim=1.39))
    assert not first.turn(1.42)
    assert first.board.of(Role.FIRST).claim == 1.42
    assert first.board.of(Role.FIRST).hearers == known


def test_who_comes_to_one_that_is_silent_meanwhile_hears_a_standstill_first_of_it(both):
    """A subscription was made anew after 20 ms: for a turn nobody listened to the writer, and the gate claimed.

    It was taken for one that the other one tells, and heard full speed, which went on.
    """
    first, _ = both
    for i in range(3):
        first.turn(1.0 + i * PERIOD, FAST)
    first.wheels.nodes = frozenset()
    first.turn(1.06, FAST)
    first.board.put(Role.SECOND, Entry(LastCommand(FAST, 1.07), left_at=1.07))  # perhaps nobody heard it
    first.wheels.nodes = frozenset({"/base again"})
    first.turn(1.08, FAST)
    assert first.wheels.told[3:] == [STANDSTILL]


def test_what_could_not_be_published_the_wheels_were_not_told_and_are_told_to_stand_first(both):
    """Publishing failed for 2 s, and the first that did not was full speed."""
    first, _ = both
    first.turn(1.0, FAST)
    first.wheels.held = Sent(1.0, 1.0, lost=True)
    for i in range(1, 20):
        assert first.turn(1.0 + i * PERIOD, FAST)
    assert first.wheels.told[-1] == STANDSTILL
    first.wheels.held = None
    assert first.turn(1.4, FAST)
    assert first.wheels.told[-1].linear <= BOUNDS.linear_max * 0.1


def test_one_that_died_just_after_it_had_told_something_is_known_exactly(both):
    """Writer and guard killed: what the gate had heard of them by messages was 0.1 s old, and it told standstill."""
    first, second = both
    first.turn(1.0, FAST)
    for i in range(1, 4):
        second.turn(1.0 + i * PERIOD)
    assert second.wheels.told[0].linear == pytest.approx(0.28)


def test_the_first_waits_for_the_second_to_give_way(both):
    first, second = both
    for i in range(1, 6):
        second.turn(1.0 + i * PERIOD)
    before = len(second.wheels.told)
    assert before == 4
    assert not first.turn(1.101, FAST)  # it claims
    assert not first.turn(1.111, FAST)
    assert not second.turn(1.12)  # sees the claim
    assert first.turn(1.121, FAST)  # and that is seen
    assert not second.turn(1.14)
    assert len(second.wheels.told) == before
    assert first.wheels.told[0].linear == pytest.approx(second.wheels.told[-1].linear + 1.0 * 0.021)


def test_the_first_does_not_wait_for_one_that_is_dead(both):
    first, second = both
    for i in range(1, 6):
        second.turn(1.0 + i * PERIOD)
    spoke = [first.turn(1.11 + i * 0.01, FAST) for i in range(5)]
    assert spoke == [False, False, True, True, True]


def test_a_claim_of_the_second_that_comes_too_early_is_answered_by_speaking(both):
    first, second = both
    first.turn(1.0, FAST)
    assert not second.turn(1.045)  # itself late; it claims
    assert first.turn(1.046, FAST)
    assert not second.turn(1.065)
    assert isnan(second.board.of(Role.SECOND).claim)
    assert second.wheels.told == []


def test_a_first_that_is_late_after_a_claim_does_not_speak_beside_the_second(both):
    first, second = both
    first.turn(1.0, FAST)
    second.turn(1.04)  # claims
    assert not first.turn(1.056, FAST)  # the second may speak from 1.055 on
    assert not second.turn(1.06)  # it sees the claim
    assert first.turn(1.061, FAST)
    assert second.wheels.told == []


@pytest.mark.parametrize("role", [0, 1])
def test_who_is_frozen_in_the_middle_of_a_turn_does_not_speak_by_what_it_saw_before(both, role):
    both[0].turn(1.0, FAST)
    both[1].turn(1.04)
    one = both[role]
    one.late = 0.5
    before = len(one.wheels.told)
    assert not one.turn(1.07, FAST)
    assert len(one.wheels.told) == before


def test_who_is_not_heard_leaves_it_to_the_other_one(both):
    first, second = both
    first.turn(1.0, FAST)
    first.wheels.nodes = frozenset()
    for i in range(1, 10):
        assert not first.turn(1.0 + i * PERIOD, FAST)
        second.turn(1.001 + i * PERIOD)
    assert len(second.wheels.told) >= 5
    first.wheels.nodes = frozenset({"/base"})  # a new writer, that the wheels now hear
    for i in range(10, 14):
        first.turn(1.0 + i * PERIOD, FAST)
        second.turn(1.001 + i * PERIOD)
    # They may have been told something by the gate all the time, or may not: nobody knows.
    assert [velocity.linear for velocity in first.wheels.told[1:3]] == pytest.approx([0.0, 0.02])
    assert second.wheels.told[-1].linear > 0


def test_wheels_that_start_anew_begin_from_standstill(both):
    first, _ = both
    first.turn(1.0, FAST)
    first.wheels.nodes = frozenset({"/base another time"})
    first.turn(1.02, FAST)
    first.turn(1.04, FAST)
    assert [velocity.linear for velocity in first.wheels.told] == pytest.approx([0.4, 0.0, 0.02])


def test_wheels_that_nobody_can_tell_anything_are_not_taken_over(both):
    first, second = both
    first.wheels.fails = FileNotFoundError()
    for i in range(10):
        with pytest.raises(FileNotFoundError):
            first.turn(1.0 + i * PERIOD, FAST)
        assert not second.turn(1.001 + i * PERIOD)
    first.wheels.fails = None
    first.turn(1.2, FAST)
    assert first.wheels.told[0].linear == pytest.approx(0.02)


def test_a_way_that_is_broken_is_silence(both):
    first, second = both
    first.turn(1.0, FAST)
    first.wheels.fails = RuntimeError("closed")
    for i in range(1, 8):
        with suppress(RuntimeError):
            first.turn(1.0 + i * PERIOD, FAST)
        second.turn(1.001 + i * PERIOD)
    assert second.wheels.told[0].linear == pytest.approx(0.4 - 2.0 * 0.061)
    assert len(second.wheels.told) == 5


def turns(one, start, end):
    """At 50 Hz; when it told the wheels something, and what."""
    spoke = []
    at = start
    while at < end - 1e-9:
        with suppress(BlockingIOError):
            if one.turn(at, FAST):
                spoke.append((round(at, 3), one.wheels.told[-1].linear))
        at += PERIOD
    return spoke


def not_read_until_1_4(one):
    """Told of a velocity until 1.04, then without room, as seen last at 1.38."""
    turns(one, 1.0, 1.05)
    one.wheels.room = False
    turns(one, 1.06, 1.4)
    one.wheels.room = True


def test_wheels_that_have_no_room_for_a_moment_are_told_what_follows_from_the_last_velocity(both):
    first, _ = both
    turns(first, 1.0, 1.05)
    first.wheels.room = False
    assert turns(first, 1.06, 1.1) == []
    first.wheels.room = True
    assert turns(first, 1.1, 1.11) == [(1.1, 0.4)]


def test_wheels_that_had_no_room_for_longer_are_left_alone_until_they_stand(both):
    """They turn by what they read late: a word between that and a standstill would be a jump."""
    first, _ = both
    not_read_until_1_4(first)
    spoke = turns(first, 1.4, 1.6)
    assert spoke[0] == (pytest.approx(1.38 + PATIENCE + 3 * PERIOD), 0.0)  # 1.38: it was full
    assert spoke[1][1] == pytest.approx(1.0 * PERIOD)


def test_wheels_that_do_not_read_are_named_as_long_as_they_do_not(both):
    first, _ = both
    turns(first, 1.0, 1.05)
    first.wheels.room = False
    for i in range(100):
        with pytest.raises(BlockingIOError, match="their driver does not read"):
            first.turn(1.06 + i * PERIOD, FAST)


def test_a_stop_is_told_at_once_to_wheels_that_read_again(both):
    first, _ = both
    not_read_until_1_4(first)
    assert first.turn(1.4, stopped=True)
    assert first.wheels.told[-1] == STANDSTILL


def test_the_second_knows_that_the_first_waits(both):
    first, second = both
    turns(first, 1.0, 1.05)
    first.wheels.room = second.wheels.room = False
    turns(first, 1.06, 1.4)
    first.wheels.room = second.wheels.room = True
    for i in range(6):
        assert not first.turn(1.4 + i * PERIOD, FAST)
        assert not second.turn(1.405 + i * PERIOD, FAST)


def test_the_next_one_in_a_role_goes_on_with_the_entry_of_the_one_before():
    file = board.make()
    before = One(file, Role.SECOND)
    for i in range(5):
        before.turn(1.0 + i * PERIOD)
    after = One(file, Role.SECOND)
    assert after.board.of(Role.SECOND) == (LastCommand(STANDSTILL, 1.08), 1.0, 1.08, {mark("/base")})
    after.board.put(Role.FIRST, Entry(LastCommand(FAST, 1.1), left_at=1.1))
    assert not after.turn(1.12)
    assert isnan(after.board.of(Role.SECOND).claim)  # what a dead one has claimed is given back by the next
    os.close(file)


def test_an_entry_that_was_not_written_to_its_end_leaves_the_one_before():
    file = board.make()
    page = Board(file)
    assert page.newest().told == LastCommand()
    for at in (1.0, 2.0, 3.0):
        page.put(Role.FIRST, Entry(LastCommand(FAST, at), at))
    with mmap.mmap(file, 4096) as memory:  # as who dies while it writes leaves it
        memory[memory.find(struct.pack("<d", 3.0))] ^= 1
    assert page.of(Role.FIRST) == Entry(LastCommand(FAST, 2.0), 2.0)
    page.put(Role.FIRST, Entry(LastCommand(STANDSTILL, 4.0)))
    assert page.newest().told == LastCommand(STANDSTILL, 4.0)
    page.put(Role.SECOND, Entry(LastCommand(FAST, 5.0)))
    assert Board(file).newest().told == LastCommand(FAST, 5.0)  # as another process sees it
    with pytest.raises(PermissionError):
        os.ftruncate(file, 0)
    os.close(file)


def test_of_very_many_who_listen_some_are_written_down():
    file = board.make()
    page, many = Board(file), frozenset(map(mark, map(str, range(60))))
    page.put(Role.FIRST, Entry(LastCommand(FAST, 1.0), 1.0, 1.0, many))
    assert page.of(Role.FIRST).hearers < many
    assert len(page.of(Role.FIRST).hearers) == 48
    os.close(file)


SPEAKS = """
import sys, time
sys.path.insert(0, sys.argv[1])
from side.speaking import Speaking
with Speaking(int(sys.argv[2]), int(sys.argv[3]))():
    print("speaks", flush=True)
    time.sleep(60)
"""


@contextmanager
def who_stands_still_as_it_speaks(page, role):
    """A process between its last look at the clock and the kernel."""
    file, start = page.place(role)
    process = subprocess.Popen(
        [sys.executable, "-c", SPEAKS, str(Path(native.__file__).parent), str(file), str(start)],
        pass_fds=[file],
        stdout=subprocess.PIPE,
    )
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == b"speaks\n"
        yield process
    finally:
        process.kill()
        process.communicate()


@pytest.mark.parametrize("role", Role)
def test_who_takes_over_ends_what_stands_still_as_it_speaks(both, role):
    first, second = both
    with who_stands_still_as_it_speaks(first.board, role) as process:
        first.turn(1.0, FAST)
        assert second.turn(1.1) is False  # it claims
        assert first.teller.ended == second.teller.ended == ""
        assert second.turn(1.12)
        if role is Role.SECOND:
            assert second.teller.ended == ""  # it is its own
            first.turn(1.14, FAST)  # claims
            assert first.turn(1.17, FAST)
        taker = second if role is Role.FIRST else first
        assert taker.teller.ended.startswith(f"process {process.pid} stood still")
        assert process.wait(10) == -signal.SIGKILL
        assert taker.turn(1.2)
        assert taker.teller.ended == ""


KEEPS = """
import socket, sys, time
from skytether.guard.board import Place
Place(int(sys.argv[1]), int(sys.argv[2])).keep()
with socket.create_server(("127.0.0.1", 0)) as server:
    print(server.getsockname()[1], flush=True)
    wheels, _ = server.accept()
    master = socket.create_connection(("127.0.0.1", int(sys.argv[3])))
    for told, more in ((wheels, sys.argv[4] == "wheels"), (master, sys.argv[4] == "master")):
        told.setblocking(False)
        try:
            told.send(b"velocity")
            while more:
                told.send(bytes(65536))
        except BlockingIOError:
            pass
    print("has told", flush=True)
    time.sleep(60)
"""


@contextmanager
def who_told_by_tcp(page, role, hangs):
    """A process that stands still, and keeps a part of what it sent the wheels or a master, which does not read it."""
    file, start = page.place(role)
    with socket.create_server(("127.0.0.1", 0)) as master:
        command = [sys.executable, "-c", KEEPS, str(file), str(start), str(master.getsockname()[1]), hangs]
        process = subprocess.Popen(command, pass_fds=[file], stdout=subprocess.PIPE)
        try:
            assert process.stdout is not None
            with socket.create_connection(("127.0.0.1", int(process.stdout.readline()))):
                assert process.stdout.readline() == b"has told\n"
                yield process
        finally:
            process.kill()
            process.communicate()


def test_who_stands_still_with_a_word_that_its_kernel_sends_again_is_ended(both):
    """The network was cut, and the first frozen: its velocities came amid the standstills of the second."""
    first, second = both
    with who_told_by_tcp(first.board, Role.FIRST, "wheels") as process:
        first.turn(1.0, FAST)
        second.turn(1.03)
        assert second.turn(1.05)
        assert second.teller.ended == "", "it may be acknowledged yet"
        assert second.turn(1.07)
        assert second.teller.ended.startswith(f"process {process.pid} stood still")
        assert process.wait(10) == -signal.SIGKILL
        assert second.turn(1.09)
        assert second.teller.ended == ""


def test_the_second_is_not_ended_for_what_its_kernel_keeps(both):
    """It would know nothing of who drives, and a person would have to let the robot go on."""
    first, second = both
    with who_told_by_tcp(first.board, Role.SECOND, "wheels") as process:
        first.turn(1.0, FAST)
        assert any(second.turn(1.0 + i * PERIOD) for i in range(1, 6))
        assert any(first.turn(1.1 + i * PERIOD, FAST) for i in range(10))
        assert first.teller.ended == ""
        assert process.poll() is None


@pytest.mark.parametrize("hangs", ["master", "nobody"])
def test_who_stands_still_and_was_heard_by_the_wheels_is_not_ended(both, hangs):
    first, second = both
    with who_told_by_tcp(first.board, Role.FIRST, hangs) as process:
        first.turn(1.0, FAST)
        assert [second.turn(1.0 + i * PERIOD) for i in range(1, 10)][-1]
        assert second.teller.ended == ""
        assert process.poll() is None


def test_who_goes_on_speaking_ends_nothing(both):
    first, _ = both
    with who_stands_still_as_it_speaks(first.board, Role.SECOND) as process:
        for i in range(1, 10):
            assert first.turn(1.0 + i * PERIOD, FAST)
            assert first.teller.ended == ""
        assert process.poll() is None


def test_wheels_that_do_not_acknowledge_are_braked_and_go_on_from_there(both):
    """The node of the wheels hung or was cut off for seconds, and the first it heard then was full speed."""
    first, _ = both
    turns = iter(range(100))

    def turn():
        now = 1.0 + next(turns) * PERIOD
        first.turn(now, FAST)
        return first.wheels.told[-1].linear

    assert turn() == pytest.approx(0.4)
    first.wheels.silent = "/cmd_vel is not acknowledged by /base"
    assert turn() == pytest.approx(0.4 - 2.0 * PERIOD)
    assert [turn() for _ in range(12)][-1] == 0.0
    assert first.teller.unread == first.wheels.silent
    first.wheels.silent = ""
    assert turn() == pytest.approx(1.0 * PERIOD)
    assert first.teller.unread == ""
