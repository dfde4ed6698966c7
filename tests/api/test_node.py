"""Nodes and orchestrators of different versions understand each other."""

from __future__ import annotations

import json

import pytest

from skytether.api.node import Linked, Machine, Refused, Said, Told, read_request
from skytether.node.calls import RefusedError, read_answer

URL = "https://orchestrator.example:8603"


def line(document: dict[str, object]) -> bytes:
    return json.dumps(document).encode()


def test_what_a_later_version_says_beyond_is_left_out() -> None:
    linked = read_answer(line({"time": 1.0, "begins": 0.0, "ends": 2.0, "later": {"more": 1}}), Linked, URL)
    assert linked.time == 1.0
    assert Told.model_validate_json(line({"ping": 3, "later": 1})).ping == 3
    assert Said.model_validate_json(line({"pong": 3, "later": 1})).pong == 3
    machine = {**Machine().model_dump(), "later": 1}
    assert read_request(line({"do": "link", "machine": machine, "later": 1})).do == "link"


def test_a_refusal_is_one_whatever_was_asked() -> None:
    refused = Refused(error="the token was used", final=True)
    with pytest.raises(RefusedError, match="the token was used"):
        read_answer(line({**refused.model_dump(), "later": 1}), Linked, URL)
