import logging
import re
from dataclasses import replace
from itertools import count, pairwise
from math import nan

import pytest

from skytether.api.manifest import Needs, TopicSpec
from skytether.control.admittance import STANDSTILL, Velocity
from skytether.messages import Twist, Vector3, WrenchStamped, decode, encode
from skytether.robot.control.arbiter import LinkRequirements, Reason
from skytether.robot.control.command import Source
from skytether.robot.control.control_loop import ControlLoop, WheelsStandError
from skytether.robot.control.fallback import Admittance, Stop
from skytether.robot.control.service_manager import Terms, terms
from skytether.robot.control.supervisor import VelocityLimits
from skytether.robot.control.wheels_feedback import WheelsFeedback
from skytether.robot.session.link_quality import Quality
from skytether.robot.session.session import LiveSession
from skytether.wire.events import Connected, Disconnected, MessageReceived

TICK = 0.01


class BrokenFallback:
    drives = True

    def step(self, velocity, readings, dt):
        raise ZeroDivisionError


class Rig:
    """A driver with made-up time, a base and, after `connect`, a cloud."""

    def __init__(self, base, cloud, fallback=None, observer=None, limits=None):
        self.base = base
        self.now = 100.0
        self.driver = ControlLoop(
            base, fallback or Admittance(), limits or VelocityLimits(), LinkRequirements(), self.now, observer
        )
        self._make_cloud = cloud
        self.epochs = count(1)
        """Numbers of handshakes, of all sessions."""
        self.cloud = None

    def connect(self, bridge):
        session = LiveSession("1", frozenset({"force"}), "cmd_vel", self.epochs)
        session.open(lambda port: bridge, ("127.0.0.1", 1))
        self.cloud = self._make_cloud(session)
        self.driver.session = session

    def run(self, seconds, **command):
        """Tick; if a cloud is there and a command is given, it sends one before each tick."""
        for _ in range(round(seconds / TICK)):
            self.now += TICK
            if command and self.cloud:
                self.cloud.send(self.now, **command)
            self.driver.tick(self.now)
        return self.driver.status()


@pytest.fixture
def rig(base, make_cloud):
    return Rig(base, make_cloud)


@pytest.fixture
def driven(rig, bridge):
    rig.connect(bridge)
    assert rig.run(1.5, linear=0.2, angular=0.1).source is Source.CLOUD
    return rig


def test_without_a_cloud_the_person_drives(rig):
    status = rig.run(3.0)
    assert status.source is Source.FALLBACK
    assert [t.reason for t in status.transitions] == [Reason.START]
    # 12 N push: 6 N mean force over 60 N s/m.
    assert rig.base.velocity == pytest.approx((0.1, 0.0), abs=1e-3)
    assert len(rig.base.written) == 300


def test_with_stop_as_fallback_the_wheels_stand(base, make_cloud):
    rig = Rig(base, make_cloud, fallback=Stop())
    assert rig.run(0.5).source is Source.STOP
    assert set(base.written) == {(0.0, 0.0)}


def test_the_cloud_drives_and_gets_the_readings(driven, bridge):
    status = driven.driver.status()
    assert driven.base.velocity == pytest.approx((0.2, 0.1))
    assert [(t.source, t.reason) for t in status.transitions] == [
        (Source.FALLBACK, Reason.START),
        (Source.CLOUD, Reason.RECOVERED),
    ]
    assert status.first_command_at == pytest.approx(100.01)
    assert status.seconds[Source.FALLBACK] == pytest.approx(1.01, abs=0.02)
    assert status.seconds[Source.CLOUD] == pytest.approx(0.49, abs=0.02)
    assert len(bridge.published) == 150
    assert decode(WrenchStamped, bridge.published[0][1]).wrench.force.x == 12.0


def test_a_change_of_session_loses_no_command_that_came_before_it(base, bridge, make_cloud):
    seen = []
    rig = Rig(base, make_cloud, observer=lambda command, objection: seen.append((command.linear, objection)))
    rig.connect(bridge)
    assert rig.run(1.5, linear=0.2).source is Source.CLOUD
    other = LiveSession("2", frozenset(), "cmd_vel", rig.epochs)
    rig.driver.offer(other)
    rig.run(0.05, linear=0.2)
    seen.clear()
    rig.cloud.send(rig.now, linear=0.21)
    make_cloud(other).send(rig.now, linear=0.22)
    rig.now += TICK
    rig.driver.tick(rig.now)
    assert rig.driver.session is other
    assert seen == [(0.21, None), (0.22, None)]
    rig.cloud.send(rig.now, linear=0.23)
    rig.run(TICK)
    assert len(seen) == 2, "the one before has no say any more"


