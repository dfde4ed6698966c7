"""Requests, record, settings and log of the guard, on real sockets and files."""

import fcntl
import json
import os
import socket
import time

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skytether.guard import record, settings
from skytether.guard.kinematics import Bounds
from skytether.guard.log import Log
from skytether.guard.requests import Requests
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
