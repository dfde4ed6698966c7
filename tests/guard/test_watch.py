import socket
from math import inf, nan

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skytether.guard.kinematics import Bounds
from skytether.guard.protocol import (
    Answer,
    Beat,
    LastCommand,
    pack_answer,
    pack_beat,
    pack_note,
    pack_twist,
    unpack_answer,
    unpack_beat,
    unpack_note,
)
from skytether.guard.systemd import Systemd
from skytether.guard.velocity import STANDSTILL, Velocity
from skytether.guard.watch import Watch
from skytether.messages import Twist, Vector3, decode
from skytether.robot.control.command import Command, Hand
from skytether.robot.safety import protocol

BOUNDS = Bounds(0.25, 0.0, 0.5, 1.0, 2.0, 2.0, 4.0)
PERIOD, PATIENCE = 0.02, 0.1


def told(watch: Watch, now: float, **how: bool) -> tuple[Velocity, str]:
    """What the wheels are told now, and are told."""
    velocity, wrong = watch.want(now, **how)
    watch.wrote(velocity, now)
    return velocity, wrong


def driving() -> Watch:
    """0.2 m/s and 0.4 rad/s at 1.0 s."""
    watch = Watch(BOUNDS, PERIOD, PATIENCE)
    watch.wrote(Velocity(0.2, 0.4), 0.98)
    watch.on_beat(Beat(1.0, Velocity(0.2, 0.4)))
    assert told(watch, 1.0) == ((0.2, 0.4), "")
    return watch


def test_what_is_fresh_goes_to_the_wheels_and_what_is_not_brakes():
    watch = driving()
    assert told(watch, 1.09) == ((0.2, 0.4), "")
    velocity, wrong = told(watch, 1.101)
    assert "says nothing" in wrong
    assert velocity == pytest.approx((0.2 * 0.89, 0.4 * 0.89))  # 10 per second on both axes, 11 ms later
    for i in range(10):
        velocity, _ = told(watch, 1.12 + i * 0.02)
    assert velocity == STANDSTILL


def test_what_is_far_away_is_reached_with_the_acceleration_and_no_faster():
    watch = Watch(BOUNDS, PERIOD, PATIENCE)
    watch.wrote(STANDSTILL, 1.0)
    watch.on_beat(Beat(1.02, Velocity(0.25, 0.0)))
    assert told(watch, 1.02)[0] == pytest.approx((0.02, 0.0))
    assert told(watch, 1.03)[0] == pytest.approx((0.03, 0.0))


@pytest.mark.parametrize("then", ["gap", "failed", "never"])
def test_a_gap_a_failed_write_and_nothing_at_all_are_a_standstill(then):
    watch = driving() if then != "never" else Watch(BOUNDS, PERIOD, PATIENCE)
    now = 1.0
    if then == "gap":
        now = 1.101
    if then == "failed":
        watch.failed(now)
    watch.on_beat(Beat(now + 0.02, Velocity(0.2, 0.4)))
    velocity, wrong = told(watch, now + 0.02)
    assert wrong == ""
    assert velocity.linear <= 0.02 * 1.0 + 1e-9
    assert velocity.angular <= 0.02 * 2.0 + 1e-9


def test_what_somebody_else_told_the_wheels_later_counts():
    watch = driving()
    watch.on_beat(Beat(1.02, Velocity(0.2, 0.4)))
    watch.learn(LastCommand(Velocity(0.1, 0.2), 1.01))
    assert told(watch, 1.02)[0] == pytest.approx((0.11, 0.22))
    watch.on_beat(Beat(1.04, Velocity(0.11, 0.22)))
    watch.learn(LastCommand(STANDSTILL, 1.01))  # before what was told last
    assert told(watch, 1.04)[0] == pytest.approx((0.11, 0.22))
    watch.learn(LastCommand(Velocity(nan, 0.0), 1.05))
    watch.learn(LastCommand())
    assert watch.told == LastCommand((0.11, 0.22), 1.04)


def test_stopped_brakes_whatever_is_wanted():
    watch = driving()
    watch.on_beat(Beat(1.02, Velocity(0.25, 0.5)))
    assert told(watch, 1.02, stopped=True) == ((pytest.approx(0.16), pytest.approx(0.32)), "")


