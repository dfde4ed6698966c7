"""The sending half: what leaves when, sealed under whose keys, by which path."""

import math
from collections import Counter

import pytest

from skytether.wire import Config, Direction, PathUse, Role, Topic
from skytether.wire.codec import packet
from skytether.wire.codec.ciphers import Ciphers
from skytether.wire.codec.plaintext import INNER, PREFIX
from skytether.wire.fec.loss import LossModel
from skytether.wire.measure.counters import Outbound
from skytether.wire.measure.rtt import RttEstimator
from skytether.wire.path.path import Path
from skytether.wire.reliable.reliable_sender import ReliableSender
from skytether.wire.send.sender import MAX_ASTRAY, Sender
from skytether.wire.state.epoch import MAX_BYTES, Epoch, SendTopic

ROBOT, SERVICE = Role.ROBOT, Role.SERVICE
OURS, THEIRS = bytes(32), bytes(range(32))
TAKES = Ciphers(THEIRS, OURS, bytes(8), 1)
SCAN = Topic("scan", "a/msg/B", Direction.IN, priority=100, lifespan=0.2, delivery=0.5)
IMAGE = Topic("image", "a/msg/B", Direction.IN, priority=10, lifespan=0.5, depth=4, delivery=0.5)
ESTOP = Topic("estop", "a/msg/B", Direction.IN, priority=127, lifespan=0.2, delivery=0.5, paths=PathUse.REDUNDANT)
PLAIN = Config(assumed_loss=0.0)


class End:
    """A sender under keys, with one path that has an address."""

    def __init__(self, config=PLAIN):
        self.config = config
        self.path = self.another(0)
        self.sender = Sender(config, self.path)
        self.topics = {t.name: SendTopic(i, t, Outbound()) for i, t in enumerate((SCAN, IMAGE, ESTOP), 1)}
        self.epoch = Epoch(1, Ciphers(OURS, THEIRS, bytes(8), 1), (), list(self.topics.values()), [], b"peer")

    def another(self, number):
        path = Path(number, self.config, 0.0)
        path.address = f"there {number}"
        return path

    def begin(self):
        self.sender.start_epoch(self.epoch)
        return self

    def queue(self, topic, payload=b"x", at=0.0, extra=0):
        self.sender.queue_message(self.topics[topic.name], payload, at, extra)

    def packets(self, path=None, now=0.0):
        out = []
        while batches := self.sender.transmit(path or self.path, now):
            for batch in batches:
                step = batch.segment or len(batch.data)
                out += [bytes(batch.data[i : i + step]) for i in range(0, len(batch.data), step)]
        return out

    def all_packets(self, now=0.0):
        """What leaves at the path's rate from now on, and the time then."""
        out = self.packets(now=now)
        while (due := self.sender.next_timer()) < math.inf:
            now = max(now, due)
            out += self.packets(now=now)
        return out, now

    def payloads(self, packets):
        """Of packets that are a whole message each."""
        return [TAKES.open_packet(one)[INNER.size :] for one in packets]


def test_without_keys_or_an_address_nothing_leaves():
    end = End()
    end.sender.send_frame(end.path, b"ping", 0.0)
    assert end.packets() == []
    end.begin()
    end.queue(SCAN)
    end.path.address = None
    assert end.packets() == []
    assert end.sender.next_timer() == math.inf
    end.path.address = "there"
    assert end.sender.next_timer() == 0.0
    assert end.sender.next_timer(full={0}) == math.inf, "that one takes nothing now"
    assert end.payloads(end.packets()) == [b"x"]
    assert end.sender.next_timer() == math.inf


def test_under_spent_keys_nothing_leaves_any_more():
    end = End().begin()
    end.queue(SCAN)
    end.epoch.bytes_sent = MAX_BYTES
    assert end.packets() == []
    assert end.sender.next_timer() == math.inf
    end.sender.send_frame(end.path, b"ping", 0.0)
    assert end.sender.send_frame_to("elsewhere", end.path, b"ping", 0.0) == 0
    assert end.path.packets_sent == 0


