"""Descriptors that somebody sends along hold nobody up, on kernels that refuse them and on those that do not."""

import array
import fcntl
import json
import os
import resource
import socket
import struct
import time
from contextlib import contextmanager, suppress
from operator import attrgetter

import pytest

from skytether.guard import descriptors
from skytether.guard.child import Child
from skytether.guard.log import Log
from skytether.guard.mailbox import bind
from skytether.guard.onlooker import Onlooker
from skytether.guard.requests import Requests
from skytether.guard.velocity import STANDSTILL
from skytether.messages import Bool, LaserScan, encode
from skytether.robot.graphs.inbox import Topics
from skytether.robot.safety.client import GateLink
from skytether.robot.safety.io.hardware import SocketSensors
from skytether.robot.safety.protocol import COMMAND_SOCKET, GateState, pack_state

LINGERS_S = 60
PATIENCE_S = 20
"""Less than a close would wait; a machine under load needs some."""


@contextmanager
def quickly():
    began = time.monotonic()
    yield
    assert time.monotonic() - began < PATIENCE_S


@pytest.fixture(params=["refused", "held"])
def kernel(request, monkeypatch):
    """One that refuses descriptors, and one that does not know how to."""
    if request.param == "held":
        monkeypatch.setattr(descriptors, "REFUSED", False)
        monkeypatch.setattr(descriptors, "SO_PASSRIGHTS", 9999)
    elif not descriptors.REFUSED:
        pytest.skip("this kernel has no SO_PASSRIGHTS")
    return request.param


@pytest.fixture
def lingering():
    """Makes descriptors whose last close waits, as their peer reads nothing."""
    peers = []

    def make():
        with socket.socket() as listener:
            listener.bind(("127.0.0.1", 0))
            listener.listen()
            made = socket.create_connection(listener.getsockname())
            peers.append(listener.accept()[0])
        made.setblocking(False)
        with suppress(BlockingIOError):
            while True:
                made.send(bytes(65536))
        made.setblocking(True)
        made.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, LINGERS_S))
        return made

    yield make
    for peer in peers:
        peer.close()  # with unread bytes: the waiting ends


def send(sender, data, *files, to=None):
    """With descriptors, which are then nobody's but the message's; False: the kernel refused."""
    rights = array.array("i", [file.fileno() for file in files])
    try:
        address = (to,) if to is not None else ()
        sender.sendmsg([data], [(socket.SOL_SOCKET, socket.SCM_RIGHTS, rights)], 0, *address)
    except PermissionError:
        for file in files:
            file.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 0, 0))
        return False
    finally:
        for file in files:
            file.close()
    return True


def reading(topic, message):
    return topic.encode() + b"\0" + encode(message, "cdr")


def find(inode):
    """The descriptors of this process that are of this file."""
    for name in os.listdir("/proc/self/fd"):
        with suppress(OSError):  # the one of the folder itself is gone by now
            if os.stat(f"/proc/self/fd/{name}").st_ino == inode:
                yield int(name)


def open_files():
    return len(os.listdir("/proc/self/fd"))


@pytest.fixture
def sensors(kernel, tmp_path):
    topics = Topics({"scan": LaserScan, "estop": Bool}, {"estop": attrgetter("data")})
    made = SocketSensors(str(tmp_path / "sensors.sock"), str(tmp_path / "estop.sock"), topics, lambda *_: None)
    yield made
    made.close()


@pytest.mark.parametrize("number", [1, 3])
def test_readings_that_bring_descriptors_hold_the_gate_up_for_no_time(sensors, kernel, lingering, tmp_path, number):
    before = open_files()
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as driver:
        path = str(tmp_path / "sensors.sock")
        came = send(driver, reading("scan", LaserScan()), *(lingering() for _ in range(number)), to=path)
        assert came is (kernel == "held")
        driver.sendto(reading("scan", LaserScan()), path)
        with quickly():
            assert [topic for topic, _ in sensors.read()] == ["scan"]
            assert not list(sensors.read())
    assert open_files() <= before + 2 * number  # the peers, and what waits to be closed


def test_a_press_behind_a_message_with_descriptors_is_heard(sensors, lingering, tmp_path):
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as driver:
        send(driver, b"rubbish", lingering(), to=str(tmp_path / "estop.sock"))
        driver.sendto(reading("estop", Bool(data=True)), str(tmp_path / "estop.sock"))
        with quickly():
            assert [message.data for _, message in sensors.stops()] == [True]


