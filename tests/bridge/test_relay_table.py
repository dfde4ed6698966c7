"""Which packets a relay forwards: by made-up addresses and times."""

import pytest
from deep_size import deep_size
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from skytether.bridge.relay_table import (
    AMPLIFICATION,
    NEWCOMER_IDLE,
    SILENT,
    Bucket,
    Prefix,
    RelayLimits,
    RelayTable,
    same_session,
)

SERVICE = ("10.0.0.1", 41000)
OTHER = ("10.0.0.2", 41000)
ROBOT = ("192.0.2.1", 5000)


def packet(session_id, size=100):
    """HELLO of a robot."""
    return (b"\x21" + session_id.to_bytes(8, "big")).ljust(size, b"x")


def data(session_id, size=100, handshake=0):
    """Any other packet of that session, under the keys of one of its handshakes."""
    return (b"\x20" + (1000 * (handshake + 1) + session_id).to_bytes(8, "big")).ljust(size, b"x")


def table(*routes, **limits):
    made = RelayTable(RelayLimits(**limits))
    for text, target in routes or (("*", SERVICE),):
        made.add(Prefix.parse(text), target, 0.0)
    return made


def admit(relay, session_id=7, source=ROBOT, now=0.0):
    leg = relay.up(packet(session_id), source, now)
    assert relay.down(leg, data(session_id), leg.route.target, now)
    assert relay.up(packet(session_id), source, now) is leg
    return leg


# --- routes -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "digits", "value"),
    [("00000000000000ff", 16, 255), ("0F*", 2, 15), ("*", 0, 0), ("fffffffffffffff*", 15, 2**60 - 1)],
)
def test_prefixes(text, digits, value):
    assert Prefix.parse(text) == (digits, value)


@pytest.mark.parametrize("text", ["", "ff", "0123456789abcdef*", "0123456789abcdef0", "xy*", "**", "ab* ", "-1*"])
def test_what_is_no_prefix_is_refused_in_a_sentence(text):
    with pytest.raises(ValueError, match="16 hexadecimal digits"):
        Prefix.parse(text)


def test_the_longest_prefix_counts():
    relay = table(("*", ("any", 1)), ("00*", ("two", 2)), ("0000000000000007", ("one", 3)))
    assert relay.up(packet(7), ROBOT, 0.0).route.target == ("one", 3)
    assert relay.up(packet(8), ROBOT, 0.0).route.target == ("two", 2)
    assert relay.up(packet(1 << 60), ROBOT, 0.0).route.target == ("any", 1)


@given(st.lists(st.integers(0, 2**64 - 1), min_size=1), st.integers(0, 2**64 - 1), st.integers(0, 15))
def test_a_prefix_holds_what_begins_so(ids, session_id, digits):
    text = f"{session_id:016x}"[:digits] + "*"
    for one in (*ids, session_id):
        assert Prefix.parse(text).holds(one) == f"{one:016x}".startswith(text[:-1])


def test_unknown_sessions_and_short_packets_are_counted_and_dropped():
    relay = table(("0000000000000007", SERVICE))
    assert relay.up(packet(8), ROBOT, 0.0, packets=3) is None
    assert relay.up(packet(7, 29), ROBOT, 0.0) is None
    assert relay.rejected == {"unknown": 3, "short": 1}
    assert relay.legs == []


def test_a_target_may_move_and_its_sessions_go_on():
    relay = table()
    leg = admit(relay)
    relay.add(Prefix.parse("*"), OTHER, 1.0)
    assert relay.up(packet(7), ROBOT, 1.0) is leg
    assert relay.down(leg, data(7), OTHER, 1.0)
    assert not relay.down(leg, data(7), SERVICE, 1.0)


