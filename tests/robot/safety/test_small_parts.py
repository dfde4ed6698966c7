import threading
from math import inf, nan
from types import SimpleNamespace

import numpy as np
import pytest

from skytether.control.admittance import STANDSTILL, Velocity
from skytether.guard.protocol import STOP_SOCKET
from skytether.guard.requests import Requests
from skytether.messages import Joy, Twist, Vector3
from skytether.robot.agent.gated_hardware import GatedHardware
from skytether.robot.control.supervisor import VelocityLimits
from skytether.robot.safety.client import GateLink, stop
from skytether.robot.safety.geometry import kinematics
from skytether.robot.safety.rules import estop, joystick
from skytether.robot.safety.rules.estop import ButtonParams, Estop
from skytether.robot.safety.rules.joystick import Grip, Joystick, JoystickParams

LIMITS = VelocityLimits()  # accelerates 1 m/s^2 and 2 rad/s^2, brakes 2 m/s^2 and 4 rad/s^2
PAD = JoystickParams(deadman=1, linear_axis=1, angular_axis=0, linear=0.2, angular=0.4, deadzone=0.0, max_age_s=0.3)
RELEASED = Joystick(seen_released=True)


def joy(axes, buttons) -> Joy:
    return Joy(axes=np.array(axes, dtype=np.float32), buttons=np.array(buttons, dtype=np.int32))


def test_the_slowest_axis_says_how_fast_a_curve_can_be_left():
    # 0.2 m/s at 2 m/s^2: 10 per second; 0.5 rad/s at 4 rad/s^2: 8 per second.
    assert kinematics.slowdown(LIMITS, Velocity(0.2, 0.0)) == pytest.approx(10.0)
    assert kinematics.slowdown(LIMITS, Velocity(-0.2, 0.5)) == pytest.approx(8.0)
    assert kinematics.slowdown(LIMITS, STANDSTILL) == inf


def test_braking_keeps_the_curvature():
    # 8 per second over 10 ms: 92 % is left of both.
    assert kinematics.brake_on_curve(LIMITS, Velocity(0.2, 0.5), 0.01) == pytest.approx((0.184, 0.46))
    assert kinematics.brake_on_curve(LIMITS, Velocity(0.2, 0.5), 0.2) == STANDSTILL
    assert kinematics.brake_on_curve(LIMITS, STANDSTILL, 0.2) == STANDSTILL


@pytest.mark.parametrize(
    ("before", "after", "reached"),
    [
        ((0.1, 0.0), (0.11, 0.0), True),
        ((0.1, 0.0), (0.12, 0.0), False),  # 1 m/s^2 over 10 ms is 0.01
        ((0.1, 0.0), (0.08, 0.0), True),  # braking is 0.02
        ((0.1, 0.0), (0.07, 0.0), False),
        ((-0.1, 0.0), (-0.12, 0.0), False),
        ((-0.1, 0.0), (-0.08, 0.0), True),
        ((0.01, 0.0), (-0.005, 0.0), True),  # 5 ms to zero, 5 ms on
        ((0.01, 0.0), (-0.006, 0.0), False),
        ((0.1, 0.3), (0.1, 0.33), False),  # 2 rad/s^2: 0.02
        ((0.1, 0.3), (0.1, 0.26), True),  # 4 rad/s^2: 0.04
    ],
)
def test_what_the_wheels_can_reach_in_one_tick(before, after, reached):
    assert kinematics.within_reach(LIMITS, Velocity(*before), Velocity(*after), 0.01) is reached


def test_a_held_button_drives_and_letting_go_gives_back():
    state, wrong = joystick.on_message(PAD, RELEASED, joy([0.5, 1.0], [0, 1]), 1.0)
    assert (state.grip, wrong) == (Grip.HELD, "")
    assert state.wanted == pytest.approx((0.2, 0.2))  # full forward, half left
    assert joystick.expire(PAD, state, 1.29).grip is Grip.HELD
    state, _ = joystick.on_message(PAD, state, joy([0.5, 1.0], [0, 0]), 1.4)
    assert (state.grip, state.wanted) == (Grip.OFF, STANDSTILL)


@pytest.mark.parametrize("now", [1.31, 0.69, nan, inf, -inf])
def test_a_held_joystick_that_falls_silent_is_lost_until_it_is_heard_with_the_button_up(now):
    held, _ = joystick.on_message(PAD, RELEASED, joy([0, 1], [0, 1]), 1.0)
    lost = joystick.expire(PAD, held, now)
    assert (lost.grip, lost.wanted) == (Grip.LOST, STANDSTILL)
    assert joystick.expire(PAD, lost, 1.0) == lost  # time alone does not give it back
    again, _ = joystick.on_message(PAD, lost, joy([0, 0], [0, 0]), 5.0)
    assert again.grip is Grip.OFF