def test_a_request_that_brings_descriptors_is_answered(kernel, lingering, tmp_path):
    requests = Requests(str(tmp_path / "stop.sock"), dict)
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as link:
        link.connect(str(tmp_path / "stop.sock"))
        if not send(link, b'{"do": "status"}', lingering()):
            link.send(b'{"do": "status"}')
        with quickly():
            requests.turn()
            assert json.loads(link.recv(100)) == {"do": "status"}
    requests.close()


def test_an_agent_takes_none_with_what_the_gate_answers(kernel, lingering, tmp_path):
    tmp_path.chmod(0o700)
    gate = bind(str(tmp_path / COMMAND_SOCKET))
    link = GateLink(tmp_path)
    link.send(STANDSTILL)
    _, agent = gate.recvfrom(1000)
    state = pack_state(GateState(5.0, STANDSTILL, 5.0, "somebody fell", "nobody"))
    if not send(gate, state, lingering(), to=agent):
        gate.sendto(state, agent)
    with quickly():
        assert link.state().stopped == "somebody fell"
    link.close()
    gate.close()


def test_a_child_that_sends_descriptors_holds_the_guard_up_for_no_time(kernel, lingering, monkeypatch):
    """The process that only shows something, say, which has gone mad."""
    pairs, make = [], socket.socketpair

    def remembered(*arguments):
        pairs.append(make(*arguments))
        return pairs[-1]

    monkeypatch.setattr("skytether.guard.child.socket.socketpair", remembered)
    monkeypatch.setattr(Child, "_start", lambda *_: None)
    display = Onlooker("display", ("display",), 0, Log("guard", os.open(os.devnull, os.O_WRONLY)))
    display.turn(1.0)
    ((own, theirs),) = pairs
    assert send(theirs, b".", lingering()) is (kernel == "held")
    with suppress(BlockingIOError):
        theirs.send(b".")
    with quickly():
        display.turn(2.0)
    theirs.close()
    display.turn(3.0)
    assert "ended" in display.trouble
    own.close()


def test_where_there_is_no_room_for_descriptors_the_socket_is_silent(monkeypatch, tmp_path):
    """To take the message would close those for good that do not fit."""
    monkeypatch.setattr(descriptors, "REFUSED", False)
    monkeypatch.setattr(descriptors, "SO_PASSRIGHTS", 9999)
    own = bind(str(tmp_path / "s"))
    files = [socket.socket() for _ in range(8)]
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
        send(sender, b"x", *files, to=str(tmp_path / "s"))
        highest = max(int(name) for name in os.listdir("/proc/self/fd")) + 1
        spare = [os.dup(own.fileno()) for _ in range(highest - open_files() + 2)]  # no holes below the limit
        resource.setrlimit(resource.RLIMIT_NOFILE, (max(spare) + 3, limits[1]))
        try:
            with pytest.raises(BlockingIOError):
                descriptors.receive(own, 100)
        finally:
            resource.setrlimit(resource.RLIMIT_NOFILE, limits)
            for one in spare:
                os.close(one)
    assert descriptors.receive(own, 100)[0] == b"x"
    with pytest.raises(BlockingIOError):
        descriptors.receive(own, 100)
    own.close()


def test_too_many_that_wait_to_be_closed_leave_the_socket_silent(monkeypatch, lingering, tmp_path):
    monkeypatch.setattr(descriptors, "CLOSER", descriptors.Closer(most=2))
    monkeypatch.setattr(descriptors, "REFUSED", False)
    monkeypatch.setattr(descriptors, "SO_PASSRIGHTS", 9999)
    own = bind(str(tmp_path / "s"))
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
        behind = socket.socket()
        known = os.fstat(behind.fileno()).st_ino
        for data, file in ((b"a", lingering()), (b"b", behind), (b"c", socket.socket())):
            send(sender, data, file, to=str(tmp_path / "s"))
        assert descriptors.receive(own, 100)[0] == b"a"
        assert descriptors.receive(own, 100)[0] == b"b"
        with pytest.raises(BlockingIOError):
            descriptors.receive(own, 100)
        (held,) = find(known)
        assert fcntl.fcntl(held, fcntl.F_GETFD) & fcntl.FD_CLOEXEC, "no program that is started meanwhile gets it"
    own.close()