def test_what_leaves_is_numbered_and_counted():
    end = End().begin()
    for payload in (b"one", b"two"):
        end.queue(SCAN, payload)
        assert end.payloads(packets := end.packets()) == [payload]
        assert packet.pull_header(packets[0])[4] == 1
    counters = end.topics["scan"].counters
    assert (counters.sent, counters.payload_sent, end.topics["scan"].sequence, end.epoch.next_number) == (2, 6, 2, 2)
    assert counters.bytes_sent == end.path.bytes_sent == end.epoch.bytes_sent
    end.queue(IMAGE, bytes(10_000))
    shards = end.packets()
    assert {packet.pull_header(one)[3] for one in shards} == {2}
    assert sum(map(len, shards)) == end.topics["image"].counters.bytes_sent


def test_new_keys_drop_what_waits_and_changed_keys_of_the_same_peer_do_not():
    end = End().begin()
    end.queue(SCAN, b"kept")
    end.sender.change_keys(end.epoch)
    assert end.payloads(end.packets()) == [b"kept"]
    end.queue(IMAGE, bytes(100_000))
    end.sender.transmit(end.path, 0.0)
    end.sender.send_frame_to("elsewhere", end.path, b"ping", 0.0)
    end.sender.start_epoch(end.epoch)
    assert end.packets() == []
    assert not end.sender.astray


def test_a_higher_priority_goes_before_the_rest_of_a_large_message():
    end = End(Config(assumed_loss=0.0, burst=5000)).begin()
    end.queue(IMAGE, bytes(60_000))
    assert end.sender.transmit(end.path, 0.0)
    end.queue(SCAN, b"now")
    kinds = [packet.pull_header(one)[4] for one in end.packets(now=0.05)]
    assert kinds[0] == 1
    assert set(kinds[1:]) == {2}


def test_a_large_message_that_is_too_old_is_not_sent_on():
    end = End(Config(assumed_loss=0.0, burst=5000)).begin()
    end.queue(IMAGE, bytes(60_000))
    assert end.sender.transmit(end.path, 0.0)
    assert end.packets(now=IMAGE.lifespan + 0.01) == []
    assert end.topics["image"].counters.expired == 1


def test_a_frame_to_another_address_is_bounded_and_told_of_as_astray():
    end = End().begin()
    sizes = [end.sender.send_frame_to("elsewhere", end.path, b"ping", 0.0) for _ in range(MAX_ASTRAY + 3)]
    assert all(sizes[:MAX_ASTRAY])
    assert sizes[MAX_ASTRAY:] == [0, 0, 0]
    assert {(sent.address, sent.path) for sent in end.sender.astray} == {("elsewhere", 0)}
    assert [TAKES.open_packet(sent.data)[INNER.size :] for sent in end.sender.astray] == [b"ping"] * MAX_ASTRAY
    assert end.path.astray(0.0) == ((0, MAX_ASTRAY),)
    assert end.path.bytes_sent == sum(sizes)


def test_a_frame_leaves_at_once_however_slow_the_path_is():
    end = End(Config(assumed_loss=0.0, rate_bps=100_000)).begin()
    end.queue(SCAN, bytes(1000))
    end.queue(IMAGE, bytes(60_000))
    end.packets()
    end.queue(SCAN, b"waits for its turn")
    end.sender.send_frame(end.path, b"ping", 0.0)
    assert end.sender.next_timer() == 0.0
    assert end.payloads(end.packets())[0] == b"ping"


def test_where_the_path_changes_what_waits_and_what_may_be_lost_goes_by_the_other():
    end = End().begin()
    second = end.another(1)
    end.sender.use([end.path, second], end.path, second, False, 0.0)
    end.queue(ESTOP, b"both")
    assert end.payloads(end.packets()) == end.payloads(end.packets(second)) == [b"both"]
    end.queue(SCAN, b"sent before the break")
    end.packets(now=0.1)
    end.queue(SCAN, b"waits", at=0.1)
    end.sender.use([end.path, second], second, None, False, 0.1)
    assert sorted(end.payloads(end.packets(second, now=0.1))) == [b"both", b"sent before the break", b"waits"]
    assert end.packets(now=0.1) == []


