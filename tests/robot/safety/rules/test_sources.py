"""Who drives, with made-up time: sequences of presses, losses, resets, locks and commands, against plain oracles."""

from dataclasses import dataclass, field, replace
from itertools import pairwise
from math import inf, nan

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skytether.control.admittance import STANDSTILL, Velocity
from skytether.messages import Bool, Header, Joy, Time, Twist, TwistStamped, Vector3
from skytether.robot.control import restart_interlock
from skytether.robot.control.command import Command, Hand
from skytether.robot.control.restart_interlock import NEUTRAL_S
from skytether.robot.control.supervisor import VelocityLimits
from skytether.robot.safety.geometry.footprint import circle
from skytether.robot.safety.rules import joystick
from skytether.robot.safety.rules.estop import ButtonParams
from skytether.robot.safety.rules.joystick import RELEASED_S, Grip, Joystick, JoystickParams
from skytether.robot.safety.rules.rules import Gate, GateDecision, Rules
from skytether.robot.safety.rules.sources import LockParams, OnSilence, SourceParams, SourceRules
from skytether.robot.safety.sensing.coverage import Action, UnseenParams

PERIOD = 0.01
TIMEOUT = 0.5
"""Of the source that is looked at."""
LIMITS = VelocityLimits(linear_max=0.5, linear_min=-0.2, angular_max=1.0)
PAD = JoystickParams(deadman=0, linear_axis=0, angular_axis=1, linear=0.2, angular=0.4, deadzone=0.0)
NAVIGATION, KEYBOARD = SourceParams("navigation", 20, 0.5), SourceParams("keyboard", 50, 0.3, stamped=True)
RULES = Rules(
    footprint=circle(0.3),
    limits=LIMITS,
    unseen=UnseenParams(Action.FREE),  # it has no sensors
    sources=SourceRules(
        joystick=PAD,
        further={"nav_vel": NAVIGATION, "key_vel": KEYBOARD},
        locks={"pause": LockParams("pause", 30), "gone": LockParams("gone", 200, inf)},
        button=ButtonParams(),
    ),
)


def joy(*axes: float, held: bool = True) -> Joy:
    return Joy(axes=np.array(axes, dtype=np.float32), buttons=np.array([held], dtype=np.int32))


def twist(linear: float, angular: float = 0.0) -> Twist:
    return Twist(linear=Vector3(x=linear), angular=Vector3(z=angular))


@dataclass
class Bench:
    """A robot in an empty hall; what is in ``says`` is said at every turn."""

    rules: Rules = RULES
    now: float = 100.0
    sequence: int = 0
    agent: float | None = 0.0
    says: dict[str, object] = field(default_factory=dict)
    held: float | None = None
    """How far the stick is pushed, button held, by a hand that is never quite still."""

    def __post_init__(self) -> None:
        self.gate = Gate(self.rules)
        self.says = {"estop": Bool(), "pause": Bool(), "gone": Bool(), "joy": joy(0.0, 0.0, held=False)}
        self.run(0.3)

    def run(self, seconds: float = PERIOD) -> GateDecision:
        for _ in range(round(seconds / PERIOD)):
            self.now += PERIOD
            self.sequence += 1
            for topic, message in self.says.items():
                if topic == "joy" and self.held is not None:
                    message = joy(self.held, 0.0, 0.001 * (self.sequence % 2))
                self.gate.sense(topic, message, self.now)
            if self.agent is not None:
                self.gate.command(
                    Command(Hand.AGENT, self.agent, 0.0, 1, self.sequence, self.now, 0.0, self.now), self.now
                )
            self.last = self.gate.step(self.now)
        return self.last

    @property
    def wheels(self) -> float:
        return self.last.velocity.linear


# --- The joystick ---------------------------------------------------------------------------------------------------

events = st.lists(
    st.tuples(
        st.sampled_from(["up", "down", "moved", "repeat", "wait", "short"]),
        st.sampled_from([0.01, 0.05, 0.1, 0.2, 0.29, 0.31, 0.6, 1.1]),
    ),
    max_size=40,
)


