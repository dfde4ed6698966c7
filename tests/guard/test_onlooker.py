"""A process that only shows: started, started anew, and never waited for."""

import errno
import os
import socket
import sys
import time

import pytest

from skytether.guard.log import Log
from skytether.guard.onlooker import Onlooker

LIVES = "import socket, sys; s = socket.socket(fileno=int(sys.argv[1])); s.send(b'.'); s.recv(1)"
ENDS = "raise SystemExit(3)"


@pytest.fixture
def look(tmp_path):
    """Looks after one, at made-up times."""
    made = []
    config = os.open(os.devnull, os.O_RDONLY)
    log = os.open(tmp_path / "log", os.O_WRONLY | os.O_CREAT | os.O_APPEND)

    def look(program):
        made.append(Onlooker("display", (sys.executable, "-c", program), config, Log("guard", log)))
        return made[-1]

    yield look
    for onlooker in made:
        left = [*onlooker._dead, *([onlooker._child] if onlooker._child else [])]
        onlooker.leave()
        onlooker.end()
        while not all(child.reaped() for child in left):
            time.sleep(0.01)
    os.close(config)


def until(onlooker, condition, start, step=0.0):
    """Look after it at one time, or at times that pass, until the condition holds; the time then."""
    end = time.monotonic() + 30
    now = start
    while not condition():
        assert time.monotonic() < end
        now += step
        onlooker._look_at = 0.0
        onlooker.turn(now)
        time.sleep(0.01)
    return now


def test_one_that_ends_is_named_and_started_anew_after_a_while(look, tmp_path):
    onlooker = look(ENDS)
    until(onlooker, lambda: onlooker.trouble, 100.0)
    assert "the display ended" in onlooker.trouble
    for now in (101.0, 109.9):
        onlooker.turn(now)
        assert onlooker._child is None
    onlooker.turn(110.5)
    assert onlooker._child is not None


def test_one_that_lives_is_left_alone_and_its_trouble_is_over(look):
    onlooker = look(LIVES)
    onlooker.trouble = "as before"
    until(onlooker, lambda: not onlooker.trouble, 100.0)
    assert onlooker._child is not None
    assert onlooker._child.pid


def test_one_that_hangs_is_ended(look):
    onlooker = look("import time; time.sleep(60)")
    until(onlooker, lambda: onlooker.trouble, 100.0, step=1.0)
    assert "did not start within" in onlooker.trouble
    until(onlooker, lambda: not onlooker._dead, 120.0)


def test_without_a_descriptor_left_it_is_tried_again_later(look, monkeypatch):
    def none_left(*_):
        raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))

    onlooker = look(LIVES)
    with monkeypatch.context() as patch:
        patch.setattr(socket, "socketpair", none_left)
        onlooker.turn(100.0)
    assert onlooker.trouble == "the display cannot be started: Too many open files"
    onlooker.turn(109.0)
    assert onlooker._child is None
    until(onlooker, lambda: not onlooker.trouble, 110.5)
    assert onlooker._child is not None


def test_without_a_command_there_is_none(tmp_path):
    onlooker = Onlooker("display", (), 0, Log("guard"))
    onlooker.turn(100.0)
    assert onlooker._child is None