def test_silence_hands_over_to_the_person_within_300_ms_without_a_jump_and_back(driven, caplog):
    caplog.set_level(logging.WARNING)
    silence = driven.now
    status = driven.run(0.3)
    assert status.source is Source.FALLBACK
    assert status.transitions[-1].reason is Reason.NO_COMMAND
    assert status.transitions[-1].at - silence <= 0.17
    driven.run(2.0)
    assert driven.base.velocity == pytest.approx((0.1, 0.0), abs=1e-3)
    status = driven.run(1.5, linear=0.25, angular=-0.5)
    assert status.source is Source.CLOUD
    assert status.transition_counts == {"start": 1, "no_command": 1, "recovered": 2}
    assert [re.sub(r"for 1\d0 ms", "for 1x0 ms", message) for message in caplog.messages] == [
        "control: cloud -> fallback (no_command): no command for 1x0 ms, 150 ms at most",
        "control: fallback -> cloud (recovered): all has been well for 1 s",
    ]
    limits = VelocityLimits()
    for (v0, w0), (v1, w1) in pairwise(driven.base.written):
        assert abs(v1 - v0) <= limits.linear_acceleration * TICK + 1e-9, "no braking in between, no jump"
        assert abs(w1 - w0) <= limits.angular_acceleration * TICK + 1e-9


def test_a_standstill_is_wanted_by_who_drives_or_by_nobody_while_no_service_has_spoken(base, make_cloud, bridge):
    """What is told because the service is not heard is no decision: it may want to drive all the time."""
    rig = Rig(base, make_cloud, Stop())
    rig.run(0.1)
    assert base.why[-1], "no service"
    rig.connect(bridge)
    rig.run(0.1)
    assert base.why[-1], "it has not spoken yet"
    rig.run(1.5, linear=0.2, angular=0.0)
    rig.run(1.5)
    assert base.velocity == (0.0, 0.0)
    assert not base.why[-1], "it has fallen silent"
    rig.run(1.5, linear=0.0, angular=0.0)
    assert base.why[-1], "it wants a standstill"
    rig.run(1.5)
    assert not base.why[-1]
    rig.driver.let_go()
    rig.run(0.1)
    assert not base.why[-1], "it was let go by the task manager, which may ask for it again by itself"


class Gate:
    """What the gate tells an agent, by hand."""

    def __init__(self, base):
        self.hand, self.stopped, self.started = "agent", "", False
        self._base = base
        base.told = self._told

    def _told(self, now):
        moves = self._base.written and self.hand != "nobody"
        return WheelsFeedback(
            Velocity(*self._base.written[-1]) if moves else STANDSTILL, 0.0, self.stopped, self.hand, self.started
        )


@pytest.fixture
def reset_on_its_own(base, make_cloud, bridge):
    """A robot that a service drove, was stopped and reset, and whose fallback wanted a standstill meanwhile."""
    gate, base.push = Gate(base), 0.0
    rig = Rig(base, make_cloud)
    rig.connect(bridge)
    assert rig.run(1.5, linear=0.2, angular=0.0).source is Source.CLOUD
    gate.hand = "nobody"
    rig.run(0.5, linear=0.2, angular=0.0)
    assert rig.run(5.0).source is Source.FALLBACK
    assert base.why[-1]
    gate.hand = "agent"
    rig.gate = gate
    return rig


def test_after_a_reset_the_fallback_s_standstill_is_not_the_service_s(reset_on_its_own, caplog):
    """It wanted to move all the time: the link's return alone must not set the robot in motion."""
    rig = reset_on_its_own
    begin = len(rig.base.written)
    assert rig.run(3.0, linear=0.2, angular=0.0).source is Source.FALLBACK
    assert max(linear for linear, _ in rig.base.written[begin:]) < 1e-6
    assert [r.message for r in caplog.records if "since before the reset" in r.message] != []
    rig.run(0.25, linear=0.0, angular=0.0)
    assert rig.run(0.1, linear=0.2, angular=0.0).source is Source.CLOUD


