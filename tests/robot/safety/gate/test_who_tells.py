"""Gate, guard and writer with made-up time: any of them dies or freezes, and exactly one tells the wheels.

The real gate's heartbeat, the real writer, and a guard as it says things to a writer; real sockets between them, and
the judge of the attacks on real processes, with no tolerance for time: here it is exact.
"""

import itertools
import os
import socket
from contextlib import suppress
from pathlib import Path

import pytest

from skytether.guard import board
from skytether.guard.board import Board
from skytether.guard.claim import LOCK_FILE, Claim
from skytether.guard.protocol import LARGEST, Answer, pack_answer, unpack_beat
from skytether.guard.velocity import STANDSTILL, Velocity
from skytether.guard.watch import Watch
from skytether.guard.wheels import WriterWheels
from skytether.lab.safety.checker import Demand, SentVelocity, Wheels, check
from skytether.robot.safety.config.safety_config import SafetyConfig
from skytether.robot.safety.gate.heartbeat import Heartbeat
from skytether.robot.safety.gate.writer import Writer

WANTED = Velocity(0.4, 0.0)
PERIOD, PATIENCE = 0.02, 0.1
_GRAIN = 0.001


class Way:
    """A way to the wheels."""

    def __init__(self, stage, who):
        self.stage, self.who = stage, who

    def write(self, velocity, until):
        self.stage.told.append((self.stage.now, self.who, velocity))

    def sent(self):
        return None

    def unread(self):
        return ""

    def listeners(self):
        return frozenset({"/base"})

    hearers = listeners

    def enable(self, level):
        """There is no enable signal."""

    def close(self):
        """Nothing is open."""


class Stage:
    """All three, each in its own turns; who is not in `runs` is frozen or dead."""

    def __init__(self, folder: Path, offsets=(0.0, 0.0002, 0.0004)):
        self.now, self.told = 50.0, []
        self.runs = {"gate", "guard", "writer"}
        config = SafetyConfig.model_validate(
            {
                "footprint": {"radius": 0.3},
                "limits": {"linear_max": 0.5},
                "sensors": {},
                "unseen": {"action": "free"},
                "folder": str(folder),
            }
        )
        self.bounds, self.limits = config.bounds(), config.rules().limits
        self.file = board.make()
        self.boards = [Board(self.file) for _ in range(3)]
        self.sockets = [end for pair in range(2) for end in socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)]
        for end in self.sockets:
            end.setblocking(False)
        to_guard, self.from_gate, to_writer, from_guard = self.sockets
        clock = lambda: self.now  # noqa: E731
        self.heartbeat = Heartbeat(
            to_guard, Way(self, "gate"), self.bounds, PERIOD, PATIENCE, self.boards[0], lambda *_: None, clock
        )
        self.writer = Writer(config, from_guard, Way(self, "writer"), self.boards[1], clock)
        self.board = self.boards[2]
        self.guard = WriterWheels(to_writer)
        self.guard_watch = Watch(self.bounds, PERIOD, PATIENCE)
        self.said = STANDSTILL
        self.due = {role: self.now + offset for role, offset in zip(("gate", "guard", "writer"), offsets, strict=True)}
        self.begins = self.now

    def run(self, seconds):
        end = self.now + seconds
        while self.now < end:
            self.now = round(self.now + _GRAIN, 6)
            for role in ("gate", "guard", "writer"):
                if role in self.runs:
                    getattr(self, f"_{role}")()

    def wait(self, seconds):
        """Nobody runs meanwhile; what they did before does not count."""
        self.now += seconds
        self.due = {role: due + seconds for role, due in self.due.items()}
        self.begins, self.told = self.now, []

    def _gate(self):
        if self.now < self.due["gate"]:
            return
        self.due["gate"] = max(self.due["gate"] + PERIOD, self.now)
        self.heartbeat.receive()
        if (differs := self.heartbeat.differs(self.said, self.now)) is not None:
            self.said = differs.velocity
        faster = min(self.said.linear + 1.0 * PERIOD, WANTED.linear)
        self.said = self.heartbeat.send(Velocity(faster, 0.0), "", False, self.now)

    def _guard(self):
        heard = None
        with suppress(BlockingIOError):
            while True:
                heard = unpack_beat(self.from_gate.recv(LARGEST)) or heard
        if heard is None and self.now < self.due["guard"]:
            return
        if heard is not None:
            self.guard_watch.on_beat(heard)
            with suppress(BlockingIOError):
                self.from_gate.send(pack_answer(Answer(self.now)))
        self.guard.receive()
        self.guard_watch.learn(self.board.newest().told)
        with suppress(OSError):
            self.guard.write(*self.guard_watch.asks(self.now))
        self.due["guard"] = self.guard_watch.due(self.now, 2 * PERIOD)

    def _writer(self):
        self.writer.turn()

    def finding(self, *demands):
        record = [SentVelocity(at, velocity) for at, _, velocity in self.told]
        return check(record, demands, Wheels(self.limits, PATIENCE, jitter_s=1e-6))

    def spoke(self, since):
        """Who told the wheels something, each time that it changed."""
        return [who for who, _ in itertools.groupby(who for at, who, _ in self.told if at > since)]

    def close(self):
        for end in self.sockets:
            end.close()
        for page in self.boards:
            page.close()
        os.close(self.file)


