"""A local user who wants to take the emergency stop, or the agent's commands, in the gate's stead."""

import os
import socket
import subprocess
import sys
import threading
from operator import attrgetter
from pathlib import Path

import pytest

from skytether.guard.enable import open_line
from skytether.guard.folder import objection
from skytether.guard.mailbox import bind
from skytether.guard.protocol import STOP_SOCKET
from skytether.guard.requests import Requests
from skytether.guard.velocity import Velocity
from skytether.guard.wheels import SocketWheels
from skytether.messages import Bool, encode
from skytether.robot.graphs.inbox import Topics
from skytether.robot.safety.client import GateError, GateLink, ask, listens, stop
from skytether.robot.safety.io.hardware import SocketSensors
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
        'try: link.send(b\'{"do": "status"}\')\n'
        "except BrokenPipeError: pass\n"
        "print(link.recv(100))\n"
    )
    asks = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    while asks.poll() is None:
        guard.turn()
    assert f"you are the user {ANOTHER}, and only 0 and root may ask" in asks.stdout.read()
    assert handled == []
    asks.stdout.close()
    guard.close()


def send_as(user, group, path, data):
    """A datagram of another user, who by mistake (or on a file system without modes) may write there."""
    for above in path.parent.parents:
        if above.stat().st_uid == os.geteuid() and above != Path("/") and not above.stat().st_mode & 0o001:
            above.chmod(0o711)
    path.chmod(0o777)
    pid = os.fork()
    if pid == 0:
        try:
            os.setgroups([])
            os.setgid(group)
            os.setuid(user)
            socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM).sendto(data, str(path))
        finally:
            os._exit(0)
    assert os.waitpid(pid, 0)[1] == 0


@pytest.fixture
def sensors(folder):
    """Of a gate: its readings and its stops; what it says of those that it does not use."""
    told = []

    def make():
        topics = Topics({"estop": Bool, "lock": Bool}, {"estop": attrgetter("data")})
        paths = str(folder / "sensors.sock"), str(folder / "estop.sock")
        made.append(SocketSensors(paths[0], bind(paths[1]), topics, lambda _, sentence: told.append(sentence)))
        return made[-1], told

    made = []
    yield make
    for one in made:
        one.close()


def reading(topic, value=True):
    return topic.encode() + b"\0" + encode(Bool(value), "cdr")


@root
@pytest.mark.parametrize(("name", "topic"), [("sensors.sock", "lock"), ("estop.sock", "estop")])
def test_what_another_user_sends_is_no_reading_and_no_press_and_no_release(folder, sensors, name, topic):
    at, told = sensors()

    def heard():
        return [*at.stops(), *at.read()]

    send_as(ANOTHER, ANOTHER, folder / name, reading(topic))
    assert heard() == []
    assert told == [
        f"what comes to {folder / name} from another user is not used: it is the user {ANOTHER}, to whom {folder} does "
        "not belong"
    ]
    send_as(0, 0, folder / name, reading(topic))
    assert heard() == [(topic, Bool(True))]
    os.chown(folder, ANOTHER, 0)  # a folder that systemd made for the user of the units
    again, _ = sensors()
    send_as(ANOTHER, ANOTHER, folder / name, reading(topic))
    assert [*again.stops(), *again.read()] == [(topic, Bool(True))]


@root
def test_drivers_of_another_user_are_of_the_group_that_the_folder_hands_down(folder, sensors):
    os.chown(folder, 0, ANOTHER + 1)
    folder.chmod(0o750)
    at, _ = sensors()
    folder.chmod(0o711)
    send_as(ANOTHER, ANOTHER + 1, folder / "sensors.sock", reading("lock"))
    assert list(at.read()) == [], "a group alone is not enough: many have one that is everybody's"
    folder.chmod(0o2711)
    assert objection(str(folder)) == ""
    at, _ = sensors()
    assert (folder / "sensors.sock").stat().st_gid == ANOTHER + 1
    send_as(ANOTHER, ANOTHER + 1, folder / "sensors.sock", reading("lock"))
    send_as(ANOTHER, ANOTHER, folder / "sensors.sock", reading("lock", False))
    assert list(at.read()) == [("lock", Bool(True))]


@root
def test_wheels_that_another_user_has_are_not_told(folder, tmp_path):
    wheels = SocketWheels(str(folder / "wheels.sock"))
    theirs = bind(str(folder / "wheels.sock"))
    os.chown(folder / "wheels.sock", ANOTHER, ANOTHER)
    with pytest.raises(PermissionError, match=f"may not have the wheels: it is the user {ANOTHER}"):
        wheels.write(Velocity(0.1, 0))
    os.chown(folder / "wheels.sock", 0, 0)
    wheels.write(Velocity(0.1, 0))
    assert theirs.recv(100)
    wheels.close()
    theirs.close()