def test_a_route_of_one_session_moves_its_newcomers_and_nobody_else():
    relay = table(("*", SERVICE))
    newcomer, other, admitted = relay.up(packet(7), ROBOT, 0.0), relay.up(packet(8), ROBOT, 0.0), admit(relay, 9)
    relay.add(Prefix.parse(f"{7:016x}"), OTHER, 0.0)
    assert list(relay.closed) == [newcomer]
    assert relay.up(packet(7), ROBOT, 0.0).route.target == OTHER
    relay.remove(Prefix.parse(f"{7:016x}"))
    assert len(relay.closed) == 2
    assert relay.up(packet(7), ROBOT, 0.0).route.target == SERVICE
    assert relay.up(packet(8), ROBOT, 0.0) is other
    assert relay.up(packet(9), ROBOT, 0.0) is admitted


def test_a_new_route_takes_its_sessions_and_a_removed_one_ends_them():
    relay = table()
    first, second = admit(relay, 7), admit(relay, 8)
    relay.add(Prefix.parse("0000000000000007"), OTHER, 1.0)
    assert list(relay.closed) == [first]
    assert relay.up(packet(7), ROBOT, 1.0).route.target == OTHER
    assert relay.remove(Prefix.parse("*"))
    assert not relay.remove(Prefix.parse("*"))
    assert list(relay.closed) == [first, second]
    assert relay.up(packet(8), ROBOT, 1.0) is None


# --- who gets what ------------------------------------------------------------------------------------------------


def test_only_the_target_gets_through_to_a_robot_and_only_with_its_session():
    relay = table()
    leg = admit(relay)
    admit(relay, 8)
    assert not relay.down(leg, data(7), OTHER, 1.0)
    assert not relay.down(leg, data(8), SERVICE, 1.0)
    assert not relay.down(leg, packet(7), SERVICE, 1.0)  # a target asks for nothing
    assert not relay.down(leg, b"short", SERVICE, 1.0)
    assert relay.rejected == {"stranger": 1, "session": 3}


def test_a_newcomer_gets_a_small_multiple_of_what_it_sent_until_it_speaks_after_an_answer():
    relay = table()
    leg = relay.up(packet(7, 100), ROBOT, 0.0)
    assert relay.down(leg, data(7, 300), SERVICE, 0.0)
    assert not relay.down(leg, data(7, 100), SERVICE, 0.0)
    assert relay.rejected == {"amplification": 1}
    assert relay.up(packet(7, 100), ROBOT, 0.1) is leg
    assert relay.down(leg, data(7, 5000), SERVICE, 0.1)


def test_a_robot_on_the_move_is_not_held_up():
    relay = table()
    admit(relay)
    leg = relay.up(packet(7, 100), ("198.51.100.9", 1), 1.0)
    assert relay.down(leg, data(7, 50_000), SERVICE, 1.0)
    assert leg.session is relay.sessions[7]


def test_addresses_of_a_session_have_legs_of_their_own():
    relay = table()
    legs = [admit(relay, 7, (f"192.0.2.{i}", 5000)) for i in range(3)]
    assert len(set(map(id, legs))) == 3
    assert len(relay.sessions) == 1


def test_the_address_that_was_not_answered_for_longest_makes_room():
    relay = table(addresses=2)
    first, second = admit(relay, 7, ("a", 1), 0.0), admit(relay, 7, ("b", 1), 1.0)
    relay.down(first, data(7), SERVICE, 2.0)  # the robot is still there
    third = admit(relay, 7, ("c", 1), 3.0)
    assert list(relay.closed) == [second]
    assert set(relay.sessions[7].legs.values()) == {first, third}


def test_idle_addresses_are_forgotten_newcomers_sooner():
    relay = table(idle=60.0)
    old = admit(relay)
    new = relay.up(packet(8), ROBOT, 0.0)
    relay.expire(NEWCOMER_IDLE - 0.1)
    assert not relay.closed
    relay.expire(NEWCOMER_IDLE)
    assert list(relay.closed) == [new]
    relay.expire(60.0)
    assert list(relay.closed) == [new, old]
    assert not relay.sessions


