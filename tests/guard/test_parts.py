"""Requests, record, settings and log of the guard, on real sockets and files."""

import fcntl
import json
import os
import resource
import socket
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skytether.guard import record, settings
from skytether.guard.kinematics import Bounds
from skytether.guard.log import Log
from skytether.guard.protocol import pack_twist
from skytether.guard.requests import Requests, readable
from skytether.guard.velocity import Velocity
from skytether.guard.wheels import SocketWheels


def connect(path):
    link = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    link.settimeout(30)
    link.connect(str(path))
    return link


@pytest.fixture
def asked(tmp_path):
    """A socket that echoes, later if asked to."""
    later = []

    def handle(request):
        if request["do"] == "later":
            return lambda: {"later": True} if later else None
        if request["do"] == "fail":
            raise RuntimeError("a bug")
        return dict(request)

    requests = Requests(str(tmp_path / "s"), handle)
    yield requests, tmp_path / "s", later
    requests.close()


def test_many_idle_clients_hold_nobody_up(asked):
    requests, path, _ = asked
    idle = []
    for _ in range(40):
        idle.append(connect(path))
        requests.turn()
    with connect(path) as link:
        link.send(b'{"do": "status"}')
        for _ in range(3):
            requests.turn()
        assert json.loads(link.recv(100)) == {"do": "status"}
    assert len(requests.sockets()) <= 17
    for one in idle:
        one.close()


def test_clients_with_large_numbers_are_answered(asked):
    """A node of a graph in the same process may have a thousand connections; `select` knows 1,024 descriptors."""
    requests, path, _ = asked
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(2048, hard), hard))
    try:
        with ExitStack() as many, open(os.devnull, "rb") as null:
            for _ in range(1050):
                many.callback(os.close, os.dup(null.fileno()))
            idle, link = many.enter_context(connect(path)), many.enter_context(connect(path))
            requests.turn()
            assert link.fileno() > 1023
            link.send(b'{"do": "status"}')
            requests.turn()
            assert readable([idle, link], 30.0) == [link]
            assert json.loads(link.recv(100)) == {"do": "status"}
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


def test_an_answer_may_come_later(asked):
    requests, path, later = asked
    with connect(path) as link:
        link.send(b'{"do": "later"}')
        requests.turn()
        link.setblocking(False)
        with pytest.raises(BlockingIOError):
            link.recv(100)
        later.append(1)
        requests.turn()
        assert json.loads(link.recv(100)) == {"later": True}


@pytest.mark.parametrize(
    "data", [b"{", b"[]", b"3", b'"do"', b"{}", b"\xff\xfe", b'{"do": 3}', b'{"do": "fail"}', b"[" * 4000]
)
def test_a_request_that_is_none_is_refused(asked, data):
    requests, path, _ = asked
    with connect(path) as link:
        link.send(data)
        requests.turn()
        assert "request" in json.loads(link.recv(1000))["refused"]


def test_a_stop_whose_reason_is_too_long_to_be_read_is_a_stop(asked):
    requests, path, _ = asked
    with connect(path) as link:
        link.send(json.dumps({"do": "stop", "reason": "\U0001f525" * 500}).encode())
        requests.turn()
        assert json.loads(link.recv(1000)) == {"do": "stop"}


def test_the_socket_is_the_users_own(asked):
    _, path, _ = asked
    assert path.stat().st_mode & 0o077 == 0


def test_the_record_is_bounded_and_goes_on_where_it_was(tmp_path):
    path = tmp_path / "state" / "record"

    def add(events, number):
        for i in range(number):
            events.add("guard", "stop", f"number {i} ö\n", 5.0, 7.0)
            end = time.monotonic() + 30
            while not events.written:
                assert time.monotonic() < end
                time.sleep(0.0005)

    add(record.Record(str(path), "boot"), 3)
    assert path.stat().st_size == record.SLOTS * record.SLOT_BYTES
    found = record.decode(path.read_bytes())
    assert [(e["n"], e["who"], e["what"], e["wall"], e["at"], e["boot"]) for e in found] == [
        (i, "guard", "stop", 5.0, 7.0, "boot") for i in range(3)
    ]
    second = record.Record(str(path), "next boot")
    add(second, 2)
    assert [e["n"] for e in record.decode(path.read_bytes())] == [0, 1, 2, 3, 4]
    assert path.stat().st_size == record.SLOTS * record.SLOT_BYTES


def test_the_oldest_events_go(monkeypatch, tmp_path):
    monkeypatch.setattr(record, "SLOTS", 4)
    path = tmp_path / "record"
    events = record.Record(str(path), "boot")
    for i in range(10):
        events.add("gate", "trouble", str(i), 0.0, 0.0)
    end = time.monotonic() + 30
    while not events.written:
        assert time.monotonic() < end
        time.sleep(0.001)
    assert [e["detail"] for e in record.decode(path.read_bytes())] == ["6", "7", "8", "9"]


def recorded(events, detail="x"):
    events.add("gate", "trouble", detail, 0.0, 0.0)
    end = time.monotonic() + 30
    while not events.written:
        assert time.monotonic() < end
        time.sleep(0.001)


