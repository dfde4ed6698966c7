"""The guard's loop and its children: what one that ends said last."""

import json
import os
import socket
import time
from contextlib import suppress

import pytest

from skytether.guard import loop
from skytether.guard.kinematics import Bounds
from skytether.guard.log import Log
from skytether.guard.loop import Guard
from skytether.guard.protocol import LARGEST, STOP_SOCKET, Answer, Beat, pack_answer, pack_beat, unpack_answer
from skytether.guard.record import decode
from skytether.guard.settings import Settings
from skytether.guard.velocity import STANDSTILL

LARGEST_ANSWER = 65_536
NOW = 100.0
"""Time stands still: a reset that waited for too long would not count."""


class Played:
    """A child of the guard whose end of the socket is here."""

    made: "list[Played]" = []

    def __init__(self, name, *_):
        self.name, self.heard_at, self.gone, self.pid = name, None, False, 1
        self.socket, self.theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.socket.setblocking(False)
        self.theirs.setblocking(False)
        self.newest = None
        self.dies = None
        """What it does last, between two looks of the guard."""
        Played.made.append(self)

    def send(self, **beat):
        self.theirs.send(pack_beat(Beat(NOW, STANDSTILL, **beat)))

    def heard(self):
        """What the guard answered last."""
        while True:
            try:
                self.newest = unpack_answer(self.theirs.recv(LARGEST))
            except BlockingIOError:
                return self.newest

    def ended(self, now):
        if self.dies:
            self.dies()
            return "ended with status -9"
        return "ended" if self.gone else ""

    def leave(self):
        pass

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
    made = Guard(settings, Log("guard", os.open(os.devnull, os.O_WRONLY)), [], lambda: NOW)
    made.turn()  # starts the gate
    (gate,) = Played.made
    gate.send()
    made.turn()
    gate.send(seen=gate.heard().generation, reset=True)
    made.turn()
    assert gate.heard().stopped == ""
    yield made
    made.run(lambda: True)
    os.close(config)


def ask(guard, folder, **request):
    """As a person does, on the guard's socket; its answer."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as person:
        person.connect(str(folder / "run" / STOP_SOCKET))
        person.send(json.dumps(request).encode())
        person.setblocking(False)
        end = time.monotonic() + 30
        while time.monotonic() < end:
            guard.turn()
            with suppress(BlockingIOError):
                return json.loads(person.recv(LARGEST_ANSWER))
    pytest.fail("no answer")


@pytest.mark.parametrize("unread", [False, True])
@pytest.mark.parametrize("before", [0, 100])
@pytest.mark.parametrize("reaped", [False, True])
def test_a_stop_that_was_the_last_word_of_a_gate_is_heard(guard, tmp_path, unread, before, reaped):
    """Also when it dies with answers unread, or between two looks of the guard."""
    (gate,) = Played.made
    generation = gate.heard().generation
    if unread:
        gate.socket.send(pack_answer(Answer(0.0)))

    def send_last():
        for _ in range(before):
            gate.send(seen=generation)
        gate.send(seen=generation, stopped="somebody fell")
        gate.theirs.close()
        gate.dies = None

    if reaped:
        gate.dies = send_last
    else:
        send_last()
        guard.turn()
    guard.turn()
    assert ask(guard, tmp_path, do="status")["stopped"] == "somebody fell"


def test_each_stop_reset_and_death_is_in_the_event_record(guard, tmp_path):
    (gate,) = Played.made
    generation = gate.heard().generation
    gate.send(seen=generation, stopped="somebody fell")
    guard.turn()
    gate.send(seen=gate.heard().generation, reset=True)
    guard.turn()
    ask(guard, tmp_path, do="stop", reason="a fire")
    gate.dies = gate.theirs.close
    guard.turn()
    guard.run(lambda: True)  # until all is on disk
    found = [(e["who"], e["what"], e["detail"]) for e in decode((tmp_path / "record").read_bytes())]
    events = [event for event in found if event[1] in ("stop", "reset", "death")]
    assert events[1:] == [  # after the reset of the start
        ("gate", "stop", "somebody fell"),
        ("person", "reset", "the emergency stop was reset"),
        ("person", "stop", "a fire"),
        ("gate", "death", "ended with status -9"),
    ]