def test_further_sessions_than_there_is_room_for_disturb_none():
    relay = table(sessions=1)
    admit(relay, 7)
    late = relay.up(packet(8), ROBOT, 0.0)
    assert relay.down(late, data(8), SERVICE, 0.0)
    assert relay.up(packet(8), ROBOT, 0.0) is late
    assert set(relay.sessions) == {7}
    assert relay.rejected == {"sessions_full": 1}


# --- rates --------------------------------------------------------------------------------------------------------


def test_a_bucket_passes_its_rate_and_one_burst():
    bucket = Bucket(rate=1000, capacity=500, now=0.0)
    passed = sum(100 for i in range(1000) if bucket.consume(100, i * 0.01))
    assert 10_400 <= passed <= 10_600  # 9.99 s of 1000 B/s and 500 B; the last may overdraw


def test_a_session_has_a_rate_in_each_direction_and_others_have_theirs():
    relay = table(rate_bps=8e4, burst=0.1)  # 10 kB/s, 1 kB at once
    leg, other = admit(relay, 7), admit(relay, 8)
    up = sum(relay.up(packet(7, 500), ROBOT, 1.0) is not None for _ in range(100))
    down = sum(relay.down(leg, data(7, 500), SERVICE, 1.0) for _ in range(100))
    assert (up, down) == (2, 2)
    assert relay.sessions[7].dropped == 196
    assert relay.up(packet(8, 500), ROBOT, 1.0) is other
    assert relay.up(packet(7, 500), ROBOT, 2.0) is leg


def test_a_flood_from_made_up_addresses_touches_no_session_that_runs():
    """The flood knows the session's id: nothing worse can come from who does not hold its key."""
    relay = table(rate_bps=8e6, newcomers=16)
    leg = admit(relay)
    through = 0
    for i in range(20_000):
        now = 1.0 + i * 1e-4
        through += relay.up(packet(7, 1200), (f"198.51.100.{i % 256}", i % 40_000), now) is not None
        if i % 100 == 0:
            assert relay.up(packet(7, 200), ROBOT, now) is leg
            assert relay.down(leg, data(7, 200), SERVICE, now)
    assert through * 1200 <= 2 * 1e6 + 1e6 * 0.05 + 1200  # the target gets no more of it than one session's rate
    assert len(relay.legs) <= 1 + 16
    assert leg in relay.legs


# --- ids that change with each handshake ---------------------------------------------------------------------------


def test_packets_are_known_by_the_ids_that_their_target_uses():
    relay = table()
    assert relay.up(data(7), ROBOT, 0.0) is None  # before any handshake
    leg = admit(relay)
    assert relay.up(data(7), ROBOT, 1.0) is leg
    assert relay.up(data(7, handshake=1), ROBOT, 1.0) is None
    assert relay.down(leg, data(7, handshake=1), SERVICE, 1.0)  # WELCOME
    moved = relay.up(data(7, handshake=1), ("198.51.100.9", 1), 1.0)
    assert (moved.session_id, moved.route.target) == (7, SERVICE)
    assert relay.rejected == {"unknown": 2}


def test_a_session_id_is_good_for_nothing_but_a_hello():
    relay = table()
    admit(relay)
    assert relay.up(b"\x20" + packet(7)[1:], ROBOT, 1.0) is None


def test_a_target_cannot_take_another_sessions_packets():
    relay = table(("0000000000000007", SERVICE), ("*", OTHER))
    leg, hostile = admit(relay, 7), admit(relay, 8)
    assert not relay.down(hostile, data(7), OTHER, 1.0)
    assert relay.up(data(7), ("198.51.100.9", 1), 1.0).route.target == SERVICE
    # Not even by an id that is a session's own.
    assert relay.down(hostile, b"\x20" + packet(7)[1:], OTHER, 1.0)
    assert relay.up(packet(7), ROBOT, 1.0) is leg


