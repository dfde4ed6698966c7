"""What could be stored but never given back is refused at the door, and nothing of it is left."""

from __future__ import annotations

from typing import Any

import httpx
import pytest
from pydantic import ValidationError

from skytether.api.rest import Measurement

ASK = '{"robot": "walker", "service": "toy", "params": {"mass": %s}}'


@pytest.fixture
def http(shared: Any) -> Any:
    headers = {"Authorization": f"Bearer {shared.token}", "Content-Type": "application/json"}
    with httpx.Client(base_url=f"{shared.url}/api/v1", headers=headers) as client:
        yield client


@pytest.mark.parametrize(
    ("value", "sentence"),
    [
        ("NaN", "params.mass: must be a finite number, not nan"),
        ("1e999", "params.mass: must be a finite number, not inf"),
        ("1" * 400, "params.mass: must be a whole number of at most 64 bits"),
        (r'"\u0000"', "params.mass: holds a NUL character: leave it out"),
        (r'"\ud800"', "params.mass: holds half a character (a lone surrogate): leave it out"),
        ("[" * 300 + "]" * 300, "params.mass.0: is nested more than 64 levels deep"),
        ('1, "mass": 2', "the key 'mass' comes twice: leave one of them out"),
        (f'["{"x" * 20_000}", NaN]', "params.mass.1: must be a finite number, not nan"),
    ],
)
def test_a_body_that_could_not_be_given_back(http: httpx.Client, value: str, sentence: str) -> None:
    answer = http.post("/instances", content=ASK % value)
    assert (answer.status_code, answer.json()["detail"]) == (422, sentence)
    listed = http.get("/instances")
    assert (listed.status_code, listed.json()) == (200, [])


def test_a_delay_that_nothing_can_be_reckoned_with() -> None:
    for key in ("rtt_ms", "jitter_ms"):
        with pytest.raises(ValidationError, match="less than or equal to 3600000"):
            Measurement.model_validate({key: 1e308})


@pytest.mark.parametrize("path", ["/instances/%00", "/catalog/%00", "/sites/%00"])
def test_a_name_that_no_database_knows(http: httpx.Client, path: str) -> None:
    for method in ("GET", "DELETE"):
        answer = http.request(method, path)
        assert (answer.status_code, answer.json()["title"]) == (404, "Not found")