def test_after_a_reset_the_fallback_drives_while_the_service_owes_a_standstill(reset_on_its_own):
    rig = reset_on_its_own
    rig.base.push = 20.0
    assert rig.run(2.0, linear=0.2, angular=0.0).source is Source.FALLBACK
    assert rig.base.velocity[0] > 0.1


def test_a_service_that_a_person_starts_after_a_reset_goes_on(reset_on_its_own):
    rig = reset_on_its_own
    rig.gate.hand = "nobody"
    assert rig.run(1.5, linear=0.2, angular=0.0).source is Source.CLOUD
    rig.gate.hand, rig.gate.started = "agent", True
    rig.run(0.1, linear=0.2, angular=0.0)
    assert rig.run(1.0).source is Source.FALLBACK
    assert rig.run(1.5, linear=0.2, angular=0.0).source is Source.CLOUD


def test_a_service_that_owes_a_standstill_goes_on_once_a_person_starts_it(reset_on_its_own):
    """Also where the gate had let the agent go already, for the fallback's standstill."""
    rig = reset_on_its_own
    assert rig.run(2.0, linear=0.2, angular=0.0).source is Source.FALLBACK
    rig.gate.started = True
    assert rig.run(0.1, linear=0.2, angular=0.0).source is Source.CLOUD


def test_a_service_that_came_up_before_the_first_reset_drives_once_a_person_lets_the_agent_go(base, make_cloud, bridge):
    """As `robot run` does with a gate of its own: the service may be quicker, and wants to move from its first word."""
    gate, base.push = Gate(base), 0.0
    gate.hand, gate.stopped = "nobody", "nobody has reset the robot"
    rig = Rig(base, make_cloud, Stop())
    rig.run(0.5)
    rig.connect(bridge)
    rig.run(0.3, linear=0.2, angular=0.0)
    gate.stopped = ""
    rig.run(0.05, linear=0.2, angular=0.0)
    gate.hand, gate.started = "agent", True
    assert rig.run(1.5, linear=0.2, angular=0.0).source is Source.CLOUD


def test_a_service_that_is_let_go_and_asked_for_again_owes_a_standstill_all_the_same(reset_on_its_own, bridge):
    """The task manager does that by itself, and so does a graph that is joined anew: nobody decided anything."""
    rig = reset_on_its_own
    rig.driver.let_go()
    rig.run(0.1)
    rig.connect(bridge)
    assert rig.run(3.0, linear=0.2, angular=0.0).source is Source.FALLBACK
    rig.run(0.25, linear=0.0, angular=0.0)
    assert rig.run(0.1, linear=0.2, angular=0.0).source is Source.CLOUD


def test_a_service_that_takes_over_while_the_gate_s_word_is_late_gives_back(reset_on_its_own):
    """The gate heard the fallback's standstill; the agent hears of it when the service has the word already."""
    rig = reset_on_its_own
    rig.gate.hand = "nobody"
    begin = len(rig.base.written)
    while rig.run(TICK, linear=0.2, angular=0.0).source is not Source.CLOUD:
        pass
    rig.gate.hand = "agent"
    status = rig.run(3.0, linear=0.2, angular=0.0)
    assert (status.source, status.transitions[-1].reason) == (Source.FALLBACK, Reason.NEUTRAL)
    assert max(linear for linear, _ in rig.base.written[begin:]) < 0.05


def test_a_standstill_of_a_fallback_without_readings_is_not_wanted(base, make_cloud, monkeypatch):
    rig = Rig(base, make_cloud)
    base.push = 0.0
    rig.run(0.5)
    assert base.why[-1]
    monkeypatch.setattr(base, "read", lambda now: [])
    rig.run(1.0)
    assert base.velocity == (0.0, 0.0)
    assert not base.why[-1]


def test_a_session_that_ends_hands_over_at_the_next_tick(driven):
    driven.cloud.session.notify(Disconnected("silent"))
    status = driven.run(TICK, linear=0.2)
    assert status.transitions[-1].reason is Reason.DISCONNECTED


def test_a_new_handshake_starts_the_sequence_anew(driven):
    driven.cloud.session.notify(Connected(()))
    driven.cloud.sequence = 0
    status = driven.run(0.5, linear=0.2)
    assert status.source is Source.CLOUD
    assert "sequence" not in status.objections


def test_a_replayed_sequence_is_not_followed(driven):
    driven.cloud.sequence = 0
    status = driven.run(0.5, linear=0.2)
    assert status.source is Source.FALLBACK
    assert status.objections["sequence"] == 50


