"""Limits by mode: they only tighten, and who is not heard or not understood has all of them."""

import math
from dataclasses import replace

import numpy as np
import pytest
import yaml

from skytether.api.config_file import ConfigError
from skytether.messages import LaserScan, String
from skytether.robot.config.gate_config import load_safety
from skytether.robot.control.command import Command, Hand
from skytether.robot.safety.config.safety_config import SafetyConfig
from skytether.robot.safety.rules.modes import Envelope, ModeRules, Modes
from skytether.robot.safety.rules.rules import Gate, GateDecision

SECTION = {
    "footprint": {"polygon": [[0.3, 0.2], [0.3, -0.2], [-0.3, -0.2], [-0.3, 0.2]]},
    "limits": {"linear_max": 0.6, "linear_min": -0.3},
    "zones": {"stop_m": 0.1},
    "sensors": {"scan": {}},
    "modes": {
        "loaded": {
            "limits": {"linear_max": 0.3, "linear_braking": 0.8},
            "footprint": {"polygon": [[0.5, 0.2], [0.5, -0.2], [-0.3, -0.2], [-0.3, 0.2]]},
        },
        "people": {"limits": {"linear_max": 0.4, "linear_min": 0}, "zones": {"stop_m": 0.3, "slow_speed": 0.05}},
    },
    "mode": {"topic": "mode"},
    "sockets": {},
}


@pytest.fixture
def load(tmp_path):
    def load(**changes) -> SafetyConfig:
        path = tmp_path / "robot.yaml"
        path.write_text(yaml.safe_dump({"safety": SECTION | changes}))
        return load_safety(path)

    return load


class Bench:
    """A robot in a hall whose walls are far away, that is told its modes again and again."""

    def __init__(self, config: SafetyConfig) -> None:
        self.gate = Gate(config.rules())
        self.now = 100.0
        self.sequence = 0
        self.says: str | None = ""
        self.wanted = 0.0
        self.ahead = 6.0
        self.run(0.3)

    def run(self, seconds: float) -> GateDecision:
        for _ in range(round(seconds / 0.02)):
            self.now += 0.02
            self.sequence += 1
            ranges = np.full(240, 6.0, dtype=np.float32)
            ranges[118:123] = self.ahead
            scan = LaserScan(
                angle_min=-math.pi, angle_increment=math.tau / 240, range_min=0.01, range_max=9.0, ranges=ranges
            )
            self.gate.sense("scan", scan, self.now)
            if self.says is not None:
                self.gate.sense("mode", String(self.says), self.now)
            command = Command(Hand.AGENT, self.wanted, 0.0, 1, self.sequence, self.now, 0.0, self.now)
            self.gate.command(command, self.now)
            self.last = self.gate.step(self.now)
        return self.last

    @property
    def speed(self) -> float:
        return self.last.velocity.linear


def test_modes_tighten_while_they_are_said(load):
    bench = Bench(load())
    bench.wanted = 0.6
    bench.run(1.0)
    assert bench.speed == pytest.approx(0.6)
    bench.says = "people"
    bench.run(1.0)
    assert (bench.speed, bench.gate.modes) == (pytest.approx(0.4), ["people"])
    bench.says = "loaded, people"
    bench.run(1.0)
    assert (bench.speed, bench.gate.modes) == (pytest.approx(0.3), ["loaded", "people"])
    bench.says = "normal"
    bench.run(1.0)
    assert (bench.speed, bench.gate.modes) == (pytest.approx(0.6), [])


@pytest.mark.parametrize("says", ["lodaed", "people, moon", None])
def test_whoever_is_silent_or_not_understood_has_all_of_them(load, says):
    bench = Bench(load())
    bench.wanted = 0.6
    bench.run(1.0)
    bench.says = says
    bench.run(2.5)
    assert (bench.speed, bench.gate.modes) == (pytest.approx(0.3), ["loaded", "people"])
    assert "all hold" in bench.last.troubles["mode"]
    bench.says = "none"
    bench.run(1.0)
    assert (bench.speed, bench.last.troubles) == (pytest.approx(0.6), {})


