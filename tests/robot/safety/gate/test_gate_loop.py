"""The gate's loop with made-up time and real sockets, without processes: what comes from others, and who is gone."""

import json
import math
import socket
import time
from contextlib import closing, suppress
from itertools import pairwise
from pathlib import Path

import numpy as np
import psutil
import pytest

from skytether.guard import board
from skytether.guard.board import Board, Entry, Role
from skytether.guard.claim import LOCK_FILE, Claim
from skytether.guard.estop import FIRST_ACT, EstopFile, boot_id
from skytether.guard.protocol import Answer, Beat, LastCommand, pack_answer, unpack_beat, unpack_note
from skytether.guard.velocity import STANDSTILL, Velocity
from skytether.messages import Bool, Joy, LaserScan, Message, encode
from skytether.robot.graphs.inbox import Topics
from skytether.robot.safety.client import GateError, GateLink, ask
from skytether.robot.safety.config.safety_config import SafetyConfig
from skytether.robot.safety.gate.gate import GateLoop
from skytether.robot.safety.io.hardware import SocketSensors
from skytether.robot.safety.protocol import COMMAND_SOCKET, GateState, pack_state, unpack_state

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
        self.more: list[tuple[str, Message]] = []

    def stops(self) -> list[tuple[str, Message]]:
        """There is no button."""
        return []

    def read(self) -> list[tuple[str, Message]]:
        return [("scan", SCAN), *self.more]

    def write(self, velocity: Velocity, until: float = 0.0) -> None:
        self.told.append(velocity)

    def sent(self) -> None:
        return None

    def unread(self) -> str:
        return ""

    def listeners(self) -> None:
        return None

    def hearers(self) -> frozenset[str]:
        return frozenset()

    def close(self) -> None:
        """Nothing is open."""


class Bench:
    def __init__(self, folder: Path, *, answers: bool = True) -> None:
        self.now = 50.0
        self.step = 0.0
        """How far the clock goes on each time that somebody looks at it [s]."""
        self.folder = folder
        self.answers = answers
        self.hardware = Hardware()
        self.guard, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        for end in (self.guard, theirs):
            end.setblocking(False)
        self._theirs = theirs
        config = SafetyConfig.model_validate(
            {
                "footprint": {"radius": 0.3},
                "sensors": {"scan": {}},
                "joystick": {"deadman": 0},
                "folder": str(folder),
                "rate_hz": 100,
                "display": {},
            }
        )
        self.board = Board(board.make())
        self.loop = GateLoop(config, theirs, self.hardware, self.hardware, self.board, clock=self.clock)
        self.link = GateLink(folder, clock=lambda: self.now)
        self.answer = Answer(self.now, generation=1)
        self.notes: list[str] = []
        for _ in range(25):  # the agent begins from a standstill
            self.link.send(STANDSTILL)
            self.turn(answered=answers)

    def clock(self) -> float:
        self.now += self.step
        return self.now

    def turn(self, *, answered: bool = True, told: Velocity | None = None) -> Velocity:
        """One turn of the loop; what it told the guard, which tells the wheels so unless something else is given."""
        self.now += 0.01
        self.loop.turn()
        while (note := unpack_note(data := self.guard.recv(512))) is not None:
            self.notes.append(note)
        self.beat = beat = unpack_beat(data) or Beat(0.0, STANDSTILL)
        try:
            while (note := unpack_note(self.guard.recv(512))) is not None:
                self.notes.append(note)
        except BlockingIOError:
            pass
        if answered:
            self.board.put(Role.FIRST, Entry(LastCommand(told or beat.velocity, self.now), left_at=self.now))
            self.guard.send(pack_answer(self.answer._replace(at=self.now)))
        return beat.velocity

    def ask(self, **request: str) -> dict:
        """What a person gets, after as many turns as it takes."""
        with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as link:
            link.connect(str(self.folder / "control.sock"))
            link.send(json.dumps(request).encode())
            link.setblocking(False)
            for _ in range(300):
                self.turn(answered=self.answers)
                try:
                    return json.loads(link.recv(65536))
                except BlockingIOError:
                    time.sleep(0.001)  # the keeper is a thread
        pytest.fail("no answer")

    def close(self) -> None:
        self.link.close()
        self.guard.close()
        self._theirs.close()
        self.loop.close()


@pytest.fixture
def bench(tmp_path):
    bench = Bench(tmp_path)
    yield bench
    bench.close()


