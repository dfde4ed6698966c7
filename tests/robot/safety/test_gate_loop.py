"""The gate's loop with made-up time and real sockets, without processes: what comes from others, and who is gone."""

import json
import math
import socket
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from skytether.control.admittance import STANDSTILL, Velocity
from skytether.messages import LaserScan, Message, Twist, decode, encode
from skytether.robot.safety.client import GateError, GateLink, ask
from skytether.robot.safety.config import SafetyConfig
from skytether.robot.safety.gate import GateLoop, Keeper
from skytether.robot.safety.hardware import SocketSensors, SocketWheels
from skytether.robot.safety.protocol import GateState, pack_state, unpack_beat, unpack_state

SCAN = LaserScan(
    angle_min=-math.pi / 2,
    angle_increment=math.pi / 180,
    range_min=0.05,
    range_max=8.0,
    ranges=np.full(181, 4.0, dtype=np.float32),
)


class Hardware:
    """Sensors that see, and wheels that remember."""

    def __init__(self) -> None:
        self.told: list[Velocity] = []

    def read(self) -> list[tuple[str, Message]]:
        return [("scan", SCAN)]

    def write(self, velocity: Velocity) -> None:
        self.told.append(velocity)

    def close(self) -> None:
        """Nothing is open."""


class Bench:
    def __init__(self, folder: Path) -> None:
        self.now = 50.0
        self.folder = folder
        self.hardware = Hardware()
        self.guard, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        for end in (self.guard, theirs):
            end.setblocking(False)
        self._theirs = theirs
        config = SafetyConfig.model_validate(
            {"footprint": {"radius": 0.3}, "sensors": {"scan": {}}, "folder": str(folder), "rate_hz": 100}
        )
        self.loop = GateLoop(config, theirs, self.hardware, self.hardware, clock=lambda: self.now)
        self.link = GateLink(folder, clock=lambda: self.now)
        for _ in range(25):  # the agent begins from a standstill
            self.link.send(STANDSTILL)
            self.turn()

    def turn(self, *, answered: bool = True) -> Velocity:
        """One turn of the loop; what it told the guard."""
        self.now += 0.01
        self.loop.turn(self.now)
        beat = unpack_beat(self.guard.recv(64))
        if answered:
            self.guard.send(b".")
        return beat.velocity

    def close(self) -> None:
        self.link.close()
        self.guard.close()
        self._theirs.close()
        self.loop._commands.close()


@pytest.fixture
def bench(tmp_path):
    bench = Bench(tmp_path)
    yield bench
    bench.close()


def test_what_the_agent_wants_goes_to_the_guard(bench):
    for _ in range(30):
        bench.link.send(Velocity(0.2, 0.1))
        velocity = bench.turn()
    assert velocity == pytest.approx((0.2, 0.1))
    assert not bench.hardware.told  # the wheels are the guard's


def test_a_guard_that_does_not_answer_makes_the_gate_stop_the_wheels_itself(bench):
    for _ in range(30):
        bench.link.send(Velocity(0.2, 0.0))
        bench.turn()
    for _ in range(12):
        bench.link.send(Velocity(0.2, 0.0))
        velocity = bench.turn(answered=False)
    assert velocity == STANDSTILL
    assert set(bench.hardware.told) == {STANDSTILL}
    bench.link.send(Velocity(0.2, 0.0))
    bench.guard.send(b".")
    assert bench.turn() != STANDSTILL


def test_a_guard_that_is_gone_is_noticed(bench):
    bench.guard.close()
    bench.loop.turn(bench.now)
    assert bench.loop.guard_gone


def test_what_is_no_command_and_a_flood_of_them_are_named_once(bench, caplog):
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as stranger:
        stranger.setblocking(False)
        for _ in range(20):
            stranger.sendto(b"rubbish", bench.link._address)
            bench.turn()
    for _ in range(5):
        try:
            for _ in range(60):
                bench.link.send(Velocity(0.1, 0.0))
        except BlockingIOError:  # the kernel keeps no more
            pass
        bench.turn()
    said = [record.message for record in caplog.records]
    assert sum("no command comes" in sentence for sentence in said) == 1
    assert sum("within one turn" in sentence for sentence in said) <= 1


@pytest.mark.parametrize(
    "request_", [b"", b"{", b"[]", b"3", b'"do"', b"{}", b"\xff\xfe", b'{"do": "explode"}', b'{"do": ["stop"]}']
)
def test_a_request_that_is_none_is_refused(bench, request_):
    assert "request" in bench.loop.answer(request_)["refused"]