def test_while_two_paths_are_in_use_for_all_everything_goes_by_both():
    end = End().begin()
    second = end.another(1)
    end.sender.use([end.path, second], end.path, second, True, 0.0)
    end.queue(SCAN, b"small")
    end.queue(IMAGE, bytes(5000))
    first, other = end.packets(), end.packets(second)
    for packets in (first, other):
        assert {packet.pull_header(one)[4] for one in packets} == {1, 2}
    assert {packet.pull_header(one)[8] for one in other} == {1}
    assert len(other) == len(first)


def test_a_path_that_is_given_up_sends_nothing_any_more():
    end = End().begin()
    second = end.another(1)
    end.sender.use([end.path, second], end.path, None, False, 0.0)
    end.sender.send_frame(second, b"ping", 0.0)
    assert end.sender.next_timer() == 0.0
    end.sender.use([end.path], end.path, None, False, 0.0)
    assert end.sender.next_timer() == math.inf


def test_a_velocity_command_waits_for_one_burst_at_most(world, topics):
    config = Config(rate_bps=5e6)
    link = world.link(service={"config": config}, record=True)
    link.publish(SERVICE, "map", bytes(300_000))  # half a second of sending
    link.run(0.1)
    for _ in range(20):
        link.run(0.0007)
        before, asked = len(link.sent[SERVICE]), link.now
        link.publish(SERVICE, "cmd_vel", b"now")
        link.run(0.005)
        first = next((t, i) for i, (t, p) in enumerate(link.sent[SERVICE][before:]) if packet.pull_header(p)[4] == 4)
        assert first[1] <= 2  # packets that went before it
        assert first[0] - asked <= 0.004
        link.run(0.02)
    link.run(1.0)
    assert Counter(m.topic for _, m in link.messages[ROBOT]) == {"cmd_vel": 20, "map": 1}


def test_a_burst_is_a_bound_for_each_call(world):
    config = Config(rate_bps=1e11, burst=6000)
    link = world.link(robot={"config": config})
    robot = link.sessions[ROBOT]
    for _ in range(3):
        robot.publish("camera", bytes(100_000), link.now)
    total, calls = 0, 0
    while batches := robot.transmit(link.now):
        size = sum(len(b.data) for b in batches)
        assert size <= 6000 + 1200
        total, calls = total + size, calls + 1
    assert total > 300_000
    assert calls > 50


def test_the_rate_is_kept(world):
    link = world.link(robot={"config": Config(rate_bps=2e6)}, record=True)
    start = link.now
    link.every(0.02, link.now + 2, lambda: link.publish(ROBOT, "camera", bytes(40_000)))
    link.run(2)
    sent = sum(len(p) for t, p in link.sent[ROBOT] if t > start)
    assert 0.97 * 2e6 / 8 * 2 < sent < 2e6 / 8 * 2 + 5000


def test_copies_are_spread_in_time_and_cost_no_new_number(world):
    link = world.link(record=True)
    start = link.now
    link.publish(SERVICE, "cmd_vel", b"go")
    link.run(0.05)
    copies = [(t - start, packet.pull_header(p)) for t, p in link.sent[SERVICE] if packet.pull_header(p)[4] == 4]
    assert [t for t, _ in copies] == pytest.approx([0, 0.002, 0.004], abs=1e-6)
    assert len({h[3] for _, h in copies}) == 1
    assert len({h[9] for _, h in copies}) == 3
    assert next(t for t in link.sessions[ROBOT].stats(link.now).topics if t.topic == "cmd_vel").duplicate == 2