def test_nonsense_from_the_cloud_is_counted_and_not_followed(driven, nan_twist):
    driven.cloud.send_bytes(driven.now, b"no twist")
    driven.cloud.send_bytes(driven.now, nan_twist)
    status = driven.run(0.3)
    assert status.errors == {"decode": 1}
    assert status.objections["not_finite"] == 1
    assert status.source is Source.FALLBACK


SIDEWAYS = [Vector3(y=0.1), Vector3(z=-0.1)]
TILTING = [Vector3(x=0.1), Vector3(y=-0.1)]


@pytest.mark.parametrize(
    "twist", [*(Twist(linear=way) for way in SIDEWAYS), *(Twist(angular=turn) for turn in TILTING)], ids=str
)
def test_a_command_along_an_axis_that_the_wheels_do_not_have_is_refused_and_named(driven, caplog, twist):
    for _ in range(50):
        driven.cloud.send_bytes(driven.now, encode(replace(twist, linear=replace(twist.linear, x=0.2))))
        status = driven.run(TICK)
    assert status.objections["unused_axes"] == 50
    assert status.source is Source.FALLBACK
    said = [message for message in caplog.messages if message.startswith("commands of cloud")]
    axes = "linear.y, linear.z, angular.x, angular.y"
    assert said == [f"commands of cloud: one wants to move along {axes}, and the wheels cannot; such are not followed"]


def test_each_trouble_is_named_once_not_at_every_tick(driven, nan_twist, caplog):
    for _ in range(200):
        driven.cloud.send_bytes(driven.now, nan_twist)
        driven.run(TICK, linear=9.0)
    assert driven.driver.status().objections["not_finite"] == 200
    named = [message for message in caplog.messages if message.startswith("commands of")]
    assert named == [
        "commands of cloud: a velocity is NaN or infinite; such are not followed",
        "commands of cloud: faster than limits.linear_min and linear_max allow; they are cut down",
    ]


@pytest.mark.parametrize(("period", "patience"), [(0.02, 0.07), (0.05, 0.125), (0.1, 0.25)])
def test_a_service_is_left_within_three_of_its_periods(base, make_cloud, bridge, period, patience):
    rig = Rig(base, make_cloud, limits=VelocityLimits(max_gap_s=1.0))
    rig.connect(bridge)
    rig.driver.hold_to(Terms(period_s=period))
    for _ in range(round(8 / period)):
        rig.cloud.send(rig.now, delay=0.0)
        rig.run(period)
    assert rig.driver.status().source is Source.CLOUD
    silent = rig.now - period
    status = rig.run(3 * period + 0.05)
    assert status.source is Source.FALLBACK
    assert status.transitions[-1].at - silent <= patience + 2 * TICK + 1e-9


def test_a_sensor_that_raises_brakes_the_wheels_and_is_logged_once(driven, caplog):
    def fail():
        raise OSError("cable")

    driven.base.on_read = fail
    status = driven.run(0.3, linear=0.2)
    assert driven.base.velocity == (0.0, 0.0)
    assert driven.base.written[-30] == pytest.approx((0.18, 0.06)), "braked, not stopped dead"
    assert status.errors == {"control": 30}
    assert len([record for record in caplog.records if "control failed" in record.message]) == 1
    driven.base.on_read = lambda: None
    driven.run(1.5, linear=0.2)
    assert driven.base.velocity[0] == pytest.approx(0.2)
    driven.base.on_read = fail
    driven.run(0.3, linear=0.2)
    assert len([record for record in caplog.records if "control failed" in record.message]) == 1
    driven.base.on_read = lambda: None
    driven.run(31.0, linear=0.2)
    driven.base.on_read = fail
    driven.run(0.3, linear=0.2)
    assert len([record for record in caplog.records if "control failed" in record.message]) == 2, "a while later anew"


def test_a_fallback_that_raises_brakes_the_wheels(base, make_cloud):
    rig = Rig(base, make_cloud, fallback=BrokenFallback())
    assert rig.run(0.1).errors == {"control": 10}
    assert set(base.written) == {(0.0, 0.0)}


def test_a_supervisor_that_raises_stops_the_wheels(driven, monkeypatch):
    monkeypatch.setattr("skytether.robot.control.control_loop.supervisor.step", lambda *args: 1 / 0)
    assert driven.run(TICK).errors == {"control": 1, "supervisor": 1}
    assert driven.base.velocity == (0.0, 0.0)