def test_a_reset_ends_a_lost_joystick_on_a_robot_that_is_not_stopped(bench):
    for held, turns in ((False, 30), (True, 10)):
        pad = Joy(axes=np.zeros(2, dtype=np.float32), buttons=np.array([held], dtype=np.int32))
        bench.hardware.more = [("joy", pad)]
        for _ in range(turns):
            bench.turn()
    bench.hardware.more = []
    for _ in range(50):
        bench.turn()
    assert any("fell silent" in sentence for sentence in bench.ask(do="status")["troubles"])
    bench.ask(do="reset")
    bench.turn()
    status = bench.ask(do="status")
    assert not any("fell silent" in sentence for sentence in status["troubles"])
    assert status["waiting"] == {"agent": "the reset"}


def test_what_the_agent_wants_goes_to_the_guard(bench):
    for _ in range(30):
        bench.link.send(Velocity(0.2, 0.1))
        velocity = bench.turn()
    assert velocity == pytest.approx((0.2, 0.1))
    assert not bench.hardware.told  # the wheels are the guard's


def drive(bench):
    velocity = Velocity(0.2, 0.0)
    for _ in range(30):
        bench.link.send(velocity)
        said = bench.turn()
    assert said == pytest.approx(velocity)


def test_a_guard_that_tells_the_wheels_nothing_makes_the_gate_brake_the_wheels_itself(bench):
    drive(bench)
    for _ in range(22):
        bench.link.send(Velocity(0.2, 0.0))
        velocity = bench.turn(answered=False)
    assert velocity == STANDSTILL
    told = [velocity.linear for velocity in bench.hardware.told]
    # Within the 0.1 s after which drives stop by themselves, and from then on 2 m/s^2, as much as the time allows.
    assert told[0] >= 0.2 - 2.0 * 0.1 - 1e-9
    steps = [before - after for before, after in pairwise(told)]
    assert all(step <= 0.02 + 1e-9 for step in steps)
    assert told[-1] == 0.0
    assert bench.board.newest().told == LastCommand(STANDSTILL, bench.now)
    assert any("nobody else tells" in note for note in bench.notes)
    bench.board.put(Role.FIRST, Entry(LastCommand(STANDSTILL, bench.now), left_at=bench.now))
    bench.turn()
    count = len(bench.hardware.told)
    bench.link.send(Velocity(0.2, 0.0))
    assert 0 < bench.turn().linear <= 0.021
    assert len(bench.hardware.told) == count


def test_the_gate_goes_on_from_what_the_wheels_were_told(bench):
    drive(bench)
    bench.turn(told=STANDSTILL)  # a driver that was started again
    bench.link.send(Velocity(0.2, 0.0))
    assert bench.turn().linear == pytest.approx(0.01)


def test_what_is_still_faster_is_the_guards_to_brake(bench):
    drive(bench)
    bench.answer = bench.answer._replace(generation=2, stopped="a test")
    bench.link.send(Velocity(0.2, 0.0))
    assert bench.turn().linear == pytest.approx(0.2), "it has not heard of the stop yet"
    said = [bench.turn(told=Velocity(0.2, 0.0)).linear for _ in range(5)]
    assert said == pytest.approx([0.18, 0.16, 0.14, 0.12, 0.1])


def test_a_gate_that_stood_still_goes_on_from_standstill(bench):
    drive(bench)
    bench.now += 1.0
    bench.link.send(Velocity(0.2, 0.0))
    assert 0 < bench.turn(told=STANDSTILL).linear <= 0.011
    assert not bench.hardware.told  # the guard is there: it answers the next beat


def test_a_guard_that_answers_and_whose_writer_is_gone_has_the_gate_brake(bench):
    drive(bench)
    for _ in range(5):
        bench.turn(answered=False)
        bench.guard.send(pack_answer(bench.answer._replace(at=bench.now)))
    assert bench.hardware.told[0].linear == pytest.approx(0.2 - 2.0 * 0.03)  # the third turn without a word


def test_a_guard_that_is_frozen_while_its_writer_tells_the_wheels_leaves_them_to_it(bench):
    drive(bench)
    for _ in range(20):
        bench.turn(answered=False)
        bench.board.put(Role.FIRST, Entry(LastCommand(Velocity(0.1, 0.0), bench.now), left_at=bench.now))
    assert not bench.hardware.told


def test_a_guard_that_is_gone_is_noticed_and_the_gate_ends_once_the_wheels_stand(bench, caplog):
    drive(bench)
    bench.guard.close()
    bench.step = 0.005
    bench.loop.run()
    assert "the guard is gone" in caplog.text
    told = [velocity.linear for velocity in bench.hardware.told]
    assert 0.0 < told[0] < 0.2
    assert told == sorted(told, reverse=True)
    assert told[-1] == 0.0


