"""The guard's loop and its children: what one that ends said last."""

import os
import socket
import time
from pathlib import Path

import pytest

from skytether.guard import loop
from skytether.guard.kinematics import Bounds
from skytether.guard.log import Log
from skytether.guard.loop import Guard
from skytether.guard.protocol import Answer, Beat, pack_answer, pack_beat
from skytether.guard.record import decode
from skytether.guard.settings import Settings
from skytether.guard.velocity import STANDSTILL


class Played:
    """A child of the guard whose end of the socket is here."""

    made: "list[Played]" = []

    def __init__(self, name, *_):
        self.name, self.heard_at, self.gone, self.pid = name, None, False, 1
        self.socket, self.theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.socket.setblocking(False)
        self.why = ""
        Played.made.append(self)

    def ended(self, now):
        return self.why or ("ended" if self.gone else "")

    def end(self):
        self.socket.close()

    def reaped(self):
        return True


@pytest.fixture
def guard(tmp_path, monkeypatch):
    monkeypatch.setattr(loop, "Child", Played)
    monkeypatch.setattr(Played, "made", [])
    bounds = Bounds(0.5, -0.1, 0.8, 1.0, 1.0, 2.0, 2.0)
    config = os.memfd_create("config")
    run = tmp_path / "run"
    settings = Settings(
        str(run), str(tmp_path / "record"), 0.02, 0.1, bounds, str(run / "wheels.sock"), None, ("gate",), (), config
    )
    made = Guard(settings, Log("guard", os.open(os.devnull, os.O_WRONLY)), [])
    made.turn()  # starts the gate
    made._latch.reset(made._latch.generation)
    made.turn()
    yield made
    made._requests.close()
    os.close(config)


@pytest.mark.parametrize("unread", [False, True])
@pytest.mark.parametrize("before", [0, 100])
@pytest.mark.parametrize("reaped", [False, True])
def test_a_stop_that_was_the_last_word_of_a_gate_is_heard(guard, unread, before, reaped):
    """Also when it dies with answers unread, or between two looks of the guard."""
    (gate,) = Played.made
    if unread:
        gate.socket.send(pack_answer(Answer(0.0)))
    generation = guard._latch.generation
    for _ in range(before):
        gate.theirs.send(pack_beat(Beat(guard._clock(), STANDSTILL, generation)))
    gate.theirs.send(pack_beat(Beat(guard._clock(), STANDSTILL, generation, stopped="somebody fell")))
    gate.theirs.close()
    if reaped:
        gate.why = "ended with status -9"
        guard._look_after(guard._clock())
    else:
        guard.turn()
        guard.turn()
    assert guard._latch.reason == "somebody fell"


def test_each_stop_reset_and_death_is_in_the_event_record(guard):
    (gate,) = Played.made
    now = guard._clock()
    guard._clock = lambda: now  # a reset that waited for too long would not count
    gate.theirs.send(pack_beat(Beat(now, STANDSTILL, guard._latch.generation, stopped="somebody fell")))
    guard.turn()
    gate.theirs.send(pack_beat(Beat(now, STANDSTILL, guard._latch.generation, reset=True)))
    guard.turn()
    guard._answer({"do": "stop", "reason": "a fire"})
    gate.why = "ended with status -9"
    guard._look_after(now)
    end = time.monotonic() + 30
    while not guard._record.written:
        assert time.monotonic() < end
        time.sleep(0.001)
    found = [(e["who"], e["what"], e["detail"]) for e in decode(Path(guard._settings.record).read_bytes())]
    assert [event for event in found if event[1] in ("stop", "reset", "death")] == [
        ("gate", "stop", "somebody fell"),
        ("person", "reset", "the emergency stop was reset"),
        ("person", "stop", "a fire"),
        ("gate", "death", "ended with status -9"),
    ]
