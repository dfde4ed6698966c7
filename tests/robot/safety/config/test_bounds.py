"""Plausible numbers: every one has bounds with a reason, and a file that means another says so."""

import dataclasses
import types
import typing
from pathlib import Path
from typing import Any

import pytest
import yaml
from pydantic import BaseModel

from skytether.api.config_file import ConfigError
from skytether.robot.config.gate_config import load_safety
from skytether.robot.safety.config import bounds
from skytether.robot.safety.config.bounds import BOUNDS, bound_of
from skytether.robot.safety.config.safety_config import SafetyConfig

LEAST = {"footprint": {"radius": 0.3}, "sensors": {"scan": {}}, "sockets": {}}


@pytest.fixture
def load(tmp_path):
    def load(safety, **more) -> SafetyConfig:
        path = tmp_path / "robot.yaml"
        path.write_text(yaml.safe_dump({"safety": LEAST | safety, **more}))
        return load_safety(path)

    return load


def numbers(kind: Any, path: tuple[str, ...] = ()) -> set[tuple[str, ...]]:
    """Paths of all fields that are floats, or lists of them."""
    origin, args = typing.get_origin(kind), typing.get_args(kind)
    if origin in (types.UnionType, typing.Union, typing.Annotated):
        return set().union(*(numbers(arg, path) for arg in args))
    if origin is dict:
        return numbers(args[1], (*path, "*"))
    if origin is tuple:
        return set().union(*(numbers(arg, path) for arg in args))
    if isinstance(kind, type) and issubclass(kind, BaseModel):
        hints = typing.get_type_hints(kind)
        return set().union(*(numbers(hints[name], (*path, name)) for name in kind.model_fields))
    if dataclasses.is_dataclass(kind):
        hints = typing.get_type_hints(kind)
        return set().union(*(numbers(hints[f.name], (*path, f.name)) for f in dataclasses.fields(kind)))
    return {path} if kind is float else set()


WITHOUT_SIZE = {("sensors", "*", "fov_deg"), ("modes", "*", "limits", "*"), ("modes", "*", "zones", "*")}
"""Directions, of which none is too large; what has the rows of the keys that it tightens."""


def test_every_number_of_the_section_has_bounds_and_every_row_is_a_key():
    found = numbers(SafetyConfig)
    assert {".".join(path) for path in found - WITHOUT_SIZE if bound_of(path) is None} == set()
    assert {b.key for b in BOUNDS} - {".".join(path) for path in found} == set()
    assert all(b.low < b.high and b.why for b in BOUNDS)


def test_what_is_not_written_is_plausible():
    assert SafetyConfig.model_validate(LEAST | {"joystick": {}, "estop": {}}).notes() == ()


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"limits": {"linear_braking": 1e9}}, "limits.linear_braking must be 0.1 to 5 m/s^2, not 1e+09"),
        ({"limits": {"max_gap_s": 3600}}, "limits.max_gap_s must be 0.02 to 1 s, not 3600"),
        ({"zones": {"reaction_s": 3600}}, "zones.reaction_s must be 0.005 to 1 s, not 3600"),
        ({"zones": {"stop_m": 1e-6}}, "zones.stop_m must be 0.02 to 2 m, not 1e-06"),
        ({"sensors": {"scan": {"max_age_s": 9}}}, "sensors.scan.max_age_s must be 0.02 to 1 s, not 9"),
        (
            {"sensors": {"scan": {"ignore_deg": [[-180, 150]]}}},
            "sensors.scan.ignore_deg must be 0 to 270 degrees, not 330",
        ),
        ({"sensors": {"scan": {"ignore_deg": [[0, 180], [180, 330]]}}}, "ignore_deg must be 0 to 270 degrees, not 330"),
        ({"sensors": {"scan": {"range_max": 1e6}}}, "sensors.scan.range_max must be 0.1 to 100 m, not 1e+06"),
        (
            {"footprint": {"polygon": [[90, 1], [90, -1], [-1, 0]]}},
            "footprint.polygon must be 0.05 to 5 m, not 90.0056",
        ),
        ({"footprint": {"polygon": [[2, 1], [2, -1], [1, 0]]}}, "the origin of the base frame (0, 0) must be inside"),
        ({"sensors": {"scan": {"range_min": 0.5, "range_max": 0.4}}}, "range_min 0.5 must be below range_max 0.4"),
        ({"joystick": {"linear": 4.5}}, "joystick.linear must be -3 to 3 m/s, not 4.5"),
        ({"joystick": {"linear_axis": 2, "angular_axis": 2}}, "linear_axis and angular_axis must be two axes"),
        ({"estop": {"max_age_s": 59}}, "estop.max_age_s must be 0.05 to 2 s, not 59"),
        ({"guard_s": 0.9}, "guard_s must be 0.02 to 0.5 s, not 0.9"),
        ({"beyond": {"guard_s": "slow machine"}}, "beyond.guard_s: no number of that key is beyond its bounds"),
        ({"beyond": {"gaurd_s": "slow machine"}, "guard_s": 0.9}, "guard_s must be"),
        ({"beyond": {"guard_s": " "}, "guard_s": 0.9}, "guard_s must be"),
    ],
)
def test_what_is_absurd_is_refused_with_the_bounds_and_the_way_out(load, change, says):
    with pytest.raises(ConfigError) as error:
        load(change)
    assert says in str(error.value)