def test_with_a_load_that_sticks_out_the_robot_stands_that_much_earlier(load):
    places = {}
    for mode in ("", "loaded", "people"):
        bench = Bench(load())
        bench.says, bench.wanted, bench.ahead = mode, 0.2, 1.0
        x = 0.0
        for turn in range(700):
            bench.ahead = 1.0 - x
            bench.run(0.02)
            x += bench.speed * 0.02
            if turn > 100 and bench.speed == 0:
                break
        places[mode] = x
    # Front at 0.3 and 0.1 of room; with the load at 0.5; with people 0.3 of room.
    assert places[""] == pytest.approx(0.6, abs=0.02)
    assert places["loaded"] == pytest.approx(0.4, abs=0.02)
    assert places["people"] == pytest.approx(0.4, abs=0.02)


def test_weaker_brakes_of_a_mode_are_reckoned_with(load):
    rules = load().rules()
    # Braking of 0.8 instead of 2 from 0.3 m/s, on the other hand no faster than ordinary acceleration.
    loaded = rules.modes.envelopes["loaded"].limits
    assert (loaded.linear_braking, loaded.linear_acceleration) == (0.8, 0.8)
    both = Modes(rules.modes, Envelope(rules.limits, rules.zones, rules.footprint)).envelope(
        frozenset(("loaded", "people"))
    )
    assert (both.limits.linear_max, both.limits.linear_min, both.limits.linear_braking) == (0.3, 0.0, 0.8)
    assert (both.zones.stop_m, both.zones.slow_speed, both.footprint.radius) == (
        0.3,
        0.05,
        pytest.approx(0.5385, abs=1e-3),
    )


def test_without_a_topic_requests_say_it_and_all_hold_until_the_first(load):
    bench = Bench(load(mode={}))
    bench.says, bench.wanted = None, 0.6
    bench.run(1.0)
    assert (bench.speed, bench.gate.modes) == (pytest.approx(0.3), ["loaded", "people"])
    assert bench.gate.set_modes("people", bench.now) == ""
    assert bench.gate.modes == ["people"]
    bench.run(4.0)
    assert bench.speed == pytest.approx(0.4)
    assert "no mode 'moon'" in bench.gate.set_modes("moon", bench.now)
    bench.run(1.0)
    assert bench.speed == pytest.approx(0.3)


def test_a_request_is_refused_where_a_topic_says_it_or_there_are_none(load):
    assert "the topic mode says" in Gate(load().rules()).set_modes("people", 0.0)
    assert "there are no modes" in Gate(replace(load().rules(), modes=ModeRules())).set_modes("people", 0.0)


@pytest.mark.parametrize(
    ("mode", "says"),
    [
        ({"limits": {"linear_max": 0.7}}, "modes.fast.limits.linear_max: a mode only tightens"),
        ({"limits": {"linear_min": -0.4}}, "modes.fast.limits.linear_min: a mode only tightens"),
        ({"limits": {"linear_braking": 3.0}}, "modes.fast.limits.linear_braking: a mode only tightens"),
        ({"zones": {"stop_m": 0.05}}, "modes.fast.zones.stop_m: a mode only tightens"),
        ({"zones": {"slow_speed": 0.2}}, "modes.fast.zones.slow_speed: a mode only tightens"),
        ({"footprint": {"radius": 0.25}}, "modes.fast.footprint: a mode only tightens"),
        ({"limits": {"max_gap_s": 0.1}}, "modes.fast.limits.max_gap_s: unknown key; allowed are angular_acceleration"),
        ({"zones": {"stop": 0.2}}, "modes.fast.zones.stop: unknown key; allowed are"),
        ({"limits": {"linear_max": 0.001}}, "modes.fast.limits.linear_max must be 0.01 to 3 m/s, not 0.001"),
        ({"limits": {"linear_max": -1}}, "modes.fast.limits.linear_max must be 0.01 to 3 m/s, not -1"),
        ({"zones": {"reaction_s": 5}}, "modes.fast.zones.reaction_s must be"),
    ],
)
def test_a_mode_that_loosens_or_makes_no_sense_is_refused_by_key(load, mode, says):
    with pytest.raises(ConfigError) as error:
        load(modes={"fast": mode})
    assert says in str(error.value)


def test_a_topic_without_modes_is_a_mistake(load):
    with pytest.raises(ConfigError, match=r"mode\.topic: there are no modes"):
        load(modes={})


def test_modes_go_to_the_gate_unchanged(load):
    config = load()
    again = SafetyConfig.model_validate_json(config.model_dump_json())
    assert again.rules().modes.envelopes.keys() == {"loaded", "people"}
    assert again.kinds()["mode"] is String