@settings(max_examples=300, deadline=None)
@given(events)
def test_no_sequence_lets_a_joystick_drive_that_was_not_seen_released_since_it_was_lost(sequence):
    """The oracle keeps the whole history, and looks back from each moment that the joystick drives."""
    state, now, moved = Joystick(), 10.0, 0.0
    history: list[tuple[float, str]] = []  # what was heard or happened, and when
    newest = joy(0.0, 0.0, held=False)
    for what, then in sequence:
        now += then
        if what == "wait":
            state = joystick.expire(PAD, state, now)
        else:
            if what == "moved":
                moved += 0.01
                newest = joy(0.5 + moved % 0.5, 0.0)
            elif what == "up":
                newest = joy(0.0, 0.0, held=False)
            elif what == "down":
                newest = joy(0.5, 0.0)
            message = Joy() if what == "short" else newest
            state, _ = joystick.on_message(PAD, state, message, now)
            if what != "short":
                history.append((now, "held" if newest.buttons[0] else "up"))
        if state.grip is Grip.LOST and (not history or history[-1][1] != "lost"):
            history.append((now, "lost"))
        if state.grip is Grip.HELD:
            assert _was_released(history)


def _was_released(history: list[tuple[float, str]]) -> bool:
    """The present press began after the button was seen up; after the first start or a loss, for long enough."""
    presses = [k for k, (_, what) in enumerate(history) if what == "held"]
    since = max((k for k, (_, what) in enumerate(history) if what == "lost"), default=-1)
    for k in presses:
        if k <= since:
            continue
        ups = [j for j in range(since + 1, k) if history[j][1] == "up"]
        if not ups:
            continue
        first = ups[-1]
        while first - 1 > since and history[first - 1][1] == "up":
            first -= 1
        if history[k][0] - history[first][0] >= RELEASED_S - 1e-9:
            return True
    return False


def test_a_silence_that_a_message_ends_was_one_all_the_same():
    """The gate was frozen while the joystick was silent: nothing looked at it in between."""
    held, _ = joystick.on_message(PAD, Joystick(seen_released=True), joy(1.0, 0.0), 1.0)
    assert joystick.on_message(PAD, held, joy(1.0, 0.0), 3.0)[0].grip is Grip.LOST


def test_what_waited_in_a_queue_is_no_release_and_press_of_now():
    state = Joystick(grip=Grip.LOST, lost="fell silent")
    for held in (False, True):
        state, _ = joystick.on_message(PAD, state, joy(1.0, 0.0, held=held), 5.0)
    assert state.grip is Grip.UNSURE
    state, _ = joystick.on_message(PAD, state, joy(1.0, 0.0, held=False), 5.1)
    state, _ = joystick.on_message(PAD, state, joy(1.0, 0.0), 5.35)
    assert state.grip is Grip.HELD


def test_a_driver_that_repeats_itself_when_the_radio_is_gone_drives_for_a_second_at_most():
    """joy_node's autorepeat; that it stamps each repeat anew changes nothing."""
    state, driven = Joystick(seen_released=True), 0.0
    for k in range(100):
        repeat = replace(joy(1.0, 0.0), header=Header(stamp=Time(sec=k)))
        state, _ = joystick.on_message(PAD, state, repeat, 10 + k * 0.05)
        driven += 0.05 if state.wanted != STANDSTILL else 0.0
    assert state.grip is Grip.LOST
    assert "says the same for 1 s" in state.lost
    assert 0.9 <= driven <= 1.1


