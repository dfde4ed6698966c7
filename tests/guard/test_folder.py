"""A local user who wants to take the emergency stop, or the agent's commands, in the gate's stead."""

import os
import socket
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from skytether.guard.folder import objection
from skytether.guard.protocol import STOP_SOCKET
from skytether.guard.requests import Requests
from skytether.guard.velocity import Velocity
from skytether.robot.safety.client import GateError, GateLink, ask, listens, stop
from skytether.robot.safety.protocol import COMMAND_SOCKET, CONTROL_SOCKET, GateState, default_folder, pack_state

root = pytest.mark.skipif(os.geteuid() != 0, reason="needs root, to be another user too")
ANOTHER = 54_321
LISTENS = """
import os, socket, sys
os.setgid({user}); os.setuid({user})
listens = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
listens.bind({path!r}); os.chmod({path!r}, 0o777); listens.listen(8)
print("ready", flush=True)
while True:
    link, _ = listens.accept()
    try:
        asked = link.recv(4096)
        if asked:
            print("took", flush=True)
        link.send(b'{{"stopped": "of course", "wheels": "yours"}}')
    except OSError:
        pass
"""


@pytest.fixture
def folder(tmp_path):
    made = tmp_path / "gate"
    made.mkdir(mode=0o755)
    return made


@pytest.mark.parametrize("mode", [0o755, 0o750, 0o700, 0o1775])
def test_a_folder_of_ones_own_is_good(folder, mode):
    folder.chmod(mode)
    assert objection(str(folder)) == ""


@pytest.mark.parametrize("mode", [0o777, 0o1777, 0o775, 0o757])
def test_a_folder_to_which_others_write_is_not(folder, mode):
    folder.chmod(mode)
    assert "others may write" in objection(str(folder))
    link = GateLink(folder)
    with pytest.raises(PermissionError, match="others may write"):
        link.send(Velocity(0, 0))
    link.close()


def test_a_folder_that_others_can_replace_is_not(folder):
    folder.parent.chmod(0o777)
    try:
        assert "others may replace" in objection(str(folder))
    finally:
        folder.parent.chmod(0o700)


def test_what_is_no_folder(tmp_path):
    (tmp_path / "file").touch()
    assert "no folder" in objection(str(tmp_path / "file"))
    assert "No such file" in objection(str(tmp_path / "none"))


def test_without_a_runtime_folder_the_shared_temporary_one_is_not_taken(monkeypatch):
    monkeypatch.delenv("XDG_RUNTIME_DIR", raising=False)
    monkeypatch.delenv("SKYTETHER_GATE_FOLDER", raising=False)
    monkeypatch.setenv("XDG_STATE_HOME", "/home/walker/.local/state")
    monkeypatch.setattr("os.geteuid", lambda: 54_321)
    assert default_folder() == Path("/home/walker/.local/state/skytether/gate")


@root
def test_a_folder_that_another_user_made_where_all_may_is_not_taken(tmp_path):
    shared = tmp_path / "shared"
    shared.mkdir()
    shared.chmod(0o1777)
    theirs = shared / "skytether"
    theirs.mkdir(mode=0o755)
    os.chown(theirs, ANOTHER, ANOTHER)
    assert "belongs to the user" in objection(str(theirs))
    shared.chmod(0o755)  # as /run: who may make folders there is root
    assert objection(str(theirs)) == ""


@pytest.fixture
def thief(folder):
    """Another user who listens where the guard should, in a folder that was open when they came."""
    running = []

    def listen(name):
        folder.chmod(0o777)
        for above in folder.parents:
            if above.stat().st_uid == os.geteuid() and above != Path("/") and not above.stat().st_mode & 0o001:
                above.chmod(0o711)
        code = LISTENS.format(user=ANOTHER, path=str(folder / name))
        running.append(subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True))
        assert running[-1].stdout.readline() == "ready\n"
        folder.chmod(0o755)
        return running[-1]

    yield listen
    for one in running:
        one.kill()
        one.wait()
        one.stdout.close()


@root
def test_a_stop_that_another_user_took_is_no_stop(folder, thief):
    took = thief(STOP_SOCKET)
    with pytest.raises(GateError, match="may not be the gate: it is the user 54321"):
        stop(folder, "somebody fell", timeout=2)
    assert took.stdout.readline() == "took\n"  # it was asked all the same


@root
def test_the_guards_word_counts_though_another_user_has_the_gates_socket(folder, thief):
    thief(CONTROL_SOCKET)
    guard = Requests(str(folder / STOP_SOCKET), lambda asked: {"stopped": asked["reason"]})
    ended = threading.Event()

    def turn():
        while not ended.wait(0.005):
            guard.turn()

    turning = threading.Thread(target=turn)
    turning.start()
    try:
        assert stop(folder, "somebody fell", timeout=20)["stopped"] == "somebody fell"
        assert not listens(folder)
        with pytest.raises(GateError, match="may not be the gate"):
            ask(folder, {"do": "status"})
    finally:
        ended.set()
        turning.join()
        guard.close()


@root
def test_a_guard_answers_no_other_user(folder):
    handled = []
    guard = Requests(str(folder / STOP_SOCKET), lambda asked: handled.append(asked) or {"stopped": "x"})
    (folder / STOP_SOCKET).chmod(0o777)  # a mistake, or a file system without modes
    for above in (folder.parent, folder.parent.parent):
        above.chmod(0o711)
    code = (
        f"import os, socket; os.setgid({ANOTHER}); os.setuid({ANOTHER})\n"
        "link = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET); link.settimeout(20)\n"
        f"link.connect({str(folder / STOP_SOCKET)!r})\n"
        'try: link.send(b\'{"do": "status"}\'); print(link.recv(100))\n'
        "except OSError as error: print(b'')\n"
    )
    asks = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    while asks.poll() is None:
        guard.turn()
    assert asks.stdout.read() == "b''\n"
    assert handled == []
    asks.stdout.close()
    guard.close()


@root
def test_what_another_user_tells_the_agent_is_not_the_gates_word(folder):
    link = GateLink(folder)
    with pytest.raises(OSError, match="No such file"):
        link.send(Velocity(0.1, 0))
    gate = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    gate.bind(str(folder / COMMAND_SOCKET))
    link.send(Velocity(0.1, 0))
    _, agent = gate.recvfrom(256)
    state = pack_state(GateState(1.0, Velocity(5.0, 0), 1.0, "", "agent"))
    pid = os.fork()
    if pid == 0:
        os.setgid(ANOTHER)
        os.setuid(ANOTHER)
        gate.sendto(state, agent)
        os._exit(0)
    os.waitpid(pid, 0)
    assert link.state() is None
    gate.sendto(state, agent)
    assert link.state() is not None
    gate.close()
    link.close()
