"""The process beside a container is stopped, and goes on; nobody else's is."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from skytether.node import shims

ONE, OTHER = "1" * 64, "2" * 64
FIRST = 4


@pytest.fixture
def beside(request):
    """One that is called as containerd's is, or as told."""
    name = getattr(request, "param", "containerd-shim-runc-v2")
    words = [name, "-c", "import time; time.sleep(60)", "-namespace", "moby", "-id", ONE]
    process = subprocess.Popen(words, executable=sys.executable)
    while name not in Path(f"/proc/{process.pid}/cmdline").read_text():
        time.sleep(0.001)
    yield process
    process.kill()
    process.wait()


@pytest.fixture
def proc(tmp_path, beside):
    """What the kernel shows of it, and of a container's first process."""
    (tmp_path / str(beside.pid)).symlink_to(f"/proc/{beside.pid}")
    (tmp_path / str(FIRST)).mkdir()
    (tmp_path / "self").mkdir()
    (tmp_path / "1").symlink_to("/proc/1")
    first(tmp_path, beside.pid)
    return tmp_path


def first(proc, parent, *, state="S", container=ONE):
    (proc / str(FIRST) / "stat").write_text(f"{FIRST} (a (odd) Z 1) {state} {parent} 4 4 0\n")
    (proc / str(FIRST) / "cgroup").write_text(f"0::/docker/{container}\n")


def state_of(process):
    return Path(f"/proc/{process.pid}/stat").read_text().split(")")[1].split()[0]


def test_it_stops_and_goes_on(proc, beside):
    assert shims.stop(ONE, FIRST, proc)
    assert state_of(beside) == "T"
    assert not shims.resume(OTHER, proc)
    assert state_of(beside) == "T"
    assert shims.resume(ONE, proc)
    assert state_of(beside) != "T"
    assert not shims.resume(ONE, proc)


@pytest.mark.parametrize("beside", ["conmon", "python3"], indirect=True)
def test_nothing_else_is_stopped(proc, beside):
    assert shims.stop(ONE, FIRST, proc) is None
    assert state_of(beside) != "T"


def test_nobody_knows_of_what_is_hidden(proc, beside):
    (proc / "1").unlink()
    assert shims.stop(ONE, FIRST, proc) is None
    assert state_of(beside) != "T"


def test_one_of_another_user_cannot_be_stopped(proc, monkeypatch):
    def refuse(*_):
        raise PermissionError

    monkeypatch.setattr(os, "kill", refuse)
    assert shims.stop(ONE, FIRST, proc) is None


def test_that_of_another_container_is_not_stopped(proc, beside):
    assert shims.stop(OTHER, FIRST, proc) is False
    assert state_of(beside) != "T"


@pytest.mark.parametrize("how", [{"state": "Z"}, {"state": "X"}, {"container": OTHER}])
def test_the_number_of_one_that_ended_is_not_its_own(proc, beside, how):
    first(proc, beside.pid, **how)
    assert shims.stop(ONE, FIRST, proc) is False
    shims.resume(ONE, proc)
    assert state_of(beside) != "T"


def test_one_whose_parent_is_another_one_by_now_has_ended(proc, monkeypatch):
    kill = os.kill
    monkeypatch.setattr(os, "kill", lambda *words: (kill(*words), first(proc, 1)))
    assert shims.stop(ONE, FIRST, proc) is False


@pytest.mark.parametrize("number", [None, 0, FIRST + 1, "4/../.."])
def test_a_number_that_is_nobodys_is_not_its_own(proc, number):
    assert shims.stop(ONE, number, proc) is False


def test_what_does_not_stop_holds_nothing(proc, monkeypatch):
    monkeypatch.setattr(shims, "_STOPS_S", 0.0)
    monkeypatch.setattr(os, "kill", lambda *_: None)
    assert shims.stop(ONE, FIRST, proc) is False


def test_whether_one_of_several_has_one(proc, beside):
    assert shims.is_any((OTHER, ONE), proc)
    assert not shims.is_any((OTHER,), proc)
    assert not shims.is_any((), proc)


def test_what_is_in_a_container_and_called_so_is_none(proc):
    """It kept whoever asked for the end of another one waiting for good."""
    (proc / "7").mkdir()
    (proc / "7" / "cmdline").write_text(f"containerd-shim\0-id\0{OTHER}\0")
    for numbers, is_one in (("7", True), ("7\t2", False)):
        (proc / "7" / "status").write_text(f"Name:\tNSpid: 7\nNSpid:\t{numbers}\n")
        (proc / "7" / "stat").write_text("7 (shim) S 1 4 4 0\n")
        assert shims.is_any((OTHER,), proc) is is_one


def test_one_beside_real_processes_is_found(proc, beside):
    assert shims.is_any((ONE,), Path("/proc"))