def test_two_guards_do_not_write_into_one_record(tmp_path):
    """Each would overwrite the slots of the other."""
    path = tmp_path / "record"
    held = (
        "import fcntl, sys\n"
        "file = open(sys.argv[1], 'w')\n"
        "fcntl.lockf(file, fcntl.LOCK_EX)\n"
        "print('held', flush=True)\n"
        "sys.stdin.read()"
    )
    other = subprocess.Popen([sys.executable, "-c", held, path], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    with other:
        assert other.stdout.readline() == b"held\n"
        events = record.Record(str(path), "boot")
        recorded(events, "lost")
        assert "another robot's guard writes it" in events.trouble
        assert path.read_bytes() == b""
    recorded(events, "kept")
    assert events.trouble == ""
    (event,) = record.decode(path.read_bytes())
    assert (event["detail"], event["lost_before"]) == ("kept", 1)


@pytest.mark.parametrize(("kind", "lost"), [("tmpfs", True), ("ramfs", True), ("ext4", False), ("overlay", False)])
def test_a_record_that_a_reboot_empties_is_found_by_its_file_system(tmp_path, kind, lost):
    device = os.stat(tmp_path).st_dev
    mounts = tmp_path / "mountinfo"
    mounts.write_text(
        "22 27 0:0 / /proc rw,relatime - proc proc rw\n"
        f"25 24 {os.major(device)}:{os.minor(device)} / /a\\040b rw shared:7 - {kind} {kind} rw,size=5k\n"
        "damaged\n"
    )
    for path in (tmp_path, tmp_path / "record", tmp_path / "not" / "yet" / "there"):
        said = record.lost_at_reboot(str(path), str(mounts))
        assert bool(said) is lost
        assert not lost or (kind in said and "safety.record" in said)
    assert record.lost_at_reboot(str(tmp_path), str(tmp_path / "none")) == ""


@pytest.mark.skipif(not os.path.ismount("/dev/shm"), reason="no tmpfs here")
def test_the_guard_knows_that_its_record_is_in_memory():
    with tempfile.TemporaryDirectory(dir="/dev/shm") as folder:
        events = record.Record(f"{folder}/record", "boot")
        recorded(events)
        assert "is on a tmpfs" in events.note


def test_a_record_that_cannot_be_written_is_said(tmp_path):
    events = record.Record(str(tmp_path), "boot")
    events.add("gate", "trouble", "x", 0.0, 0.0)
    end = time.monotonic() + 30
    while not events.trouble:
        assert time.monotonic() < end
        time.sleep(0.001)
    assert "directory" in events.trouble


@given(st.text(max_size=2000), st.binary(max_size=2000))
def test_any_detail_fits_in_a_slot_and_damage_is_left_out(detail, damage):
    slot = record.encode({"n": 1, "detail": detail, "who": "gate"})
    assert len(slot) == record.SLOT_BYTES
    assert slot.endswith(b"\n")
    broken = damage.ljust((len(damage) // record.SLOT_BYTES + 1) * record.SLOT_BYTES, b"\0")
    assert [event["n"] for event in record.decode(broken + slot)][-1:] == [1]


GIVEN = settings.Settings(
    "/run/x",
    "/var/x",
    0.02,
    0.1,
    Bounds(1, -1, 1, 1, 1, 2, 2),
    ("10.0.0.1", 5),
    ("10.0.0.2", 6),
    ("python", "-m"),
    (),
    7,
    ("ö",),
)


def test_settings_go_there_and_back():
    assert settings.load(settings.dump(GIVEN)) == GIVEN
    nothing = GIVEN._replace(wheels=None, estop=None)
    assert settings.load(settings.dump(nothing)) == nothing


def test_what_is_frozen_stays_and_can_be_read_twice():
    file = settings.freeze("test", "ö" * 100_000)
    assert settings.thaw(file) == settings.thaw(file) == "ö" * 100_000
    with pytest.raises(PermissionError):
        os.write(file, b"x")
    with pytest.raises(PermissionError):
        os.ftruncate(file, 0)
    assert fcntl.fcntl(file, fcntl.F_GET_SEALS) & fcntl.F_SEAL_SEAL
    os.close(file)


def test_a_log_that_nobody_reads_is_not_waited_for():
    reader, writer = os.pipe()
    log = Log("guard", writer)
    for _ in range(5000):  # some times what a pipe takes
        log.line("INFO", "x" * 200)
    got = b""
    while b"dropped" not in got:
        got += os.read(reader, 65536)
    assert got.count(b"\n") < 5000
    os.close(reader)


def test_a_trouble_is_said_once(tmp_path):
    reader, writer = os.pipe()
    log = Log("guard", writer)
    said = [log.trouble("wheels", "they are gone", 1.0 + i / 50) for i in range(500)]
    assert sum(said) == 1
    assert log.trouble("wheels", "they are gone", 100.0)
    log.close()
    assert os.read(reader, 1000).count(b"they are gone") == 2


def test_a_driver_that_ends_and_comes_back_is_a_failed_write(tmp_path):
    path = str(tmp_path / "wheels.sock")
    wheels = SocketWheels(path)
    with pytest.raises(OSError, match="No such file"):
        wheels.write(Velocity(0.1, 0.0))
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as first:
        first.bind(path)
        wheels.write(Velocity(0.1, 0.0))
    os.unlink(path)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as second:
        second.bind(path)  # the next is there before anything was written again
        with pytest.raises(OSError, match="refused"):
            wheels.write(Velocity(0.1, 0.0))
        wheels.write(Velocity(0.2, 0.0))
        assert len(second.recv(100)) == 52
    wheels.close()


def test_what_is_old_by_the_time_it_would_be_sent_is_not(tmp_path):
    """The process stood still between its decision and the kernel."""
    path = str(tmp_path / "wheels.sock")
    wheels = SocketWheels(path, clock=lambda: 2.0)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as driver:
        driver.bind(path)
        with pytest.raises(TimeoutError, match="stood still"):
            wheels.write(Velocity(0.5, 0.0), until=1.9)
        wheels.write(Velocity(0.1, 0.0), until=2.1)
        assert driver.recv(100) == pack_twist(Velocity(0.1, 0.0))
    wheels.close()
