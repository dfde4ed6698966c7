"""What is shown of the gate: the picture says what the rule says, and showing it costs the gate nothing."""

import os
import socket
from contextlib import closing
from math import inf

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from skytether.control.admittance import STANDSTILL, Velocity
from skytether.guard.mailbox import bind
from skytether.messages import MarkerArray, decode, encode
from skytether.robot.safety.config.protected import protected_names
from skytether.robot.safety.config.safety_config import SafetyConfig
from skytether.robot.safety.display import markers as drawing
from skytether.robot.safety.display.feed import Feed
from skytether.robot.safety.display.markers import Id, markers, silence, state
from skytether.robot.safety.display.picture import picture
from skytether.robot.safety.display.process import Display
from skytether.robot.safety.display.snapshot import LARGEST, MOST_POINTS, Snapshot, pack, unpack
from skytether.robot.safety.geometry.dead_reckoning import Variation
from skytether.robot.safety.rules.modes import Envelope, Modes
from skytether.robot.safety.rules.places import Places
from skytether.robot.safety.rules.zones import Asked, Zone

SECTION = {
    "footprint": {"polygon": [[0.35, 0.25], [0.35, -0.25], [-0.3, -0.25], [-0.3, 0.25]]},
    "sensors": {"scan": {}},
}
MODES = {"modes": {"loaded": {"footprint": {"polygon": [[0.6, 0.3], [0.6, -0.3], [-0.3, -0.3], [-0.3, 0.3]]}}}}
ON_A_GRAPH = SECTION | {"ros1": {"namespace": "/walker"}, "display": {}}
STEADY = Variation(0.0, 0.0)
NOTHING = np.empty((0, 2))
ROUNDED = 3e-6


def place(active=(), **more):
    rules = SafetyConfig.model_validate(SECTION | MODES | more).rules()
    modes = Modes(rules.modes, Envelope(rules.limits, rules.zones, rules.footprint))
    return Places(modes, rules.stages, rules.unseen).of(frozenset(active))


PLACES = st.sampled_from([place(), place({"loaded"})])
SPEEDS = st.one_of(st.just(0.0), st.floats(-1, 1))
VELOCITIES = st.builds(Velocity, SPEEDS, SPEEDS)
POINTS = st.lists(st.tuples(st.floats(-2, 2), st.floats(-2, 2)), max_size=8).map(
    lambda all_: np.array(all_).reshape(-1, 2)
)
ZONES = st.sampled_from([Zone.CLEAR, Zone.SLOW, Zone.STOP])
ASKED = st.builds(Asked, VELOCITIES, POINTS, st.builds(Variation, st.floats(0, 0.5), st.floats(0, 0.5)), ZONES)


def seen(**more):
    asked = Asked(more.pop("wanted", STANDSTILL), more.pop("points", NOTHING), STEADY, Zone.CLEAR)
    usual = {"told": STANDSTILL, "stopped": "", "hand": "agent", "zone": Zone.CLEAR, "way": inf, "modes": frozenset()}
    return Snapshot(**(usual | {"troubles": (), "asked": asked} | more))


@settings(max_examples=40)
@given(PLACES, ASKED)
@example(place(), Asked(Velocity(1e-6, 0.0), NOTHING, STEADY, Zone.CLEAR))
def test_the_robot_is_held_up_by_what_is_drawn_in_its_way_and_by_nothing_else(there, asked):
    allowed = there.zones.allow(asked.velocity, asked.points, asked.varied, asked.before)
    drawn = picture(there, asked, STANDSTILL)
    if there.zones.speed(asked.velocity) <= 1e-6:
        assert drawn.slow is None
        return
    held_up = allowed.share < 1 or allowed.zone is not Zone.CLEAR
    assert not held_up or len(drawn.in_the_way)
    least = np.min([piece.outside(drawn.in_the_way) for piece in drawn.slow], axis=0)
    assert (least <= ROUNDED).all()
    # Without these points nothing holds it up.
    others = np.array([p for p in asked.points.tolist() if p not in drawn.in_the_way.tolist()]).reshape(-1, 2)
    free = there.zones.allow(asked.velocity, others, asked.varied, asked.before)
    assert (free.share, free.zone) == (1.0, Zone.CLEAR)