@root
@pytest.mark.parametrize("make", ["bind", "link"])
def test_wheels_of_whoever_may_write_to_the_folder_that_hands_its_group_down_are_not_told(folder, tmp_path, make):
    group = ANOTHER + 1
    os.chown(folder, 0, group)
    folder.chmod(0o3770)
    assert objection(str(folder)) == ""
    for above in folder.parents:
        if above.stat().st_uid == os.geteuid() and above != Path("/") and not above.stat().st_mode & 0o001:
            above.chmod(0o711)
    root_has = bind(str(tmp_path / "elsewhere"))
    wheels = SocketWheels(str(folder / "wheels.sock"))
    pid = os.fork()
    if pid == 0:
        try:
            os.setgroups([group])  # one of its further groups, as an administrator gives it
            os.setgid(ANOTHER)
            os.setuid(ANOTHER)
            if make == "link":  # to one that is ours, for now
                os.symlink(tmp_path / "elsewhere", folder / "wheels.sock")
            else:
                socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM).bind(str(folder / "wheels.sock"))
        finally:
            os._exit(0)
    os.waitpid(pid, 0)
    assert (folder / "wheels.sock").lstat().st_gid == group
    with pytest.raises(PermissionError, match=f"may not have the wheels: it is the user {ANOTHER}"):
        wheels.write(Velocity(0.1, 0))
    wheels.close()
    root_has.close()


@root
def test_what_another_user_listens_at_gets_no_command_and_no_enable_signal(folder):
    link, line = GateLink(folder), open_line(["unix", str(folder / "enable.sock")])
    wanted = {
        COMMAND_SOCKET: lambda: link.send(Velocity(0.1, 0)),
        "enable.sock": lambda: line.write(True),
    }
    for name, tell in wanted.items():
        theirs = bind(str(folder / name))
        os.chown(folder / name, ANOTHER, ANOTHER)
        with pytest.raises(PermissionError, match=f"{name} may not have the .*: it is the user {ANOTHER}"):
            tell()
        with pytest.raises(BlockingIOError):
            theirs.recv(100)
        os.chown(folder / name, 0, 0)
        tell()
        assert theirs.recv(100)
        theirs.close()
    link.close()
    line.close()


@root
def test_wheels_of_another_user_have_a_folder_that_is_theirs(folder):
    os.chown(folder, ANOTHER, ANOTHER)
    theirs = bind(str(folder / "wheels.sock"))
    os.chown(folder / "wheels.sock", ANOTHER, ANOTHER)
    wheels = SocketWheels(str(folder / "wheels.sock"))
    wheels.write(Velocity(0.1, 0))
    assert theirs.recv(100)
    wheels.close()
    theirs.close()


@pytest.fixture
def came_first(folder):
    """A folder of another user, where everybody may make some; called, it is in one where only root may, as /run."""
    theirs = folder / "driver"
    theirs.mkdir()
    os.chown(theirs, ANOTHER, ANOTHER)
    folder.chmod(0o1777)
    return theirs, lambda: folder.chmod(0o755)


@root
def test_whoever_made_the_folder_first_where_all_may_is_told_nothing(came_first):
    theirs, make_it_theirs = came_first
    path = str(theirs / "driver.sock")
    wheels, line = SocketWheels(path), open_line(["unix", path])
    with bind(path) as listens:
        os.chown(path, ANOTHER, ANOTHER)
        with pytest.raises(PermissionError, match="may not have the wheels"):
            wheels.write(Velocity(0.1, 0))
        with pytest.raises(PermissionError, match="may not have the enable signal"):
            line.write(True)
        make_it_theirs()
        wheels.write(Velocity(0.1, 0))
        line.write(True)
        assert len([listens.recv(100), listens.recv(100)]) == 2
    wheels.close()
    line.close()


@root
def test_whoever_made_the_folder_first_where_all_may_is_not_heard(came_first):
    theirs, make_it_theirs = came_first
    for heard in ([], [("lock", Bool(True))]):
        topics = Topics({"lock": Bool}, {})
        at = SocketSensors(str(theirs / "sensors.sock"), bind(str(theirs / "estop.sock")), topics, lambda *_: None)
        send_as(ANOTHER, ANOTHER, theirs / "sensors.sock", reading("lock"))
        assert list(at.read()) == heard
        at.close()
        make_it_theirs()


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