def test_wheels_that_cannot_be_written_are_tried_again(driven):
    def fail():
        raise OSError("bus")

    driven.base.on_write = fail
    assert driven.run(0.05, linear=0.2).errors == {"write": 5}
    driven.base.on_write = lambda: None
    driven.run(TICK, linear=0.2)
    assert driven.base.velocity == pytest.approx((0.2, 0.0), abs=0.11)


def test_wheels_that_were_told_to_stand_go_on_from_there(driven):
    def stand():
        raise WheelsStandError("their node does not hear us")

    driven.run(1.0, linear=0.2)
    driven.base.on_write = stand
    driven.run(0.05, linear=0.2)
    driven.base.on_write = lambda: None
    driven.base.written.clear()
    driven.run(5 * TICK, linear=0.2)
    first, *_, last = [linear for linear, _ in driven.base.written]
    assert 0.0 < first < last < 0.1


def test_a_bridge_that_raises_costs_the_cloud_a_reading_only(driven, bridge, monkeypatch):
    monkeypatch.setattr(bridge, "publish", lambda topic, payload: 1 / 0)
    status = driven.run(0.2, linear=0.2, angular=0.1)
    assert status.errors == {"publish": 20}
    assert driven.base.velocity == pytest.approx((0.2, 0.1))


def test_sensors_that_went_silent_stop_the_fallback(rig, monkeypatch):
    rig.run(1.0)
    monkeypatch.setattr(rig.base, "read", lambda now: [])
    status = rig.run(0.5)
    assert rig.base.velocity == (0.0, 0.0)
    assert status.objections["stale"] > 0


def test_a_clock_that_jumps_back_brakes_and_is_named_once(driven, caplog):
    driven.now -= 10
    driven.run(TICK)
    assert driven.base.velocity[0] < 0.2
    driven.run(2.0, linear=0.2)
    assert driven.driver.status().source is Source.CLOUD
    named = [message for message in caplog.messages if "their age cannot be known" in message]
    assert len(named) == 1


def test_the_services_needs_decide(driven):
    driven.driver.hold_to(Terms(max_rtt_s=0.1))
    driven.driver.quality = Quality(rtt=0.3)
    status = driven.run(0.6, linear=0.2)
    assert status.transitions[-1].reason is Reason.RTT
    driven.driver.quality = Quality()
    driven.driver.hold_to(Terms(max_loss=0.2))
    assert driven.run(1.2, linear=0.2).source is Source.CLOUD
    driven.driver.quality = Quality(loss=0.3, lossy_topic="force")
    status = driven.run(0.6, linear=0.2)
    assert status.transitions[-1].reason is Reason.LOSS
    assert status.why == "30% of force lost, 20% at most"
    driven.driver.quality = Quality()
    assert driven.run(1.2, linear=0.2).source is Source.CLOUD
    driven.driver.quality = Quality(late=0.6, late_topic="scan")
    status = driven.run(0.6, linear=0.2)
    assert status.transitions[-1].reason is Reason.LATE
    assert status.why == "60% of scan too late, 50% at most"


def test_a_command_older_than_the_service_needs_is_not_followed(driven):
    driven.driver.hold_to(Terms(max_rtt_s=0.1))  # 0.25 s in all, with the time that a command may be repeated
    status = driven.run(0.3, linear=0.2, delay=0.26)
    assert status.objections["stale"] == 30
    assert status.transitions[-1].reason is Reason.NO_COMMAND
    assert driven.run(1.5, linear=0.2, delay=0.2).source is Source.CLOUD


HOUR_MS = 3_600_000.0


@pytest.mark.parametrize("asked", [1e9, 1e308])
def test_no_answer_of_the_orchestrator_lets_an_old_command_drive(driven, asked):
    """Every number of a session that reaches the control loop, as wide as it can be."""
    row = TopicSpec(name="cmd_vel", type=Twist.TYPE, direction="out", period_ms=HOUR_MS - 1, lifespan_ms=HOUR_MS)
    held_to = terms(Needs(max_rtt_ms=asked, max_loss=1.0), [row], "cmd_vel")
    driven.driver.hold_to(held_to)
    # The robot's own: 1 s of round trip, and the time that a command may be repeated.
    status = driven.run(0.5, linear=0.2, delay=3600.0)
    assert status.objections["stale"] == 50
    assert status.transitions[-1].reason is Reason.NO_COMMAND
    assert status.source is Source.FALLBACK
    driven.driver.quality = Quality(rtt=1.01)
    assert driven.run(2.0, linear=0.2, delay=0.2).source is not Source.CLOUD