def test_a_file_that_means_it_says_why_and_it_is_named(load):
    reason = "lab robot on rubber"
    section = {"limits": {"linear_braking": 7.0}, "beyond": {"limits.linear_braking": reason}}
    config = load(section)
    assert config.rules().limits.linear_braking == 7.0
    assert config.notes() == (
        f"limits.linear_braking is 7, beyond 0.1 to 5 m/s^2 (half of what rubber holds on a dry floor): {reason}",
    )
    # As the gate gets it.
    assert SafetyConfig.model_validate_json(config.model_dump_json()).notes() == config.notes()


@pytest.mark.parametrize(
    ("section", "says"),
    [
        ({"joystick": {"linear": -0.3}}, "joystick.linear 0.3 is above limits.linear_max 0.25"),
        ({"joystick": {"angular": 0.9}}, "joystick.angular 0.9 is above limits.angular_max 0.5"),
        ({"zones": {"slow_speed": 0.3, "slow_m": 1}}, "zones.slow_speed 0.3 is above limits.linear_max 0.25"),
    ],
)
def test_what_the_limits_cut_is_named(load, section, says):
    (note,) = load(section).notes()
    assert note.startswith(says)


def test_reasons_beside_the_robots_own_limits_hold_for_the_gate_that_takes_them(load):
    config = load({}, limits={"linear_braking": 7.0}, beyond={"limits.linear_braking": "rubber"})
    assert len(config.notes()) == 1
    own = load(
        {"limits": {"linear_braking": 3.0}}, limits={"linear_braking": 7.0}, beyond={"limits.linear_braking": "x"}
    )
    assert own.notes() == ()


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (
            {"limits": {"linear_max": 2.0}, "sensors": {"scan": {"range_max": 2.0}}},
            # 0.05 sensing, 0.3 oldest scan, 0.14 hold, 0.1 wheels is 0.59 s; 2 * 0.59 + 1.
            "limits.linear_max, sensors.scan.range_max: at 2 m/s the robot needs 2.18 m to stop (0.59 s until",
        ),
        (
            # The corner of a circle of 0.3 m around which the polygon is; turning brakes it with 4 rad/s^2.
            {"zones": {"slow_speed": 0.5, "slow_m": 0.1}},
            "zones.slow_speed, zones.slow_m: at 0.5 m/s the robot needs 0.25 m to stop (0.29 s until the brakes",
        ),
    ],
)
def test_what_cannot_stop_is_refused_with_the_numbers_that_would_hold(load, change, says):
    with pytest.raises(ConfigError) as error:
        load(change)
    assert says in str(error.value)
    assert "would hold" in str(error.value)


def test_the_numbers_that_would_hold_do(load):
    sensors = {"scan": {"range_max": 2.0}}
    with pytest.raises(ConfigError) as error:
        load({"limits": {"linear_max": 2.0}, "sensors": sensors})
    speed = float(str(error.value).split("; ")[-1].split(" m/s")[0])
    assert load({"limits": {"linear_max": speed - 0.005}, "sensors": sensors})
    with pytest.raises(ConfigError):
        load({"limits": {"linear_max": speed + 0.01}, "sensors": sensors})


def test_the_documentation_has_the_table():
    text = (Path(__file__).parents[4] / "docs" / "safety-numbers.md").read_text()
    assert bounds.table() in text