def test_a_joystick_that_was_not_held_may_be_silent():
    assert joystick.expire(PAD, Joystick(), 1e6).grip is Grip.OFF


@pytest.mark.parametrize(
    ("message", "grip", "says"),
    [
        (joy([0, 0], []), Grip.OFF, "0 buttons"),
        (joy([0], [0, 1]), Grip.HELD, "1 axes"),
        (joy([0, nan], [0, 1]), Grip.HELD, "no number"),
        (joy([inf, 0], [0, 1]), Grip.HELD, "no number"),
    ],
)
def test_a_joystick_of_another_make_drives_nothing(message, grip, says):
    state, wrong = joystick.on_message(PAD, RELEASED, message, 1.0)
    assert (state.grip, state.wanted) == (grip, STANDSTILL)
    assert says in wrong


def test_axes_beyond_their_end_are_at_their_end():
    state, _ = joystick.on_message(PAD, RELEASED, joy([-7, 3], [0, 1]), 1.0)
    assert state.wanted == pytest.approx((0.2, -0.4))


def test_the_first_reason_of_an_emergency_stop_is_kept_until_reset():
    state = estop.engage(estop.engage(Estop(), "a person said so"), "another did")
    assert state.reason == "a person said so"
    assert estop.reset(None, state, 0.0) == (Estop(), "")


def test_a_pressed_button_latches_and_is_not_reset_while_pressed():
    button = ButtonParams(pressed_is=True, max_age_s=0.5)
    state = estop.on_button(button, Estop(), True, 1.0)
    assert "button was pressed" in state.reason
    assert "still pressed" in estop.reset(button, state, 1.1)[1]
    state = estop.on_button(button, state, False, 1.2)
    assert state.reason  # letting go is not enough
    assert "not heard" in estop.reset(button, state, 1.8)[1]
    state, refused = estop.reset(button, state, 1.3)
    assert (state.reason, refused) == ("", "")


def test_a_circuit_that_opens_is_pressed_when_false():
    button = ButtonParams(pressed_is=False)
    assert estop.on_button(button, Estop(), False, 0.0).reason
    assert not estop.on_button(button, Estop(), True, 0.0).reason


@pytest.mark.parametrize(
    ("now", "silent"), [(1.5, False), (1.51, True), (0.97, False), (0.9, True), (nan, True), (inf, True)]
)
def test_a_button_is_silent_when_it_is_not_heard(now, silent):
    assert estop.silent(ButtonParams(max_age_s=0.5), Estop(heard_at=1.0), now) is silent
    assert estop.silent(ButtonParams(max_age_s=0.5), Estop(), now) is True


def test_a_button_that_speaks_only_when_it_changes_is_never_silent_once_heard():
    assert estop.silent(ButtonParams(max_age_s=inf), Estop(heard_at=1.0), 1e6) is False
    assert estop.silent(ButtonParams(max_age_s=inf), Estop(), 1e6) is True


def test_the_agents_wheels_are_not_asked_for_what_they_do_not_have(tmp_path):
    base = GatedHardware(SimpleNamespace(topics={}), link := GateLink(tmp_path))
    link.close()
    with pytest.raises(ValueError, match=r"linear\.y, linear\.z, angular\.x, angular\.y cannot be asked"):
        base.write(Twist(linear=Vector3(x=0.1, y=0.1)))


@pytest.mark.parametrize("letter", ["\U0001f525", "\x00", "\ud800", '"', "\u2028", "\x1b"])
def test_no_reason_keeps_a_stop_from_being_read(tmp_path, letter):
    """Five hundred flames were 6 kB of JSON, of which 4 kB were read: the stop was refused."""
    asked = []
    requests = Requests(str(tmp_path / STOP_SOCKET), lambda request: asked.append(request) or {})
    ended = threading.Event()

    def run():
        while not ended.wait(0.002):
            requests.turn()

    thread = threading.Thread(target=run)
    thread.start()
    try:
        assert stop(tmp_path, letter * 1000, 30.0) == {}
    finally:
        ended.set()
        thread.join()
        requests.close()
    assert asked == [{"do": "stop", "reason": (letter if letter != "\ud800" else "?") * 500}]
