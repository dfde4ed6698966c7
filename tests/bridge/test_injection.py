"""A live session on real sockets, and a stranger who has seen all its packets and sends what a stranger can make."""

import os
import socket

import pytest

from skytether.bridge.datagrams import DatagramSocket
from skytether.wire import Config, Session
from skytether.wire.codec import packet
from skytether.wire.events import Connected, Disconnected, PeerMoved
from skytether.wire.topic import Role

SESSION_ID = 7
"""Of the fixture `ends`."""


@pytest.fixture
def seen(monkeypatch):
    """All datagrams that any end sends, by the port it sends from."""
    packets = {}
    send = DatagramSocket.send

    def record(self, data, address, segment=None):
        step = segment or max(1, len(data))
        mine = packets.setdefault(self.address[1], [])
        mine += [bytes(data[at : at + step]) for at in range(0, len(data), step)]
        return send(self, data, address, segment)

    monkeypatch.setattr(DatagramSocket, "send", record)
    return packets


@pytest.fixture
def stranger():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        sock.setblocking(False)
        yield sock


def hello(key, topics):
    """What a robot with some key says first."""
    session = Session(Role.ROBOT, SESSION_ID, key, topics, config=Config(), entropy=os.urandom, now=0.0)
    session.set_peer("service")
    session.handle_timer(0.0)
    (sent,) = session.transmit(0.0)
    return bytes(sent.data)


def data_of(packets):
    return [p for p in packets if p[0] in (packet.DATA, packet.SHARD)]


def changed(data, at, value):
    return data[:at] + bytes([value]) + data[at + 1 :]


def forged(real):
    """With a number that was not used, so that it must be opened to be found out."""
    fields = packet.pull_header(real)
    size = len(real) - packet.HEADER_SIZE
    kind, session_id, epoch = fields[:3]
    common = packet.push_common(kind, session_id, epoch, fields[3] + 5000, 1, size)
    return common + packet.push_shard(0, 0, 0, fields[9] + 1, fields[10]) + os.urandom(size)


KINDS = {
    "wrong key": (lambda seen, spec: [hello(bytes(32), spec.topics)], "hello_forged"),
    "replayed hello": (lambda seen, spec: [p for p in seen if p[0] == packet.HELLO][:1], "hello_replayed"),
    "wrong version": (lambda seen, spec: [changed(p, 0, 0x10) for p in data_of(seen)], "version"),
    "unknown type": (lambda seen, spec: [changed(p, 0, packet.VERSION << 4 | 0xF) for p in data_of(seen)], "type"),
    "other session": (lambda seen, spec: [changed(p, 8, p[8] ^ 8) for p in data_of(seen)], "session"),
    "other keys": (lambda seen, spec: [changed(p, 9, p[9] ^ 0x55) for p in data_of(seen)], "forged"),
    "session's own id": (
        lambda seen, spec: [p[:1] + SESSION_ID.to_bytes(8, "big") + p[9:] for p in data_of(seen)],
        "session",
    ),
    "replayed": (lambda seen, spec: data_of(seen), "repeated"),
    "cut to nothing": (lambda seen, spec: [p[: packet.HEADER_SIZE] for p in seen], "short"),
    "forged": (lambda seen, spec: [forged(p) for p in data_of(seen)], "forged"),
    "unknown topic": (lambda seen, spec: [changed(changed(p, 16, 0xFF), 13, 0xFF) for p in data_of(seen)], "forged"),
}


@pytest.mark.parametrize("kind", KINDS)
def test_what_a_stranger_sends_is_counted_and_changes_nothing(ends, seen, stranger, wait_for, kind):
    service, robot = ends.pair()
    for i in range(20):
        robot.publish("force", i.to_bytes(2, "big"))
        robot.publish("camera", os.urandom(5000))
    service.graph.wait_messages(40)
    make, reason = KINDS[kind]
    injected = make(list(seen[robot.address[1]]), service.spec)[-50:]
    assert injected
    before = service.stats()
    for i, one in enumerate(injected):
        stranger.sendto(one, service.address)
        robot.publish("force", b"live" + i.to_bytes(2, "big"))
    if reason is not None:
        wait_for(lambda: service.stats().rejected.get(reason, 0) >= before.rejected.get(reason, 0) + len(injected))
    service.graph.wait_messages(40 + len(injected))
    assert {m for t, m in service.graph.messages if m.startswith(b"live")} == {
        b"live" + i.to_bytes(2, "big") for i in range(len(injected))
    }
    after = service.stats()
    assert len(service.graph.messages) == 40 + len(injected)
    assert after.paths[0].address == before.paths[0].address
    assert after.handshakes == 1
    for end in (service, robot):
        assert [end.graph.count(kind) for kind in (Connected, Disconnected, PeerMoved)] == [1, 0, 0]
    with pytest.raises(BlockingIOError):
        stranger.recv(2000)  # never an answer


def test_cut_and_damaged_packets_at_both_ends(ends, seen, stranger, wait_for):
    service, robot = ends.pair()
    for _ in range(10):
        robot.publish("camera", os.urandom(3000))
        service.publish("cmd_vel", os.urandom(3000))
    service.graph.wait_messages(10)
    robot.graph.wait_messages(10)
    for end, other in ((service, robot), (robot, service)):
        refused = sum(end.stats().rejected.values())
        packets = seen[other.address[1]][-20:]
        sent = 0
        for one in packets:
            for cut in (1, packet.COMMON_SIZE, len(one) // 2, len(one) - 1):
                stranger.sendto(one[:cut], end.address)
            for at in range(0, len(one), 7):
                stranger.sendto(changed(one, at, one[at] ^ 0x10), end.address)
                sent += 1
        wait_for(lambda end=end, want=refused + sent: sum(end.stats().rejected.values()) >= want)
    robot.publish("force", b"last")
    service.publish("cmd_vel", b"last")
    service.graph.wait(lambda port: ("force", b"last") in port.messages)
    robot.graph.wait(lambda port: ("cmd_vel", b"last") in port.messages)
    assert len(service.graph.messages) == len(robot.graph.messages) == 11
    for end in (service, robot):
        assert [end.graph.count(kind) for kind in (Connected, Disconnected, PeerMoved)] == [1, 0, 0]
    with pytest.raises(BlockingIOError):
        stranger.recv(2000)