@pytest.fixture(params=[(0.0, 0.01, 0.005), (0.015, 0.0, 0.018)])
def stage(tmp_path, request):
    stage = Stage(tmp_path, request.param)
    stage.run(0.05)
    stage.wait(8.0)  # who has listened for so long listens to both
    stage.run(0.6)
    assert stage.told[-1][2] == WANTED
    assert stage.finding().violations == ()
    assert stage.spoke(stage.begins + 0.2) == ["writer"]
    yield stage
    stage.close()


BRAKES_S = 0.4 / 2.0
FEW = [{"gate"}, {"guard"}, {"writer"}, {"gate", "guard"}, {"guard", "writer"}]


@pytest.mark.parametrize("gone", FEW, ids=lambda gone: "-".join(sorted(gone)))
@pytest.mark.parametrize("phase", [0.0, 0.013])
def test_whoever_is_gone_one_other_brakes_at_the_configured_rate(stage, gone, phase):
    stage.run(phase)
    since = stage.now
    stage.runs -= gone
    stage.run(0.5)
    finding = stage.finding(Demand(since, PATIENCE + 2 * PERIOD + BRAKES_S, stage.now, "gone"))
    assert finding.violations == ()
    assert stage.spoke(since + 0.002) in (["gate"] if "writer" in gone else ["writer"], ["writer", "gate"])
    braking = [(at, velocity.linear) for at, _, velocity in stage.told if at > since and 0 < velocity.linear < 0.399]
    (first, fast), (last, slow) = braking[0], braking[-1]
    assert (fast - slow) / (last - first) == pytest.approx(2.0, rel=0.03)
    assert stage.told[-1][2] == STANDSTILL


@pytest.mark.parametrize("gone", FEW, ids=lambda gone: "-".join(sorted(gone)))
@pytest.mark.parametrize("seconds", [0.03, 0.05, 0.07, 0.11, 0.2])
def test_whoever_goes_on_after_a_while_goes_on_from_what_was_told(stage, gone, seconds):
    stage.run(0.004)
    since = stage.now
    stage.runs -= gone
    stage.run(seconds)
    back = stage.now
    stage.runs |= gone
    stage.run(0.8)
    assert stage.finding().violations == ()
    assert stage.told[-1][2] == WANTED
    assert stage.spoke(back + 3 * PERIOD) == ["writer"]
    assert stage.spoke(since) in (["writer"], ["gate", "writer"], ["writer", "gate", "writer"])


def test_whose_writer_is_gone_stands_at_once_where_who_turns_the_wheels_came_just_now(tmp_path):
    stage = Stage(tmp_path)
    stage.run(1.0)
    since = stage.now
    stage.runs -= {"writer"}
    stage.run(0.5)
    assert {velocity for at, who, velocity in stage.told if who == "gate" and at > since} == {STANDSTILL}
    stage.close()


def test_a_writer_that_goes_on_beside_another_guard_tells_the_wheels_nothing(tmp_path):
    (tmp_path / LOCK_FILE).touch()
    stage = Stage(tmp_path)
    another = Claim(str(tmp_path))
    for end in stage.sockets[:3]:
        end.close()
    stage.writer.run()
    assert not stage.told
    assert not another.lost
    stage.close()
