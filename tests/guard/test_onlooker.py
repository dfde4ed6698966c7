"""A process that only shows: started, started anew, and never waited for."""

import errno
import os
import select
import socket
import sys
import time

import psutil
import pytest

from skytether.guard import onlooker as module
from skytether.guard.child import Child
from skytether.guard.log import Log
from skytether.guard.onlooker import Onlooker

LIVES = "import socket, sys; s = socket.socket(fileno=int(sys.argv[1])); s.send(b'.'); s.recv(1)"
ENDS = "raise SystemExit(3)"
HANGS = "import time; time.sleep(60)"


@pytest.fixture
def started(monkeypatch):
    """The processes that were started, oldest first."""
    started = []

    class Seen(Child):
        def __init__(self, *arguments):
            super().__init__(*arguments)
            started.append(self)

    monkeypatch.setattr(module, "Child", Seen)
    return started


@pytest.fixture
def look(tmp_path, started):
    """Looks after one, at made-up times."""
    made = []
    config = os.open(os.devnull, os.O_RDONLY)
    log = os.open(tmp_path / "log", os.O_WRONLY | os.O_CREAT | os.O_APPEND)

    def look(*command):
        made.append(Onlooker("display", command, config, Log("guard", log)))
        return made[-1]

    yield look
    for onlooker in made:
        onlooker.leave()
        onlooker.end()
    until(lambda: all(child.reaped() for child in started))
    os.close(config)


def until(condition):
    end = time.monotonic() + 30
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


def until_heard(child):
    assert select.select([child.socket], [], [], 30)[0]


def test_one_that_ends_is_named_and_started_anew_after_a_while(look, started):
    onlooker = look(sys.executable, "-c", ENDS)
    onlooker.turn(100.0)
    until(started[0].reaped)
    onlooker.turn(100.5)
    assert "the display ended with status 3" in onlooker.trouble
    for now in (101.0, 109.9):
        onlooker.turn(now)
        assert len(started) == 1
    onlooker.turn(110.5)
    assert len(started) == 2


def test_one_that_lives_is_left_alone_and_its_trouble_is_over(look, started):
    onlooker = look(sys.executable, "-c", LIVES)
    onlooker.trouble = "as before"
    onlooker.turn(100.0)
    until_heard(started[0])
    assert onlooker.trouble == "as before"
    for now in (100.5, 101.0, 103.0):
        onlooker.turn(now)
        assert onlooker.trouble == ""
    assert len(started) == 1
    assert not started[0].reaped()


def test_one_that_hangs_is_ended(look, started):
    onlooker = look(sys.executable, "-c", HANGS)
    onlooker.turn(100.0)
    until(lambda: started[0].pid)
    onlooker.turn(114.0)
    assert onlooker.trouble == ""
    onlooker.turn(116.0)
    assert "did not start within" in onlooker.trouble
    process = psutil.Process(started[0].pid)
    until(lambda: process.status() == psutil.STATUS_ZOMBIE)
    onlooker.turn(117.0)
    assert not psutil.pid_exists(process.pid), "nothing is left of it"


def test_without_a_descriptor_left_it_is_tried_again_later(look, started, monkeypatch):
    def none_left(*_):
        raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))

    onlooker = look(sys.executable, "-c", LIVES)
    with monkeypatch.context() as patch:
        patch.setattr(socket, "socketpair", none_left)
        onlooker.turn(100.0)
    assert onlooker.trouble == "the display cannot be started: Too many open files"
    onlooker.turn(109.0)
    assert started == []
    onlooker.turn(110.5)
    until_heard(started[0])
    onlooker.turn(111.0)
    assert onlooker.trouble == ""


def test_without_a_command_there_is_none(look, started):
    onlooker = look()
    onlooker.turn(100.0)
    assert started == []
    assert onlooker.trouble == ""