@settings(max_examples=40)
@given(PLACES, VELOCITIES, st.floats(0, 1))
def test_the_stopping_way_ends_where_the_inequality_says(there, told, share):
    drawn = picture(there, Asked(STANDSTILL, NOTHING, STEADY, Zone.CLEAR), told)
    if there.zones.speed(told) <= 1e-6:
        assert drawn.stopping is None
        return
    # The outline at any time before the standstill is in it.
    time = share * there.zones.stopping(told) / there.zones.speed(told)
    turn = told.angular * time
    c, s = np.cos(turn), np.sin(turn)
    radius = told.linear / told.angular if turn else inf
    at = (radius * s, radius * (1 - c)) if turn else (told.linear * time, 0.0)
    corners = there.footprint.vertices @ np.array([[c, s], [-s, c]]) + at
    assert (np.min([piece.outside(corners) for piece in drawn.stopping], axis=0) <= 1e-4).all()


def test_a_mode_s_outline_is_drawn():
    asked = Asked(STANDSTILL, NOTHING, STEADY, Zone.CLEAR)
    assert picture(place({"loaded"}), asked, STANDSTILL).footprint.vertices.max() == 0.6
    assert picture(place(), asked, STANDSTILL).footprint.vertices.max() == 0.35


@settings(max_examples=50)
@given(PLACES, ASKED, VELOCITIES)
def test_markers_hold_what_both_viewers_take(there, asked, told):
    shown = seen(told=told, asked=asked)
    made = markers(shown, picture(there, asked, told), "base_link", 1.0)
    assert [marker.id for marker in made.markers] == list(Id)
    for marker in made.markers:
        assert (marker.header.frame_id, marker.ns, marker.frame_locked) == ("base_link", "gate", True)
        assert marker.lifetime.sec == 1
        # Foxglove names a marker without points as a mistake, and a list of lines with a point too many.
        assert bool(marker.points) == (marker.action == 0 and marker.type != 9)
        assert marker.type != 5 or len(marker.points) % 2 == 0
    for encoding in ("ros1", "cdr"):
        data = encode(made, encoding)
        assert encode(decode(MarkerArray, data, encoding), encoding) == data


@pytest.mark.parametrize(
    ("more", "text", "colour"),
    [
        ({"stopped": "somebody fell"}, "stopped: somebody fell", drawing.RED),
        ({"hand": "nobody"}, "nobody drives", drawing.GREY),
        ({"told": Velocity(0.3, -0.1)}, "agent: 0.30 m/s, -0.10 rad/s\nclear", drawing.GREEN),
        (
            {"hand": "joystick", "zone": Zone.SLOW, "way": 0.421},
            "joystick: 0.00 m/s, 0.00 rad/s\nslow: 0.42 m to the stop zone",
            drawing.YELLOW,
        ),
        (
            {"zone": Zone.UNKNOWN, "troubles": ("scan: is stale",)},
            "agent: 0.00 m/s, 0.00 rad/s\nunknown: not all of it is seen\nscan: is stale",
            drawing.VIOLET,
        ),
        (
            {"zone": Zone.STOP, "way": 0.0},
            "agent: 0.00 m/s, 0.00 rad/s\nstop: 0.00 m to the stop zone",
            drawing.RED,
        ),
    ],
)
def test_the_state_is_a_text_and_a_colour(more, text, colour):
    shown = seen(**more)
    assert (state(shown), drawing.colour_of(shown)) == (text, colour)


@given(ASKED, VELOCITIES, st.text(max_size=300), st.floats(0, 10))
def test_snapshots_come_as_they_were_sent(asked, told, stopped, way):
    sent = seen(told=told, stopped=stopped, way=way, asked=asked, modes=frozenset({"loaded"}))
    came = unpack(pack(sent))
    assert came is not None
    assert came.asked.points.tolist() == asked.points.tolist()
    assert came.asked.velocity == asked.velocity
    assert (came.asked.varied, came.asked.before) == (asked.varied, asked.before)
    assert (came.told, came.stopped, came.way, came.modes) == (told, stopped[:200], way, {"loaded"})


def test_of_too_many_points_the_nearest_are_sent():
    points = np.column_stack((np.linspace(9.0, 0.1, 20_000), np.zeros(20_000)))
    data = pack(seen(points=points))
    assert len(data) <= LARGEST
    came = unpack(data)
    assert len(came.asked.points) == MOST_POINTS
    assert came.asked.points.max() < 2.0


@given(st.binary(max_size=200), st.integers(0, 300))
def test_bytes_that_are_no_snapshot_are_none(data, cut):
    assert unpack(data) is None
    whole = pack(seen(points=np.ones((3, 2))))
    if cut < len(whole) and (len(whole) - cut) % 16:
        assert unpack(whole[:cut]) is None