def test_a_gate_that_goes_on_beside_another_guard_tells_the_wheels_nothing(tmp_path):
    (tmp_path / LOCK_FILE).touch()
    bench = Bench(tmp_path)
    told = list(bench.hardware.told)
    bench.guard.close()
    another = Claim(str(tmp_path))
    bench.loop.run()
    assert bench.hardware.told == told
    assert not another.lost
    bench.close()


def test_what_is_no_command_and_a_flood_of_them_are_named_once(bench, caplog):
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as stranger:
        stranger.setblocking(False)
        for _ in range(20):
            stranger.sendto(b"rubbish", str(bench.folder / COMMAND_SOCKET))
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


def test_a_request_that_is_none_is_refused(bench):
    assert "there is no request 'explode'" in bench.ask(do="explode")["refused"]


def test_a_stop_is_answered_when_the_guard_has_kept_it(bench):
    bench.turn()
    assert bench.ask(do="status")["stopped"] == ""
    bench.answer = bench.answer._replace(generation=2, stopped="x" * 200)
    assert bench.ask(do="stop", reason="x" * 999)["stopped"] == "x" * 200
    assert bench.beat.stopped == "x" * 200
    assert bench.turn() == STANDSTILL
    status = bench.ask(do="status")
    assert (status["hand"], status["linear_m_s"]) == ("nobody", 0.0)
    assert "comes first" in bench.ask(do="start")["refused"]
    assert not (bench.folder / "latch").exists()  # that is the guard's


def test_after_a_reset_nothing_moves_until_a_person_says_start(bench):
    bench.ask(do="stop", reason="a test")
    assert bench.ask(do="reset")["stopped"] == ""
    assert bench.ask(do="status")["waiting"] == {"agent": "the reset"}
    for _ in range(50):
        bench.link.send(Velocity(0.2, 0.0))
        assert bench.turn() == STANDSTILL
    assert "skytether robot start" in bench.ask(do="status")["troubles"][0]
    bench.link.send(Velocity(0.2, 0.0))
    assert bench.ask(do="start")["started"] == ["agent"]
    drive(bench)


def test_who_resets_a_machine_that_was_started_does_not_reset_what_a_person_asked_for(bench):
    bench.answer = bench.answer._replace(generation=1, stopped=FIRST_ACT)
    for _ in range(2):
        bench.turn()
    assert bench.ask(do="status")["stopped"] == FIRST_ACT
    bench.answer = bench.answer._replace(generation=2, stopped="somebody fell")  # by the guard's own way
    for _ in range(2):
        bench.turn()
    assert bench.ask(do="status")["stopped"] == "somebody fell"
    assert "somebody fell" in bench.ask(do="reset", only=FIRST_ACT)["refused"]
    assert not bench.beat.reset


def test_a_stop_is_kept_by_the_gate_where_the_guard_does_not_answer(bench):
    bench.turn()
    bench.answers = False
    stopped = bench.ask(do="stop", reason="released")
    assert (stopped["stopped"], stopped.get("note")) == ("released", None)
    assert "released (before" in EstopFile(str(bench.folder / "latch"), boot_id(), print).before()


def test_a_stop_that_nobody_could_keep_is_in_effect_and_says_so(bench):
    (bench.folder / "latch").mkdir()
    bench.turn()
    bench.answers = False
    stopped = bench.ask(do="stop", reason="x")
    assert stopped["stopped"] == "x"
    assert "could not be kept" in stopped["note"]


def test_a_reset_is_over_when_the_guard_says_so(bench):
    bench.answer = bench.answer._replace(generation=2, stopped="somebody fell")
    bench.turn()
    bench.turn()
    assert bench.ask(do="status")["stopped"] == "somebody fell"
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as link:
        link.connect(str(bench.folder / "control.sock"))
        link.send(b'{"do": "reset"}')
        bench.turn()
        bench.turn()
        assert (bench.beat.reset, bench.beat.seen) == (True, 2)
        bench.answer = bench.answer._replace(generation=3, stopped="")
        bench.turn()
        bench.turn()
        assert json.loads(link.recv(65536))["stopped"] == ""
    assert not bench.beat.reset
    assert bench.beat.stopped == ""