def test_stop_reset_and_status(bench):
    assert bench.loop.answer(b'{"do": "status"}')["stopped"] == ""
    stopped = bench.loop.answer(json.dumps({"do": "stop", "reason": "x" * 999}).encode())
    assert stopped["stopped"] == "x" * 200
    bench.turn()
    status = bench.loop.answer(b'{"do": "status"}')
    assert (status["hand"], status["linear_m_s"]) == ("nobody", 0.0)
    assert "comes first" in bench.loop.answer(b'{"do": "start"}')["refused"]
    assert bench.loop.answer(b'{"do": "reset"}')["stopped"] == ""
    assert bench.loop.answer(b'{"do": "status"}')["waiting"] == {"agent": "the reset"}


def test_after_a_reset_nothing_moves_until_a_person_says_start(bench):
    bench.loop.answer(b'{"do": "stop"}')
    bench.loop.answer(b'{"do": "reset"}')
    for _ in range(50):
        bench.link.send(Velocity(0.2, 0.0))
        assert bench.turn() == STANDSTILL
    assert "skytether robot start" in bench.loop.answer(b'{"do": "status"}')["troubles"][0]
    assert bench.loop.answer(b'{"do": "start"}')["started"] == ["agent"]
    for _ in range(30):
        bench.link.send(Velocity(0.2, 0.0))
        velocity = bench.turn()
    assert velocity == pytest.approx((0.2, 0.0))


def test_an_emergency_stop_outlives_the_gate(tmp_path):
    path = tmp_path / "latch"
    assert Keeper(path).before() == ""  # the first gate here
    keeper = Keeper(path)
    keeper._write("somebody fell")
    assert Keeper(path).before() == "somebody fell (before the gate was started again)"
    keeper._write(Keeper(path).before())
    assert Keeper(path).before() == "somebody fell (before the gate was started again)"
    keeper._write("released")
    assert Keeper(path).before() == ""
    path.write_bytes(b"")
    assert "in the middle" in Keeper(path).before()
    path.unlink()
    path.mkdir()
    assert "cannot be read" in Keeper(path).before()


def test_readings_come_as_datagrams_and_others_are_told(tmp_path):
    told = {}
    address = str(tmp_path / "sensors.sock")
    sensors = SocketSensors(address, {"scan": LaserScan}, lambda kind, sentence: told.setdefault(kind, sentence))
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as driver:
        for data in (b"scan\0" + encode(SCAN), b"scan\0\1\2\3", b"odom\0x", b"", b"\0", b"\xff" * 500):
            driver.sendto(data, address)
        found = list(sensors.read())
    assert [topic for topic, _ in found] == ["scan"]
    assert found[0][1].ranges.tolist() == SCAN.ranges.tolist()
    assert set(told) == {"sensors:scan:bytes", "sensors:topic"}
    assert list(sensors.read()) == []
    sensors.close()


def test_wheels_may_come_later(tmp_path):
    path = tmp_path / "wheels.sock"
    wheels = SocketWheels(str(path))
    with pytest.raises(OSError, match="No such file"):
        wheels.write(Velocity(0.1, 0.2))
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as base:
        base.bind(str(path))
        wheels.write(Velocity(0.1, 0.2))
        twist = decode(Twist, base.recv(256))
    assert (twist.linear.x, twist.angular.z) == (0.1, 0.2)
    wheels.close()


def test_whoever_asks_where_no_gate_is_hears_what_to_do(tmp_path):
    with pytest.raises(GateError, match=r"no gate listens at .*skytether robot gate"):
        ask(tmp_path, {"do": "status"})


def test_the_gate_says_to_the_agent_what_the_wheels_were_told(bench):
    with closing(GateLink(bench.folder)) as unheard:
        assert unheard.state() is None
    for _ in range(30):
        bench.link.send(Velocity(0.2, 0.1))
        bench.turn()
    state = bench.link.state()
    assert (state.at, state.stopped, state.hand) == (bench.now, "", "agent")
    assert state.told == pytest.approx((0.2, 0.1))
    bench.loop.answer(json.dumps({"do": "stop", "reason": "ö" * 150}).encode())
    bench.link.send(Velocity(0.2, 0.1))
    bench.turn()
    state = bench.link.state()
    assert (state.stopped, state.hand) == ("ö" * 100, "nobody")


def test_a_stranger_cannot_tell_the_agent_its_state(bench):
    bench.link.send(Velocity(0.2, 0.1))
    bench.turn()
    before = bench.link.state()
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as stranger:
        stranger.bind("")
        lie = pack_state(GateState(99.0, Velocity(0.5, 0.0), 99.0, "", "agent"))
        assert stranger.sendto(lie, bench.link._socket.getsockname()) == len(lie)
    assert bench.link.state() == before
    assert unpack_state(lie[:-1]) is None