def test_a_hand_that_is_not_quite_still_and_a_cable_drive_on():
    state = Joystick(seen_released=True)
    for k in range(200):
        state, _ = joystick.on_message(PAD, state, joy(1.0, 0.0, 0.01 * (k // 10 % 2)), 10 + k * 0.05)
    assert state.grip is Grip.HELD
    cable, state = replace(PAD, max_still_s=inf), Joystick(seen_released=True)
    for k in range(200):
        state, _ = joystick.on_message(cable, state, joy(1.0, 0.0), 10 + k * 0.05)
    assert state.grip is Grip.HELD


def test_a_stick_in_its_middle_may_be_still():
    state = Joystick(seen_released=True)
    for k in range(200):
        state, _ = joystick.on_message(PAD, state, joy(0.0, 0.0), 10 + k * 0.05)
    assert (state.grip, state.wanted) == (Grip.HELD, STANDSTILL)


@pytest.mark.parametrize(("axis", "share"), [(0.09, 0.0), (-0.09, 0.0), (0.55, 0.5), (1.0, 1.0), (-1.0, -1.0)])
def test_the_dead_zone_ends_without_a_jump(axis, share):
    # Beyond 0.1 the rest of the axis, 0.9 long, goes from nothing to everything.
    state, _ = joystick.on_message(replace(PAD, deadzone=0.1), Joystick(seen_released=True), joy(axis, 0.0), 1.0)
    assert state.wanted.linear == pytest.approx(0.2 * share)


def test_a_button_that_is_down_at_the_start_holds_the_robot_until_it_is_let_go():
    bench = Bench()
    bench.gate = Gate(RULES)
    bench.held, bench.agent = 1.0, None
    assert bench.run(1.0).velocity == STANDSTILL
    assert "let it go, then press" in bench.last.troubles["joystick"]
    bench.held = None
    bench.run(0.3)
    bench.held = 1.0
    assert bench.run(0.5).hand == Hand.JOYSTICK
    assert bench.wheels == pytest.approx(0.2)


# --- No motion by itself --------------------------------------------------------------------------------------------


@settings(max_examples=200, deadline=None)
@given(st.lists(st.tuples(st.sampled_from([0.0, 0.0005, 0.0, 0.2]), st.sampled_from([0.02, 0.06, 0.1, 0.3, 0.6]))))
def test_a_source_is_neutral_when_it_said_nothing_else_for_long_enough(wants):
    """The oracle looks back from each message: how much of the time since the last other one, or silence, was said."""
    state, now, heard, free = restart_interlock.require("a reset"), 10.0, [], False
    for value, then in wants:
        now += then
        if abs(value) > 0.001 or then > TIMEOUT:
            heard = []
        if abs(value) <= 0.001:
            heard.append(now)
        free = free or sum(min(0.1, later - earlier) for earlier, later in pairwise(heard)) >= NEUTRAL_S - 1e-6
        state = restart_interlock.want(state, Velocity(value, 0.0), now, TIMEOUT)
        assert (not state.why) is free


@pytest.mark.parametrize(("rate_hz", "messages"), [(50, 11), (20, 5), (10, 3), (5, 3), (2.5, 3)])
def test_how_many_messages_make_a_source_neutral(rate_hz, messages):
    state = restart_interlock.require("a reset")
    for k in range(messages):
        assert state.why
        state = restart_interlock.want(state, STANDSTILL, 10.0 + k / rate_hz, TIMEOUT)
    assert not state.why


def test_a_standstill_that_nobody_wants_is_not_neutral():
    """An agent that hung, or whose service is not heard, says it for want of a better word."""
    state = restart_interlock.require("a reset")
    for turn in range(100):
        state = restart_interlock.want(state, STANDSTILL, 10.0 + 0.02 * turn, TIMEOUT, decided=False)
        assert state.why
    for at, decided in ((20.0, True), (20.1, False), (20.15, True), (20.25, True)):
        state = restart_interlock.want(state, STANDSTILL, at, TIMEOUT, decided)
        assert state.why
    assert not restart_interlock.want(state, STANDSTILL, 20.35, TIMEOUT).why


@pytest.mark.parametrize("now", [inf, -inf, nan])
def test_a_clock_that_is_no_number_makes_nobody_neutral(now):
    state = restart_interlock.require("a reset")
    for when in (10.0, 10.09, now, now, 10.09, now):
        state = restart_interlock.want(state, STANDSTILL, when, TIMEOUT)
        assert state.why
    up, _ = joystick.on_message(PAD, Joystick(), joy(0.0, 0.0, held=False), 10.0)
    assert joystick.on_message(PAD, up, joy(1.0, 0.0), now)[0].grip is not Grip.HELD


@pytest.mark.parametrize(("said_s", "silent_s"), [(0.12, 0.14), (0.12, 0.44), (0.02, 0.4)])
def test_a_standstill_that_is_only_held_is_not_wanted(said_s, silent_s):
    """Within its timeout (0.5 s) such a source counts as wanting a standstill, but it does not say so."""
    bench = Bench()
    bench.says["nav_vel"] = twist(0.3)
    bench.run(0.5)
    bench.says["nav_vel"] = twist(0.0)
    bench.run(said_s)
    del bench.says["nav_vel"]
    bench.run(silent_s)
    bench.says["nav_vel"] = twist(0.3)
    assert bench.run(1.0).velocity == STANDSTILL
    assert "navigation" in bench.gate.waiting
    bench.says["nav_vel"] = twist(0.0)
    bench.run(0.24)
    bench.says["nav_vel"] = twist(0.3)
    bench.run(1.5)
    assert bench.wheels == pytest.approx(0.3)


def test_a_standstill_before_a_silence_does_not_count_after_it():
    bench = Bench()
    bench.says["nav_vel"] = twist(0.0)
    bench.run(0.1)
    del bench.says["nav_vel"]
    bench.run(0.6)
    bench.says["nav_vel"] = twist(0.0)
    bench.run(0.1)
    bench.says["nav_vel"] = twist(0.3)
    assert bench.run(1.0).velocity == STANDSTILL


def test_a_gate_that_was_started_lets_nobody_go_on_with_what_was_before():
    gate, now = Gate(replace(RULES, sources=SourceRules())), 50.0
    for k in range(100):
        now += PERIOD
        gate.command(Command(Hand.AGENT, 0.3, 0.0, 1, k, now, 0.0, now), now)
        decision = gate.step(now)
        assert decision.velocity == STANDSTILL
    assert "since the gate was started" in decision.troubles["agent:neutral"]


def test_after_a_lost_joystick_the_agent_does_not_go_on_by_itself_however_long_it_was_neutral_meanwhile():
    bench = Bench()
    bench.held = 1.0
    bench.run(0.5)
    del bench.says["joy"]
    bench.run(2.0)
    bench.agent = 0.3
    assert bench.gate.start(bench.now)[1].startswith("the joystick is lost")
    bench.says["joy"], bench.held = joy(0.0, 0.0, held=False), None
    assert bench.run(2.0).velocity == STANDSTILL
    assert not bench.gate.started
    assert bench.gate.start(bench.now) == (["agent"], "")
    bench.run(1.0)
    assert bench.wheels == pytest.approx(0.3)
    assert bench.gate.started
    bench.gate.engage("a test")
    bench.gate.reset(bench.now)
    assert not bench.gate.started


def test_start_lets_go_on_who_speaks_now_and_nobody_who_comes_later():
    bench = Bench()
    bench.gate.engage("a test")
    bench.run()
    bench.gate.reset(bench.now)
    bench.agent = None
    bench.run(0.5)
    assert bench.gate.start(bench.now) == ([], "")
    bench.agent = 0.3
    assert bench.run(1.0).velocity == STANDSTILL


@pytest.mark.parametrize("on_silence", OnSilence)
def test_a_button_that_returns(on_silence):
    bench = Bench(replace(RULES, sources=replace(RULES.sources, on_silence=on_silence)))
    bench.agent = 0.3
    bench.run(1.0)
    assert bench.wheels == pytest.approx(0.3)
    button = bench.says.pop("estop")
    assert bench.run(1.5).velocity == STANDSTILL
    bench.says["estop"] = button
    bench.run(1.0)
    assert bench.wheels == pytest.approx(0.3 if on_silence is OnSilence.STOP else 0.0)
    assert bool(bench.gate.stopped) is (on_silence is OnSilence.LATCH)
    bench.gate.reset(bench.now)
    assert bench.gate.start(bench.now)[1] == ""
    bench.run(1.0)
    assert bench.wheels == pytest.approx(0.3)


@pytest.mark.parametrize("on_silence", OnSilence)
def test_after_a_gap_the_button_is_to_be_heard_anew(on_silence):
    bench = Bench(replace(RULES, sources=replace(RULES.sources, on_silence=on_silence)), agent=0.2)
    bench.gate.start(bench.now)
    assert bench.run(0.5).velocity.linear == pytest.approx(0.2)
    bench.now += 0.3
    bench.gate.rebase(STANDSTILL, bench.now)
    bench.gate.stalled(bench.now)
    for _ in range(8):  # what waited in the socket says that it is up
        assert bench.run().velocity == STANDSTILL
    assert "since the gate stood still" in bench.run().troubles["button"]
    assert "not heard" in bench.gate.refuses_reset(bench.now)
    assert bench.run(0.5).velocity.linear == pytest.approx(0.2)  # it was heard, and nothing else is asked for
    assert bench.gate.stopped == ""


def test_after_a_gap_a_press_that_waited_counts_and_a_command_that_waited_does_not():
    bench = Bench(agent=None)
    bench.says["nav_vel"] = twist(0.2)
    bench.gate.start(bench.now)
    bench.run(0.1)
    bench.gate.start(bench.now)
    assert bench.run(0.5).velocity.linear == pytest.approx(0.2)
    bench.says = {"nav_vel": twist(0.2)}
    bench.now += 2.0
    bench.gate.rebase(STANDSTILL, bench.now)
    bench.gate.stalled(bench.now)
    bench.gate.sense("estop", Bool(True), bench.now)
    assert bench.run(0.05).hand == Hand.NOBODY
    assert "pressed" in bench.gate.stopped
    bench.says = {"estop": Bool(False)}
    bench.run(TIMEOUT - 0.1)
    assert bench.gate.reset(bench.now) == ""
    assert bench.gate.start(bench.now) == ([], ""), "nobody was heard who could be let go on"


def test_a_button_that_speaks_only_when_it_changes_is_not_waited_for():
    sources = replace(RULES.sources, button=ButtonParams(max_age_s=inf))
    bench = Bench(replace(RULES, sources=sources), agent=0.2)
    bench.gate.start(bench.now)
    bench.says.pop("estop")
    bench.run(0.3)
    bench.gate.stalled(bench.now)
    assert bench.run(0.3).velocity.linear > 0


@pytest.mark.parametrize("on_silence", OnSilence)
def test_a_button_that_returns_while_a_stick_is_pushed(on_silence):
    """The joystick is one of those who drive: held meanwhile, it must be let go and pressed anew."""
    bench = Bench(replace(RULES, sources=replace(RULES.sources, on_silence=on_silence)))
    bench.held = 1.0
    bench.run(1.0)
    assert bench.wheels == pytest.approx(0.2)
    button = bench.says.pop("estop")
    assert bench.run(1.5).velocity == STANDSTILL
    bench.says["estop"] = button
    bench.run(1.0)
    assert bench.wheels == pytest.approx(0.2 if on_silence is OnSilence.STOP else 0.0)
    bench.gate.reset(bench.now)
    bench.held = None
    bench.run(0.3)
    bench.held = 1.0
    bench.run(1.0)
    assert bench.wheels == pytest.approx(0.2)


def test_a_button_that_was_never_heard_does_not_latch():
    bench = Bench(replace(RULES, sources=replace(RULES.sources, on_silence=OnSilence.LATCH)))
    bench.gate = Gate(bench.rules)
    button = bench.says.pop("estop")
    assert "not heard" in bench.run(1.0).troubles["button"]
    assert not bench.gate.stopped
    bench.says["estop"] = button
    assert not bench.run(1.0).troubles


# --- The order of the sources ---------------------------------------------------------------------------------------


def stamped(linear: float, at: float) -> TwistStamped:
    return TwistStamped(header=Header(stamp=Time(sec=int(at), nanosec=round(at % 1 * 1e9))), twist=twist(linear))


def test_the_highest_that_wants_to_drives_and_gives_back_when_it_falls_silent():
    bench = Bench()
    bench.agent = 0.3
    assert bench.run(0.5).hand == Hand.AGENT
    bench.says["nav_vel"] = twist(0.0)
    bench.run(0.3)
    bench.says["nav_vel"] = twist(-0.1)
    assert bench.run(1.0).hand == "navigation"
    assert bench.wheels == pytest.approx(-0.1)
    for _ in range(30):
        bench.gate.sense("key_vel", stamped(0.0, bench.now), bench.now)
        bench.run()
    for _ in range(60):
        bench.gate.sense("key_vel", stamped(0.4, bench.now), bench.now)
        bench.run()
    assert (bench.last.hand, bench.wheels) == ("keyboard", pytest.approx(0.4))
    bench.held = 1.0
    assert bench.run(0.5).hand == Hand.JOYSTICK
    bench.held = None
    assert bench.run(0.5).hand == "navigation"  # the keyboard has been silent for 0.5 s
    del bench.says["nav_vel"]
    bench.run(0.48)
    assert bench.last.hand == "navigation"
    assert bench.run(0.05).hand == Hand.AGENT


def test_a_source_that_sends_one_stamp_again_and_again_is_silent():
    bench = Bench()
    bench.agent = None
    for _ in range(30):
        bench.gate.sense("key_vel", stamped(0.0, bench.now), bench.now)
        bench.run()
    bench.says["key_vel"] = stamped(0.4, bench.now + 8.0)
    bench.run(0.1)
    assert bench.wheels > 0
    assert bench.run(1.0).velocity == STANDSTILL
    assert "sends the same command again" in bench.last.troubles["key_vel:message"]


@pytest.mark.parametrize("count", [2, 3])
def test_old_commands_that_take_turns_are_silence(count):
    """Of a stamped source: what a hanging relay sends again and again."""
    bench = Bench()
    bench.agent = None
    for _ in range(30):
        bench.gate.sense("key_vel", stamped(0.0, bench.now + 1000.0), bench.now)
        bench.run()
    old = [stamped(0.4, bench.now + 1000.0 + 0.001 * number) for number in range(count)]
    for turn in range(150):
        bench.gate.sense("key_vel", old[turn % count], bench.now)
        bench.run()
    assert bench.wheels == 0
    for _ in range(200):  # its clock was set back, and goes on
        bench.gate.sense("key_vel", stamped(0.4, bench.now + 1.0), bench.now)
        bench.run()
    assert bench.wheels > 0


@pytest.mark.parametrize(
    "bad", [twist(float("nan")), twist(0.1, inf), Bool(data=True), joy(1.0), Twist(linear=Vector3(y=0.2))]
)
def test_a_command_that_is_none_is_named_and_not_followed(bad):
    bench = Bench()
    bench.says["nav_vel"] = bad
    bench.run(1.0)
    assert bench.last.hand == Hand.AGENT
    assert any("nav" in kind for kind in bench.last.troubles)


def test_a_lock_blocks_all_below_it_and_so_does_its_silence():
    bench = Bench()
    bench.agent = 0.3
    bench.run(0.5)
    bench.says["pause"] = Bool(data=True)
    assert bench.run(0.5).velocity == STANDSTILL
    assert "pause says so" in bench.last.troubles["lock:pause"]
    bench.held = 1.0
    assert bench.run(0.5).hand == Hand.JOYSTICK  # 100 is above 30
    bench.held = None
    bench.says["pause"] = Bool()
    bench.run(1.0)
    assert bench.wheels == pytest.approx(0.3)
    del bench.says["pause"]
    assert bench.run(2.0).velocity == STANDSTILL
    assert "pause is not heard" in bench.last.troubles["lock:pause"]


def test_a_lock_that_speaks_only_when_it_changes_is_heard_once():
    bench = Bench()
    bench.agent = 0.3
    del bench.says["gone"]
    bench.run(3.0)
    assert bench.wheels == pytest.approx(0.3)
    never = Bench()
    never.gate, never.agent = Gate(RULES), 0.0
    del never.says["gone"]
    never.run(0.5)
    never.agent, never.held = 0.3, 1.0
    assert never.run(1.0).velocity == STANDSTILL  # 200 is above everybody


def test_an_emergency_stop_is_above_all():
    bench = Bench()
    bench.held = 1.0
    bench.run(0.5)
    bench.gate.engage("a test")
    assert bench.run(0.5).velocity == STANDSTILL
    assert bench.last.hand == Hand.NOBODY


wishes = st.lists(
    st.tuples(
        st.sampled_from(["agent", "nav_vel", "key_vel", "held", "pause", "gone", "estop", "reset", "start", "silent"]),
        st.sampled_from([0.0, 0.0, 0.3, -0.2, 5.0, -5.0]),
        st.integers(1, 40),
    ),
    max_size=30,
)


@settings(max_examples=20, deadline=None)
@given(wishes)
def test_no_change_of_source_jumps_and_nobody_drives_who_may_not(sequence):
    bench = Bench()
    for what, value, turns in sequence:
        if what == "agent":
            bench.agent = value
        elif what == "held":
            bench.held = value or None
        elif what in ("pause", "gone", "estop"):
            bench.says[what] = Bool(data=value > 0)
        elif what == "reset":
            bench.gate.reset(bench.now)
        elif what == "start":
            bench.gate.start(bench.now)
        elif what == "silent":
            bench.agent = None
            bench.says.pop("nav_vel", None)
        elif what == "nav_vel":
            bench.says[what] = twist(value)
        for _ in range(turns):
            if what == "key_vel":
                bench.gate.sense("key_vel", stamped(value, bench.now), bench.now)
            before = bench.last.velocity
            bench.run()
            _no_jump(before, bench.last.velocity)
            _in_order(bench)


def _no_jump(before: Velocity, after: Velocity) -> None:
    assert abs(after.linear - before.linear) <= LIMITS.linear_braking * PERIOD + 1e-9
    if abs(after.linear) > abs(before.linear) and after.linear * before.linear >= 0:
        assert abs(after.linear - before.linear) <= LIMITS.linear_acceleration * PERIOD + 1e-9


def _in_order(bench: Bench) -> None:
    hand, locked = bench.last.hand, [bench.says[name].data for name in ("pause", "gone")]
    priority = {Hand.AGENT: 10, "navigation": 20, "keyboard": 50, Hand.JOYSTICK: 100, Hand.NOBODY: inf}[hand]
    assert not (locked[0] and priority < 30) or hand == Hand.NOBODY
    assert not locked[1] or hand == Hand.NOBODY
    assert not bench.gate.stopped or hand == Hand.NOBODY
    if hand != Hand.NOBODY and hand != Hand.JOYSTICK:
        assert hand not in bench.gate.waiting


def test_a_further_source_that_wants_to_go_sideways_is_refused_by_name_and_not_in_part():
    bench = Bench()
    bench.says["nav_vel"] = twist(0.0)
    bench.run(0.5)
    bench.says["nav_vel"] = Twist(linear=Vector3(x=0.2, y=0.1))
    for _ in range(20):
        decision = bench.run()
        assert decision.velocity == STANDSTILL
        assert "linear.y" in decision.troubles["command:navigation:unused_axes"]
    assert bench.gate.counts["command:navigation:unused_axes"] == 20
    bench.says["nav_vel"] = twist(0.2)
    assert bench.run(0.5).velocity.linear == pytest.approx(0.2)