def test_a_flood_of_made_up_handshakes_holds_up_no_robot_that_moves():
    relay = table(newcomers=8)
    admit(relay)
    for number in range(100):
        relay.up(packet(1000 + number), ("198.51.100.1", number), 1.0)
    assert relay.rejected["newcomers"]
    moved = relay.up(data(7), ("192.0.2.2", 5000), 1.0)
    assert relay.down(moved, data(7), SERVICE, 1.0)
    assert moved.session is relay.sessions[7]


def test_a_flood_through_newcomers_holds_up_no_robot_that_moves():
    relay = table(rate_bps=8e5, newcomers=8)
    admit(relay)
    for number in range(1000):  # more than newcomers may send together
        relay.up(packet(1000 + number % 8, 1200), ("198.51.100.1", number % 8), 1.0)
    assert relay.rejected["rate"]
    moved = relay.up(data(7), ("192.0.2.2", 5000), 1.0)
    assert relay.down(moved, data(7), SERVICE, 1.0)


def test_sessions_that_somebody_answers_in_the_targets_name_keep_no_robot_out():
    relay = table(sessions=4)
    alive = admit(relay, 7)
    for number in range(3):
        admit(relay, 100 + number, ("198.51.100.1", number))
    for now in (1.0, 2.0, SILENT):  # a bridge's end speaks all the time; who makes up its words once
        assert relay.down(alive, data(7), SERVICE, now)
        for number in range(3):
            assert relay.up(packet(100 + number), ("198.51.100.1", number), now)
    late = admit(relay, 8, ("192.0.2.2", 5000), now=SILENT)
    assert late.session is relay.sessions[8]
    assert set(relay.sessions) == {7, 8, 101, 102}
    assert alive in relay.legs


def test_who_overheard_a_session_opens_no_more_addresses_than_it_may_have():
    relay = table(newcomers=1, addresses=4)
    admit(relay)
    opened = [relay.up(data(7), ("198.51.100.1", number), 0.0) for number in range(100)]
    assert sum(leg is not None for leg in opened) == 4


def test_made_up_ids_as_if_from_the_target_push_out_none_that_is_in_use():
    relay = table()
    leg = admit(relay)
    assert relay.up(data(7), ROBOT, 0.0) is leg
    for number in range(100):
        relay.down(leg, data(number, handshake=50), SERVICE, 1.0)
    assert relay.up(data(7), ROBOT, 1.0) is leg
    assert len(leg.ids) == 4
    assert relay.down(leg, data(7, handshake=1), SERVICE, 2.0)
    assert relay.up(data(7, handshake=1), ROBOT, 2.0) is leg  # new keys take its place
    relay.close(leg)
    empty = deep_size(relay)
    for number in range(10, 60):
        relay.close(admit(relay, number))
    relay.closed.clear()  # as its owner does
    relay.sessions.clear()
    assert deep_size(relay) <= empty


def test_ids_are_few_and_end_with_their_addresses():
    relay = table()
    leg = admit(relay)
    for handshake in range(1, 9):
        assert relay.down(leg, data(7, handshake=handshake), SERVICE, 1.0)
    assert relay.up(data(7, handshake=8), ROBOT, 1.0) is leg
    assert relay.up(data(7, handshake=1), ROBOT, 1.0) is None
    relay.close(leg)
    assert relay.up(data(7, handshake=8), ROBOT, 1.0) is None


# --- any packets in any order --------------------------------------------------------------------------------------

LIMITS = RelayLimits(sessions=2, addresses=2, newcomers=3, rate_bps=8e5, idle=20.0)
SOURCES = st.integers(0, 5).map(lambda i: (f"192.0.2.{i}", 5000))
IDS = st.integers(1, 4)
SIZES = st.integers(0, 1500)