def test_commands_stop_driving_after_the_robot_s_own_gap_whatever_period_a_manifest_has(driven):
    row = TopicSpec(name="cmd_vel", type=Twist.TYPE, direction="out", period_ms=HOUR_MS - 1)
    driven.driver.hold_to(terms(Needs(), [row], "cmd_vel"))
    driven.run(1.5, linear=0.2)
    status = driven.run(0.4)
    assert status.transitions[-1].reason is Reason.NO_COMMAND
    assert status.source is Source.FALLBACK


def test_commands_whose_age_is_not_known_well_enough_hand_over(driven):
    def send(now, **_):
        payload = encode(Twist(linear=Vector3(x=0.2)), "cdr")
        driven.cloud.session.deliver(MessageReceived("cmd_vel", payload, driven.cloud.sequence, now, 0.6, now))
        driven.cloud.sequence += 1

    driven.cloud.send = send
    assert driven.run(0.6, linear=0.2).transitions[-1].reason is Reason.CLOCK


def test_the_fallback_is_told_no_time_that_cannot_be(base, make_cloud):
    told = []

    class Asked(Stop):
        drives = True

        def step(self, velocity, readings, dt):
            told.append(dt)

    rig = Rig(base, make_cloud, fallback=Asked())
    for now in (100.01, 100.1, 101.0, 90.0, nan, 90.01):
        rig.driver.tick(now)
    assert told[:4] == [pytest.approx(0.01), VelocityLimits().max_step_s, pytest.approx(0.01), 0.0]
    assert all(0.0 <= dt <= VelocityLimits().max_step_s for dt in told)


def test_a_session_that_was_closed_is_not_connected(driven):
    driven.cloud.session.close()
    assert not driven.cloud.session.connected


def test_the_observer_sees_each_command_and_cannot_stop_the_robot(base, make_cloud, bridge):
    seen = []

    def observe(command, objection):
        seen.append((command.sequence, objection))
        raise RuntimeError

    rig = Rig(base, make_cloud, observer=observe)
    rig.connect(bridge)
    status = rig.run(1.5, linear=0.2)
    assert seen == [(i, None) for i in range(150)]
    assert status.commands == 150
    assert status.source is Source.CLOUD


def test_commands_that_came_while_the_loop_stood_still_are_all_counted(driven):
    before = driven.driver.status()
    for i in range(20):
        driven.cloud.send(driven.now + i / 100)
    driven.now += 0.2
    status = driven.run(0.01)
    assert (status.commands - before.commands, status.missed_commands) == (16, 4)


def test_halt_writes_zero(driven):
    driven.driver.halt()
    assert driven.base.velocity == (0.0, 0.0)
    assert driven.driver.status().velocity == Velocity(0.0, 0.0)


def test_only_what_the_service_takes_is_sent(rig, bridge):
    rig.connect(bridge)
    rig.driver.session.publish("diary", WrenchStamped())
    assert bridge.published == []


def test_what_else_the_service_sends_is_not_a_command(rig, bridge):
    rig.connect(bridge)
    message = encode(Twist(linear=Vector3(x=0.2)), "cdr")
    rig.cloud.session.deliver(type("M", (), {"topic": "path", "payload": message})())
    assert rig.cloud.session.drain_commands() == []


class Watcher(Stop):
    """A fallback that has eyes, and that may fail to look."""

    drives = True

    def __init__(self):
        self.seen = []

    def watch(self, velocity, readings, dt):
        self.seen.append((velocity, set(readings), dt))
        if len(self.seen) > 200:
            raise ZeroDivisionError


def test_a_fallback_may_watch_while_the_cloud_drives_and_its_mistakes_stop_nobody(base, make_cloud, bridge):
    watcher = Watcher()
    rig = Rig(base, make_cloud, fallback=watcher)
    rig.connect(bridge)
    status = rig.run(3.0, linear=0.2)
    assert status.source is Source.CLOUD
    assert watcher.seen[150] == (pytest.approx((0.2, 0.1)), {"force"}, pytest.approx(TICK))
    assert status.errors == {"fallback": 100}
    assert base.velocity[0] == pytest.approx(0.2)