def test_before_anybody_says_anything_the_wheels_stand():
    watch = Watch(BOUNDS, PERIOD, PATIENCE)
    assert told(watch, 0.0) == (STANDSTILL, "says nothing")


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
    watch.on_beat(Beat(1.01, Velocity(*velocity)))
    braked, wrong = told(watch, 1.01)
    assert says in wrong
    assert braked == pytest.approx((0.18, 0.36))


@pytest.mark.parametrize("now", [0.9, nan, inf, -inf])
def test_a_clock_that_jumps_brakes(now):
    watch = driving()
    velocity, wrong = watch.want(now)
    assert wrong
    assert velocity.linear < 0.2


axis = st.floats(allow_nan=True, allow_infinity=True)


@given(st.lists(st.tuples(st.floats(0.0, 0.3), axis, axis, st.sampled_from(["", "failed", "stopped"])), max_size=60))
def test_whatever_is_wanted_the_wheels_are_never_told_more_than_the_limits(steps):
    watch, now = Watch(BOUNDS, PERIOD, PATIENCE), 0.0
    for dt, linear, angular, what in steps:
        before, gap = watch.told, now + dt - watch.told.at
        now += dt
        watch.on_beat(Beat(now, Velocity(linear, angular)))
        velocity, _ = told(watch, now, stopped=what == "stopped")
        base, step = (before.velocity, gap) if gap <= PATIENCE else (STANDSTILL, PERIOD)
        assert 0 <= velocity.linear <= 0.25
        assert base.linear - 2.0 * step - 1e-9 <= velocity.linear <= base.linear + 1.0 * step + 1e-9
        assert abs(velocity.angular - base.angular) <= 4.0 * step + 1e-9
        if what == "failed":
            watch.failed(now)


def test_bytes_go_there_and_back():
    beat = Beat(3.5, Velocity(0.1, -0.2), 7, True, "sömebody fell")
    assert unpack_beat(pack_beat(beat)) == beat
    answer = Answer(3.5, 8, False, "sömebody fell")
    assert unpack_answer(pack_answer(answer)) == answer
    assert unpack_note(pack_note("the laser is blind")) == "the laser is blind"
    for decided in (True, False):
        data = protocol.pack_command(7, 8, 3.5, Velocity(0.1, -0.2), decided)
        command = Command(Hand.AGENT, 0.1, -0.2, 7, 8, 3.5, 0.0, 4.0, decided=decided)
        assert protocol.unpack_command(data, Hand.AGENT, 4.0) == command


@pytest.mark.parametrize("reason", ["ö" * 400, "\udcff" * 400, "\n\0", "🤖" * 100])
def test_any_reason_fits(reason):
    for found in (
        unpack_beat(pack_beat(Beat(1.0, STANDSTILL, stopped=reason))),
        unpack_answer(pack_answer(Answer(1.0, stopped=reason))),
    ):
        assert found is not None
        assert len(found.stopped.encode()) <= 200


def test_wheels_understand_the_twist():
    assert decode(Twist, pack_twist(Velocity(0.1, -0.2))) == Twist(linear=Vector3(x=0.1), angular=Vector3(z=-0.2))


@given(st.binary(max_size=300) | st.binary(max_size=260).map(lambda rest: b"SkB3" + rest))
def test_other_bytes_are_nothing(data):
    assert unpack_answer(data) is None
    assert unpack_note(data) is None or data[:4] == b"SkN3"
    assert unpack_beat(data) is None or data[:4] == b"SkB3"
    assert protocol.unpack_command(data, Hand.AGENT, 0.0) is None


def test_the_service_manager_is_told_and_missed_by_nobody(tmp_path, monkeypatch):
    path = tmp_path / "notify"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(path))
        manager.settimeout(30)
        monkeypatch.setenv("NOTIFY_SOCKET", str(path))
        systemd = Systemd()
        systemd.notify("READY=1")
        assert manager.recv(64) == b"READY=1"
    systemd.notify("WATCHDOG=1")  # nobody listens any more
    systemd.close()
    monkeypatch.delenv("NOTIFY_SOCKET")
    Systemd().notify("READY=1")