def test_a_reset_does_not_end_a_stop_that_came_after_it(bench):
    """It waited in a gate that hung; meanwhile a person stopped the robot again, by the guard's own way."""
    bench.answer = bench.answer._replace(generation=2, stopped="somebody fell")
    bench.turn()
    bench.turn()
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as link:
        link.connect(str(bench.folder / "control.sock"))
        link.send(b'{"do": "reset"}')
        bench.answer = bench.answer._replace(generation=3)
        bench.turn()
        bench.turn()
        assert not bench.beat.reset
        bench.turn()
        assert json.loads(link.recv(65536))["refused"] == "still stopped: somebody fell"
    assert bench.ask(do="status")["stopped"] == "somebody fell"


def test_a_guard_that_does_not_reset_leaves_the_gate_stopped(bench):
    bench.answer = bench.answer._replace(generation=2, stopped="somebody fell")
    bench.turn()
    bench.turn()
    assert "only it can end the stop" in bench.ask(do="reset")["refused"]


def test_a_reset_waits_for_what_the_guard_says_first(tmp_path):
    with closing(Bench(tmp_path, answers=False)) as bench:  # it has just been started
        assert "has not answered" in bench.ask(do="status")["stopped"]
        assert "only it can end the stop" in bench.ask(do="reset")["refused"]


def test_readings_come_as_datagrams_and_others_are_told(tmp_path):
    told = {}
    address, stops = str(tmp_path / "sensors.sock"), str(tmp_path / "estop.sock")
    topics = Topics({"scan": LaserScan, "joy": Joy, "estop": Bool}, {"estop": lambda message: message.data})
    sensors = SocketSensors(address, stops, topics, lambda kind, sentence: told.setdefault(kind, sentence))
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as driver:
        for data in (b"joy\0\1\2\3", b"odom\0x", b"", b"\0", b"\xff" * 500, b"estop\0" + encode(Bool(data=True))):
            driver.sendto(data, address)
        driver.sendto(b"scan\0" + encode(SCAN), address)
        driver.sendto(b"scan\0" + encode(SCAN), stops)
        assert list(sensors.stops()) == []
        found = list(sensors.read())
    assert [topic for topic, _ in found] == ["scan"]
    assert found[0][1].ranges.tolist() == SCAN.ranges.tolist()
    assert set(told) == {"sensors:joy:bytes", "sensors:topic", "sensors:estop:socket", "sensors:scan:socket"}
    assert "belongs to sockets.estop" in told["sensors:estop:socket"]
    assert list(sensors.read()) == []
    sensors.close()


def test_a_press_is_not_lost_behind_readings_however_many(tmp_path):
    address, stops = str(tmp_path / "sensors.sock"), str(tmp_path / "estop.sock")
    topics = Topics({"scan": LaserScan, "estop": Bool}, {"estop": lambda message: message.data})
    sensors = SocketSensors(address, stops, topics, lambda *_: None)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as driver:
        driver.setblocking(False)
        with suppress(BlockingIOError):
            while True:
                driver.sendto(b"scan\0" + encode(SCAN), address)
        driver.sendto(b"estop\0" + encode(Bool(data=True)), stops)
        driver.sendto(b"estop\0" + encode(Bool(data=False)), stops)
        assert [message.data for _, message in sensors.stops()] == [True, False]
    sensors.close()


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
    bench.ask(do="stop", reason="ö" * 150)
    bench.link.send(Velocity(0.2, 0.1))
    bench.turn()
    state = bench.link.state()
    assert (state.stopped, state.hand) == ("ö" * 100, "nobody")


def test_a_stranger_cannot_tell_the_agent_its_state(bench):
    bench.link.send(Velocity(0.2, 0.1))
    bench.turn()
    before = bench.link.state()
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as stranger:
        # The kernel lists the names that it gave.
        places = [str(found.laddr) for found in psutil.Process().net_connections("unix")]
        names = [place for place in places if place.startswith("@")]
        assert names
        stranger.bind("")
        lie = pack_state(GateState(99.0, Velocity(0.5, 0.0), 99.0, "", "agent"))
        for name in names:
            assert stranger.sendto(lie, "\0" + name[1:]) == len(lie)
    assert bench.link.state() == before
    assert unpack_state(lie[:-1]) is None


@pytest.mark.slow
def test_a_display_that_hangs_costs_the_loop_nothing_and_is_named(bench, tmp_path):
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as hangs:
        hangs.bind(str(tmp_path / "display.sock"))
        for _ in range(100 * 20):
            bench.link.send(Velocity(0.2, 0.0))
            assert bench.turn() is not None
        assert any("zones are not shown" in sentence for sentence in bench.ask(do="status")["troubles"])
        assert sum("zones are not shown" in note for note in bench.notes) == 1
