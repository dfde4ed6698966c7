"""The folder of a guard: whoever has it, whether it still leads to the guard, and what is left of one that died."""

import errno
import fcntl
import os
import socket
import threading
from unittest.mock import Mock

import pytest

from skytether.guard.claim import LOCK_FILE, Claim, ClaimError, Heir, guarded
from skytether.guard.protocol import STOP_SOCKET


@pytest.fixture
def claim(tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "stop.sock").touch()
    claim = Claim(str(tmp_path / "run"))
    claim.add(str(tmp_path / "run" / "stop.sock"))
    claim.check()
    assert not claim.lost
    return claim


def lock_of(folder):
    """The descriptor that has the folder, which the kernel closes for a guard that dies."""
    lock = str(folder / LOCK_FILE)
    (held,) = (int(n) for n in os.listdir("/proc/self/fd") if os.path.realpath(f"/proc/self/fd/{n}") == lock)
    return held


@pytest.mark.parametrize("name", [LOCK_FILE, "stop.sock"])
@pytest.mark.parametrize("again", [False, True])
def test_a_file_that_is_removed_or_replaced_is_a_folder_that_is_lost(claim, tmp_path, name, again):
    file = tmp_path / "run" / name
    file.rename(tmp_path / "kept")  # so that its inode is not given to the next file
    if again:
        file.touch()
    claim.check()
    assert claim.lost == str(file)


def test_a_folder_that_is_replaced_is_lost(claim, tmp_path):
    (tmp_path / "run").rename(tmp_path / "old")
    claim.check()
    assert claim.lost


def test_a_folder_has_one_guard(claim, tmp_path):
    with pytest.raises(ClaimError, match="another gate runs"):
        Claim(str(tmp_path / "run"), 0.0)
    (tmp_path / "file").touch()
    with pytest.raises(ClaimError, match="cannot use the folder"):
        Claim(str(tmp_path / "file"))


@pytest.mark.parametrize("lockless", [False, True])
def test_a_folder_that_cannot_be_had_leaves_nothing_open(claim, tmp_path, monkeypatch, lockless):
    if lockless:
        monkeypatch.setattr(fcntl, "flock", Mock(side_effect=OSError(errno.ENOLCK, "No locks available")))
    with pytest.raises(ClaimError):
        Claim(str(tmp_path / "run"), 0.0)
    lock, files = str(tmp_path / "run" / LOCK_FILE), os.listdir("/proc/self/fd")
    assert [os.path.realpath(f"/proc/self/fd/{file}") for file in files].count(lock) == 1, "that of who has it"


def test_a_guard_that_listens_is_not_waited_for(claim, tmp_path):
    folder = tmp_path / "run"
    (folder / STOP_SOCKET).unlink()
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listener:
        listener.bind(str(folder / STOP_SOCKET))
        assert not guarded(str(folder))
        listener.listen(0)
        assert guarded(str(folder))
        with pytest.raises(ClaimError, match="another gate runs"):
            Claim(str(folder), 3600.0)
    assert not guarded(str(folder))


def test_one_that_ends_is_waited_for(claim, tmp_path):
    """It has closed its sockets, and waits for its disk."""
    ends = threading.Timer(0.2, os.close, [lock_of(tmp_path / "run")])
    ends.start()
    Claim(str(tmp_path / "run"), 60.0)
    ends.join()


@pytest.fixture
def link():
    """Of a guard, to one that is not its child any more."""
    made, guard = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with made, guard:
        yield made


def test_what_is_left_of_a_guard_has_the_folder_until_it_ends(claim, link, tmp_path):
    folder = str(tmp_path / "run")
    held = lock_of(tmp_path / "run")
    gate, writer = Heir(folder, link), Heir(folder, link)
    assert not gate.may()
    os.close(held)  # it died
    assert gate.may()
    assert writer.may()
    with pytest.raises(ClaimError):
        Claim(folder, 0.0)
    assert gate.may()
    gate.close()
    with pytest.raises(ClaimError):
        Claim(folder, 0.0)
    writer.close()
    late = Heir(folder, link)
    Claim(folder, 0.0)
    assert not late.may()


def test_a_guard_that_ends_in_order_leaves_the_wheels_to_its_writer(claim, link, tmp_path, monkeypatch):
    """It still has the folder, and is still there."""
    writer = Heir(str(tmp_path / "run"), link)
    assert not writer.may()
    monkeypatch.setattr(os, "getppid", os.getpid)
    assert writer.may()


def test_where_nobody_can_have_a_lock_the_wheels_are_told(tmp_path, link):
    assert Heir(str(tmp_path / "none"), link).may()