class RelayMachine(RuleBasedStateMachine):
    """Keeps books beside the table: bounds hold, and nobody gets what is not theirs."""

    def __init__(self):
        super().__init__()
        self.now = 0.0
        self.relay = RelayTable(LIMITS)
        self.relay.add(Prefix.parse("0000000000000001"), OTHER, 0.0)
        self.relay.add(Prefix.parse("000000000000000*"), SERVICE, 0.0)
        self.came, self.went = {}, {}
        self.opened = set()

    @rule(session_id=IDS, source=SOURCES, size=SIZES)
    def from_a_robot(self, session_id, source, size):
        sent = packet(session_id, size)[:size]
        before = self.relay.rejected.total()
        leg = self.relay.up(sent, source, self.now)
        assert (leg is None) == (self.relay.rejected.total() > before) or "sessions_full" in self.relay.rejected
        if leg is not None:
            assert (leg.session_id, leg.source) == (session_id, source)
            assert leg.route.target == (OTHER if session_id == 1 else SERVICE)
            self.opened.add(leg)
            self.came[leg] = self.came.get(leg, 0) + size

    @precondition(lambda self: self.relay.legs)
    @rule(
        pick=st.integers(0, 100), session_id=IDS | st.none(), origin=st.sampled_from([SERVICE, OTHER, None]), size=SIZES
    )
    def from_a_target(self, pick, session_id, origin, size):
        leg = self.relay.legs[pick % len(self.relay.legs)]
        answer = data(session_id or leg.session_id, size)[:size]
        newcomer = leg.session_id not in self.relay.sessions
        if self.relay.down(leg, answer, origin or leg.route.target, self.now):
            assert origin in (None, leg.route.target)
            self.went[leg] = self.went.get(leg, 0) + size
            if newcomer:
                assert self.went[leg] <= AMPLIFICATION * self.came[leg]

    @rule(seconds=st.floats(0, 30))
    def time_passes(self, seconds):
        self.now += seconds
        self.relay.expire(self.now)

    @rule()
    def a_route_comes_or_goes(self):
        if not self.relay.remove(Prefix.parse("0000000000000002")):
            self.relay.add(Prefix.parse("0000000000000002"), SERVICE, self.now)

    @invariant()
    def bounded_and_consistent(self):
        legs = self.relay.legs
        assert len(self.relay.sessions) <= LIMITS.sessions
        assert all(1 <= len(s.legs) <= LIMITS.addresses for s in self.relay.sessions.values())
        assert all(len(r.newcomers) <= LIMITS.newcomers for r in self.relay.routes)
        listed = [leg for s in self.relay.sessions.values() for leg in s.legs.values()]
        listed += [leg for r in self.relay.routes for leg in r.newcomers.values()]
        assert set(listed) == set(legs)
        assert len(listed) == len(legs)
        # Every leg that ever was is either there or handed back for its port to be closed, once.
        assert self.opened == set(legs) | set(self.relay.closed)
        assert len(self.relay.closed) == len(set(self.relay.closed))
        assert not set(legs) & set(self.relay.closed)


RelayMachine.TestCase.settings = settings(max_examples=25, stateful_step_count=40, deadline=None)
test_any_packets_in_any_order = RelayMachine.TestCase


@given(data=st.binary(max_size=600), segment=st.none() | st.integers(1, 700))
@settings(max_examples=60, deadline=None)
def test_batches_are_split_into_what_belongs_together(data, segment):
    parts = list(same_session(memoryview(data), segment))
    assert b"".join(part for part, _, _ in parts) == data
    step = segment or max(1, len(data))
    datagrams = [data[at : at + step] for at in range(0, len(data), step)] or [b""]
    assert sum(count for _, _, count in parts) == len(datagrams)
    for part, size, count in parts:
        if count > 1:
            assert size == segment
            assert len({bytes(part[at + 1 : at + 9]) for at in range(0, len(part), size)}) == 1


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"sessions": 0}, "sessions must be at least 1"),
        ({"rate_bps": 0}, "rate_bps must be above 0"),
        ({"idle": float("nan")}, "idle"),
    ],
)
def test_limits_that_cannot_work_are_refused_by_name(wrong, says):
    with pytest.raises(ValueError, match=says):
        RelayLimits(**wrong)