def test_the_gate_sends_no_more_often_than_configured_and_waits_for_nobody(tmp_path):
    path = str(tmp_path / "display.sock")
    made = []

    def make():
        made.append(1)
        return seen()

    with closing(Feed(path, 5.0, 100.0)) as feed:
        for turn in range(50 * 8):
            feed.turn(make, 100.0 + turn / 50)
        assert 35 <= len(made) <= 41
        assert feed.trouble == ""  # a process that starts takes a while
        feed.turn(make, 111.0)
        assert "takes nothing: No such file" in feed.trouble
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as hangs:
            hangs.bind(path)
            feed.turn(make, 112.0)
            assert feed.trouble == ""
            for second in range(600):  # it takes none of them
                feed.turn(make, 113.0 + second)
            assert "takes nothing: Resource temporarily unavailable" in feed.trouble


@pytest.mark.skipif(os.geteuid() != 0, reason="needs root, to be another user too")
def test_what_the_gate_sees_is_shown_to_no_other_user(tmp_path):
    path = str(tmp_path / "display.sock")
    with closing(Feed(path, 5.0, 100.0)) as feed, closing(bind(path)) as theirs:
        os.chown(path, 54_321, 54_321)
        feed.turn(seen, 111.0)
        assert "display.sock may not have what the gate sees: it is the user 54321" in feed.trouble
        with pytest.raises(BlockingIOError):
            theirs.recv(LARGEST)
        os.chown(path, 0, 0)
        feed.turn(seen, 112.0)
        assert feed.trouble == ""
        assert theirs.recv(LARGEST)


def test_a_snapshot_that_cannot_be_made_costs_the_picture_only(tmp_path):
    def fails():
        raise ZeroDivisionError("a bug")

    with closing(Feed(str(tmp_path / "display.sock"), 5.0, 0.0)) as feed:
        feed.turn(fails, 1.0)
        feed.turn(fails, 20.0)
        assert "a bug" in feed.trouble


class Shown:
    """The process that draws, without being one."""

    def __init__(self, folder):
        self.now = 50.0
        self.published = []
        self.guard, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        for end in (self.guard, theirs):
            end.setblocking(False)
        config = SafetyConfig.model_validate(ON_A_GRAPH | {"folder": str(folder)})
        self.display = Display(config, theirs, self.published.append, clock=lambda: self.now)
        self.gate = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.gate.connect(str(folder / "display.sock"))
        self._theirs = theirs

    def close(self):
        for each in (self.display, self.gate, self.guard, self._theirs):
            each.close()


@pytest.fixture
def shown(tmp_path):
    with closing(Shown(tmp_path)) as shown:
        yield shown


def texts(published):
    return [array.markers[Id.STATE].text for array in published]


def test_the_newest_is_drawn_and_a_silent_gate_is_named(shown):
    shown.gate.send(pack(seen(hand="nobody")))
    shown.gate.send(pack(seen(stopped="somebody fell")))
    shown.display.turn()
    assert texts(shown.published) == ["stopped: somebody fell"]
    assert shown.guard.recv(10) == b"."
    shown.now += 0.9
    shown.display.turn()
    assert len(shown.published) == 1
    shown.now += 0.2
    shown.display.turn()
    assert texts(shown.published)[1:] == ["the gate says nothing"]
    assert [m.action for m in shown.published[1].markers] == [2, 2, 2, 2, 2, 0]
    assert shown.published[1] == silence("base_link", 1.0)


def test_rubbish_and_modes_that_are_not_configured_are_survived(shown):
    shown.gate.send(b"rubbish")
    shown.display.turn()
    assert shown.published == []
    shown.gate.send(pack(seen(modes=frozenset({"unheard"}))))
    shown.display.turn()
    assert texts(shown.published) == ["agent: 0.00 m/s, 0.00 rad/s\nclear"]


def test_it_ends_with_the_guard(shown):
    shown.guard.close()
    shown.display.run()


def test_it_is_off_unless_configured_and_its_topic_is_nobody_else_s():
    assert SafetyConfig.model_validate(SECTION).display is None
    config = SafetyConfig.model_validate(ON_A_GRAPH)
    assert config.display is not None
    assert config.display.topic == "gate_display"
    assert "/walker/gate_display" in protected_names(config, "/walker")
    for taken in ("scan", "/walker/scan", "cmd_vel"):
        with pytest.raises(ValueError, match=f"display.topic: '{taken}' is another topic"):
            SafetyConfig.model_validate(ON_A_GRAPH | {"display": {"topic": taken}})
    with pytest.raises(ValueError, match="frame"):
        SafetyConfig.model_validate(ON_A_GRAPH | {"display": {"frame": "/base link"}})
