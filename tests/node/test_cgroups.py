"""Which containers have processes, by groups as the kernel shows them."""

import errno
import os
import signal
import subprocess

import pytest

from skytether.node import cgroups
from skytether.node.cgroups import Cgroups

ONE, OTHER, POD, OLD = ("1" * 64, "2" * 64, "3" * 64, "4" * 64)


def group(folder, *, lives):
    folder.mkdir(parents=True)
    (folder / "cgroup.procs").write_text("")
    (folder / "tasks").write_text("7\n" if lives else "")


@pytest.fixture
def root(tmp_path):
    for hierarchy in ("memory", "pids"):
        group(tmp_path / hierarchy, lives=True)
    top = tmp_path / "pids"
    group(top / "docker" / ONE, lives=True)
    group(top / OTHER, lives=False)
    group(top / "system.slice" / f"docker-{OLD}.scope", lives=True)
    group(top / "kubepods" / "burstable" / POD, lives=True)
    return tmp_path


def test_who_has_processes_goes_on(root):
    found = Cgroups(root)
    assert [one for one in (ONE, OTHER, POD, OLD, "5" * 64) if found.go_on(one)] == [ONE, POD, OLD]
    assert found.of_docker() == {ONE, OTHER, OLD}
    (root / "pids" / "docker" / ONE / "tasks").write_text("")
    assert not found.go_on(ONE), "it is looked at anew"


def test_of_the_second_version_each_group_says_it_with_those_below(tmp_path):
    scope = tmp_path / "system.slice" / f"docker-{ONE}.scope"
    for folder in (tmp_path, scope, tmp_path / "docker" / OTHER):
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "cgroup.procs").write_text("")
        (folder / "cgroup.events").write_text(f"populated {int(folder == scope)}\nfrozen 0\n")
    found = Cgroups(tmp_path)
    assert (found.go_on(ONE), found.go_on(OTHER)) == (True, False)
    assert found.of_docker() == {ONE, OTHER}


def test_an_engine_that_is_in_a_container_itself_has_its_own_below_it(root):
    inner = "6" * 64
    group(root / "pids" / "docker" / ONE / "docker" / inner, lives=True)
    assert Cgroups(root).of_docker() == {ONE, OTHER, OLD, inner}
    assert Cgroups(root).go_on(inner)


def test_where_there_are_no_groups_nobody_is_known_to_go_on(tmp_path):
    assert not Cgroups(tmp_path).go_on(ONE)
    assert Cgroups(tmp_path).of_docker() == set()


def test_what_cannot_be_listed_is_not_taken_for_ended(root, monkeypatch):
    def fail(folder):
        raise OSError(errno.EMFILE if "docker" in str(folder) else errno.ENOENT, "cannot be listed", str(folder))

    monkeypatch.setattr(os, "scandir", fail)
    assert not Cgroups(root).of_docker(), "what is gone has ended"
    monkeypatch.undo()
    scandir = os.scandir
    monkeypatch.setattr(os, "scandir", lambda folder: fail(folder) if "docker" in str(folder) else scandir(folder))
    with pytest.raises(OSError, match="cannot be listed"):
        Cgroups(root)


def test_it_says_what_ends_them(root):
    assert Cgroups(root).kill(ONE) == f"kill -9 $(cat {root}/pids/docker/{ONE}/cgroup.procs)"


def test_processes_of_one_are_ended(root, tmp_path, monkeypatch):
    monkeypatch.setattr(cgroups, "PROC", tmp_path)
    with subprocess.Popen(["sleep", "60"]) as one, subprocess.Popen(["sleep", "60"]) as other:
        for process, container in ((one, ONE), (other, OTHER)):  # the other one's number was another's
            (tmp_path / str(process.pid)).mkdir()
            (tmp_path / str(process.pid) / "cgroup").write_text(f"4:pids:/docker/{container}\n")
        # 0: it is of a computer that this one is within, and would be this program's own group
        (root / "pids" / "docker" / ONE / "cgroup.procs").write_text(f"0\n{one.pid}\n{other.pid}\n1{one.pid}\n")
        Cgroups(root).end(ONE)
        Cgroups(root).end("5" * 64)
        assert one.wait(10) == -signal.SIGKILL
        assert other.poll() is None
        other.kill()
