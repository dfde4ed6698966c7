import socket
from math import inf, nan

import pytest

from skytether.control.admittance import STANDSTILL, Velocity
from skytether.robot.command import Command
from skytether.robot.safety import protocol
from skytether.robot.safety.guard import Watch
from skytether.robot.safety.process import Systemd
from skytether.robot.safety.protocol import Beat
from skytether.robot.safety.sources import Hand
from skytether.robot.supervisor import Limits

LIMITS = Limits()  # 0 to 0.25 m/s, 0.5 rad/s; brakes 2 m/s^2 and 4 rad/s^2; 10 ms


def driving() -> Watch:
    watch = Watch(LIMITS, max_age_s=0.1)
    watch.hear(Beat(1.0, Velocity(0.2, 0.4)))
    assert watch.look(1.0) == ""
    assert watch.velocity == (0.2, 0.4)
    return watch


def test_what_is_fresh_goes_to_the_wheels_and_what_is_not_brakes():
    watch = driving()
    assert watch.look(1.09) == ""
    assert "says nothing" in watch.look(1.101)
    # 10 per second on both axes, since the look before 11 ms ago.
    assert watch.velocity == pytest.approx((0.2 * 0.89, 0.4 * 0.89))
    for i in range(10):
        watch.look(1.12 + i * 0.02)
    assert watch.velocity == STANDSTILL


def test_before_the_gate_says_anything_the_wheels_stand():
    watch = Watch(LIMITS, 0.1)
    assert "says nothing" in watch.look(0.0)
    assert watch.velocity == STANDSTILL


@pytest.mark.parametrize(
    ("velocity", "says"),
    [
        ((nan, 0.0), "no number"),
        ((0.0, inf), "no number"),
        ((0.26, 0.0), "beyond the limits"),
        ((-0.01, 0.0), "beyond the limits"),
        ((0.1, -0.51), "beyond the limits"),
    ],
)
def test_a_gate_gone_mad_is_not_followed(velocity, says):
    watch = driving()
    watch.hear(Beat(1.01, Velocity(*velocity)))
    assert says in watch.look(1.01)
    assert watch.velocity == pytest.approx((0.18, 0.36))


@pytest.mark.parametrize("now", [0.9, nan, inf, -inf])
def test_a_clock_that_jumps_brakes(now):
    watch = driving()
    assert watch.look(now)
    assert watch.velocity.linear < 0.2


def test_bytes_go_there_and_back():
    beat = Beat(3.5, Velocity(0.1, -0.2))
    assert protocol.unpack_beat(protocol.pack_beat(beat)) == beat
    data = protocol.pack_command(7, 8, 3.5, Velocity(0.1, -0.2))
    assert protocol.unpack_command(data, Hand.AGENT, 4.0) == Command(Hand.AGENT, 0.1, -0.2, 7, 8, 3.5, 0.0, 4.0)


@pytest.mark.parametrize("data", [b"", b"SkG1", b"x" * 28, b"x" * 44, b"SkG1" + b"x" * 41])
def test_other_bytes_are_nothing(data):
    assert protocol.unpack_beat(data) is None
    assert protocol.unpack_command(data, Hand.AGENT, 0.0) is None


def test_the_service_manager_is_told_and_missed_by_nobody(tmp_path, monkeypatch):
    path = tmp_path / "notify"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(path))
        manager.settimeout(30)
        monkeypatch.setenv("NOTIFY_SOCKET", str(path))
        systemd = Systemd()
        systemd.tell("READY=1")
        assert manager.recv(64) == b"READY=1"
    systemd.tell("WATCHDOG=1")  # nobody listens any more
    systemd.close()
    monkeypatch.delenv("NOTIFY_SOCKET")
    Systemd().tell("READY=1")
