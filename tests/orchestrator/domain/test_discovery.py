"""What Prometheus is told to scrape."""

from __future__ import annotations

from typing import Any

import httpx
import pytest

from skytether.api.rest import ScrapeTargets, TokenCreate
from skytether.orchestrator.config.settings import Settings
from skytether.orchestrator.domain.discovery import targets
from skytether.orchestrator.domain.errors import InvalidError
from skytether.orchestrator.domain.validation import parse


def group(host: str, scheme: str = "http") -> ScrapeTargets:
    return ScrapeTargets(targets=(host,), labels={"__scheme__": scheme})


def test_an_orchestrator_is_where_it_was_asked_unless_it_says_otherwise() -> None:
    assert targets((), None, "https://cloud:8600") == [group("cloud:8600", "https")]
    assert targets((), "http://10.0.0.2:8600", "https://balancer") == [group("10.0.0.2:8600")]


def test_all_that_are_there_are_told_once_and_in_order() -> None:
    found = targets(["http://b:8600", "http://a:8600"], "http://b:8600", "http://balancer")
    assert found == [group("a:8600"), group("b:8600")]


@pytest.mark.parametrize("asked", ["http://", "http://a/b", 'http://a"', "ftp://a", "http://" + "a" * 300])
def test_where_it_was_asked_may_be_anything(asked: str) -> None:
    assert targets((), None, asked) == []


@pytest.mark.parametrize("wrong", ["cloud:8600", "http://a b", "http://a/metrics", "http://" + "a" * 300])
def test_where_it_is_reached_must_be_an_address(wrong: str) -> None:
    with pytest.raises(InvalidError, match="advertise"):
        parse(Settings, {"advertise": wrong})


def test_prometheus_is_answered_with_a_token_that_may_nothing_else(served: Any) -> None:
    token = served.client(served.token).create_token(TokenCreate(name="prometheus", scopes=("metrics",))).token
    headers = {"Authorization": f"Bearer {token}"}
    with httpx.Client(base_url=served.url, headers=headers, trust_env=False) as http:
        answer = http.get("/api/v1/prometheus/targets")
        assert answer.headers["content-type"] == "application/json"
        assert answer.json() == [{"targets": [served.url.removeprefix("http://")], "labels": {"__scheme__": "http"}}]
        assert http.get("/api/v1/sites").status_code == 403
        assert http.get("/api/v1/prometheus/targets", headers={"Host": 'x"y'}).status_code < 500
