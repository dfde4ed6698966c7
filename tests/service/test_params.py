from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import pytest

from skytether.service import ConfigError, NoParams, Service, param, params_schema
from skytether.service.params import read_params


@dataclass(frozen=True)
class Segment:
    length: float = param(doc="Length.", unit="m", gt=0)


@dataclass(frozen=True)
class Params:
    mass: float = param(8.0, unit="kg", gt=0, le=100, doc="Virtual mass.")
    copies: int = param(1, ge=1, lt=10, doc="How many.")
    mode: Literal["gentle", "firm"] = param("gentle", doc="How it feels.")
    trail: tuple[Segment, ...] = param((Segment(9.0),), min_length=1, doc="What to follow.")
    name: str = param("", max_length=8, doc="Shown to people.")


@dataclass(frozen=True)
class Needed:
    site: str = param(doc="Where.")


class Guide(Service[Params]):
    rate_hz = 10

    def step(self, now: float) -> None:
        pass


class SlowGuide(Guide):
    rate_hz = 1


def test_defaults_make_the_dataclass_itself() -> None:
    assert read_params(Params, {}) == Params() == Params(mass=8.0, trail=(Segment(9.0),))


def test_given_values_are_taken() -> None:
    given = {"mass": 10, "mode": "firm", "trail": [{"length": 1}, {"length": 2.5}]}
    assert read_params(Params, given) == Params(10.0, mode="firm", trail=(Segment(1.0), Segment(2.5)))


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        ({"mass": 0}, "parameter 'mass': input should be greater than 0, not 0"),
        ({"mass": 101.0}, "parameter 'mass': input should be less than or equal to 100, not 101.0"),
        ({"mass": "8"}, "parameter 'mass': input should be a valid number, not \"8\""),
        ({"mass": float("nan")}, "parameter 'mass': input should be a finite number, not NaN"),
        ({"mass": None}, "parameter 'mass': input should be a valid number, not null"),
        ({"copies": 0}, "parameter 'copies': input should be greater than or equal to 1, not 0"),
        ({"copies": 10}, "parameter 'copies': input should be less than 10, not 10"),
        ({"copies": 1.5}, "parameter 'copies': input should be a valid integer, not 1.5"),
        ({"mode": "hard"}, "parameter 'mode': input should be 'gentle' or 'firm', not \"hard\""),
        ({"mas": 1}, "there is no parameter 'mas'; there are mass, copies, mode, trail, name"),
        ({"trail": [{"length": -1}]}, "parameter 'trail.0.length': input should be greater than 0, not -1"),
        ({"trail": [{"lenght": 1, "length": 1}]}, "there is no parameter 'trail.0.lenght'"),
        ({"trail": [{}]}, "parameter 'trail.0.length' is missing"),
        ({"name": "long enough"}, "parameter 'name': string should have at most 8 characters, not \"long enough\""),
        ({"mass": 0, "mode": 1}, "parameter 'mass': input should be greater than 0, not 0; parameter 'mode': "),
        ([], "parameters must be a mapping, not []"),
    ],
)
def test_wrong_ones_are_named_with_what_is_allowed(given: Any, sentence: str) -> None:
    with pytest.raises(ConfigError) as caught:
        read_params(Params, given)
    assert str(caught.value).startswith(sentence)
    assert caught.value.status == 2


@dataclass(frozen=True)
class Range:
    low: float = param(0.0, doc="Lower end.")
    high: float = param(1.0, doc="Upper end.")

    def __post_init__(self) -> None:
        if self.low > self.high:
            raise ValueError(f"low must not be above high, {self.low} is above {self.high}")


@dataclass(frozen=True)
class Ranges:
    speeds: tuple[Range, ...] = param((), doc="Of the walker.")


def test_what_the_dataclass_itself_refuses_is_said_in_its_words() -> None:
    with pytest.raises(ConfigError, match=r"^parameters: low must not be above high, 2.0 is above 1.0$"):
        read_params(Range, {"low": 2.0})
    with pytest.raises(ConfigError, match=r"^parameter 'speeds.0': low must not be above high, 2.0 is above 1.0$"):
        read_params(Ranges, {"speeds": [{"low": 2.0, "high": 1.0}]})


def test_an_empty_list_is_too_short() -> None:
    with pytest.raises(ConfigError, match=r"parameter 'trail'.*at least 1 item"):
        read_params(Params, {"trail": []})


def test_one_without_default_must_be_given() -> None:
    assert read_params(Needed, {"site": "edge"}) == Needed("edge")
    with pytest.raises(ConfigError, match="parameter 'site' is missing"):
        read_params(Needed, {})


def test_a_service_without_params_takes_none() -> None:
    assert read_params(NoParams, {}) == NoParams()
    with pytest.raises(ConfigError, match=r"there is no parameter 'mass'$"):
        read_params(NoParams, {"mass": 1})


def test_schema_holds_limits_units_docs_and_defaults() -> None:
    schema = params_schema(Guide)
    assert schema["additionalProperties"] is False
    assert schema["properties"]["mass"] == {
        "type": "number",
        "default": 8.0,
        "exclusiveMinimum": 0,
        "maximum": 100,
        "unit": "kg",
        "description": "Virtual mass.",
    }
    assert schema["properties"]["mode"]["enum"] == ["gentle", "firm"]
    assert schema["properties"]["trail"]["default"] == [{"length": 9.0}]
    assert schema["properties"]["trail"]["items"] == {"$ref": "#/$defs/Segment"}
    assert schema["$defs"]["Segment"]["required"] == ["length"]
    assert schema["$defs"]["Segment"]["additionalProperties"] is False
    assert "required" not in schema
    assert params_schema(SlowGuide) == schema


def test_schema_and_check_agree() -> None:
    """The orchestrator checks with the schema, the service with the dataclass."""
    jsonschema = pytest.importorskip("jsonschema")
    validator = jsonschema.Draft202012Validator(params_schema(Guide))
    for given in (
        {},
        {"mass": 1},
        {"mass": 0},
        {"mas": 1},
        {"copies": 10},
        {"trail": [{}]},
        {"trail": []},
        {"mode": 1},
    ):
        try:
            read_params(Params, given)
            right = True
        except ConfigError:
            right = False
        assert validator.is_valid(given) is right, given