STATUS = Topic("status", "a/msg/B", Direction.IN, priority=60, lifespan=10.0, depth=10, delivery=0.5, reliable=True)


class ReliableEnd(End):
    """An end with a reliable topic, too."""

    def __init__(self, config=PLAIN):
        super().__init__(config)
        self.topics["status"] = self.epoch.send["status"] = SendTopic(9, STATUS, Outbound())
        self.reliable = ReliableSender(STATUS, self.topics["status"].counters, RttEstimator())
        self.reliable.start_epoch(9, STATUS, self.reliable.counters, 0.0, newcomer=True)
        self.begin()

    def put(self, payload):
        assert self.reliable.put(payload, 0.0, 10_000_000)
        self.sender.queue_reliable(self.reliable)

    def again(self):
        """What is sent because nobody has acknowledged it in time."""
        due = self.reliable.due
        self.reliable.handle_timer(due)
        self.sender.queue_reliable(self.reliable)
        return self.all_packets(due)[0]


def test_a_reliable_message_carries_its_number_and_is_sent_again_as_another_packet():
    end = ReliableEnd()
    for payload in (b"one", b"two"):
        end.put(payload)
    first = end.packets()
    assert end.payloads(first) == [PREFIX.pack(0, 0) + b"one", PREFIX.pack(1, 1) + b"two"]
    assert end.packets(now=0.1) == []
    again = end.again()
    assert end.payloads(again)[:1] == [PREFIX.pack(0, 0) + b"one"]
    assert not set(again) & set(first)


def test_of_a_large_reliable_message_only_what_is_missing_is_sent_again():
    end = ReliableEnd()
    end.put(bytes(20_000))
    shards, _ = end.all_packets()
    (number,) = {packet.pull_header(one)[3] for one in shards}
    again = end.again()
    assert {packet.pull_header(one)[3] for one in again} == {number}, "the same message, sealed once"
    assert len(again) == 1, "one, so that the peer tells what it lacks"
    end.reliable.missing(number, 1, ((0, bytes([0b101])),), 5.0)
    end.sender.queue_reliable(end.reliable)
    lacking, _ = end.all_packets(5.0)
    assert [packet.pull_header(one)[7] for one in lacking] == [0, 2]


def test_a_large_reliable_message_is_sealed_anew_where_its_shards_do_not_fit_any_more():
    end = ReliableEnd(Config(assumed_loss=0.0, mtu=1200, max_mtu=9000))
    end.path.mtu.size = 9000
    end.put(bytes(20_000))
    shards, _ = end.all_packets()
    (before,) = {packet.pull_header(one)[3] for one in shards}
    assert max(map(len, shards)) > 1200
    end.path.mtu.size = 1200  # it changed, or was found out
    again = end.again()
    assert {packet.pull_header(one)[3] for one in again}.isdisjoint({before})
    assert max(map(len, again)) <= 1200
    assert sum(map(len, again)) > 20_000, "all of it"


def test_losses_in_bursts_are_met_by_parity_that_follows_later():
    end = End(Config(assumed_loss=0.1)).begin()
    end.path.redundancy.model = LossModel(0.1, 4.0, 0.01)
    end.topics["image"].delivery = 0.99
    end.queue(IMAGE, bytes(2500))
    at_once = end.packets()
    later, _ = end.all_packets()
    shape = {packet.pull_header(one)[7] for one in at_once}
    assert shape == set(range(len(at_once))), "data alone"
    assert later
    assert {packet.pull_header(one)[3] for one in later} == {packet.pull_header(at_once[0])[3]}
    assert min(packet.pull_header(one)[7] for one in later) == len(at_once)
    assert end.topics["image"].counters.bytes_redundant == sum(map(len, later))


def test_a_copy_that_is_too_old_is_not_sent():
    end = End().begin()
    end.queue(SCAN, extra=2)
    assert len(end.packets()) == 1
    assert end.packets(now=SCAN.lifespan + 0.01) == []
    assert end.sender.next_timer() == math.inf
