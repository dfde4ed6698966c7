"""What an API server's refusals mean, as data: sentences that a person can act on."""

from __future__ import annotations

import base64
import json
import time
from pathlib import Path

import pytest
from certificates import certificate

from skytether.orchestrator.runtimes.base import SiteSilentError
from skytether.orchestrator.runtimes.kubernetes.cluster import RefusedError, refusal
from skytether.orchestrator.runtimes.kubernetes.credentials import expired
from skytether.orchestrator.runtimes.kubernetes.seen import refused

DAY_S = 86_400.0


def told(status: int, message: str = "", why: str = "") -> Exception:
    return refusal(status, {"message": message, "reason": "R"}, "GET /x", lambda: why)


@pytest.mark.parametrize(
    ("status", "message", "words"),
    [
        (404, "", "GET /x: HTTP 404"),
        (401, "Unauthorized", "the API server does not know us: the token or certificate is wrong or expired"),
        (
            403,
            'pods is forbidden: User "system:anonymous" cannot list resource "pods"',
            "the API server does not know us: the token or certificate is wrong or expired",
        ),
        (
            403,
            'pods is forbidden: User "robot" cannot list resource "pods"',
            'the site\'s account lacks a right: pods is forbidden: User "robot" cannot list resource "pods"',
        ),
        (
            403,
            'admission webhook "w" denied the request: you cannot',
            'admission webhook "w" denied the request: you can',
        ),
        (500, 'failed calling webhook "w": connection refused', 'failed calling webhook "w": connection refused'),
    ],
)
def test_a_refusal_is_told_in_the_servers_words_or_better(status: int, message: str, words: str) -> None:
    error = told(status, message)
    assert isinstance(error, RefusedError)
    assert (str(error)[: len(words)], error.status, error.reason) == (words, status, "R")


@pytest.mark.parametrize("status", [429, 500, 503])
def test_a_server_that_is_busy_says_nothing_of_a_service(status: int) -> None:
    assert isinstance(told(status, "too many requests"), SiteSilentError)


def test_what_of_our_credentials_has_expired_is_named_with_its_date(tmp_path: Path) -> None:
    path, now = str(certificate(tmp_path)[0]), time.time()
    assert expired(path, None, now) == ""
    assert expired(path, None, now + 2 * DAY_S).startswith("the certificate expired at 20")
    payload = base64.urlsafe_b64encode(json.dumps({"exp": 1_700_000_000}).encode()).decode().rstrip("=")
    assert expired(None, f"e30.{payload}.x", 1_700_000_001.0) == "the token expired at 2023-11-14 22:13:20 UTC"
    assert expired(None, f"e30.{payload}.x", 1_699_999_999.0) == ""
    for odd in ("", "opaque", "a.b.c", "e30.e30.x", f"e30.{base64.urlsafe_b64encode(b'[]').decode()}.x"):
        assert expired("/nowhere", odd, now) == ""
    why = "the token expired at 2023-11-14 22:13:20 UTC"
    assert str(told(401, "Unauthorized", why)) == f"the API server does not know us: {why}"


def test_pod_security_that_refuses_a_host_port_is_told_with_what_to_do() -> None:
    said = 'pods "p" is forbidden: violates PodSecurity "restricted:latest": hostPort (container "service" uses 20000)'
    assert refused(said).endswith(
        "uses 20000): give the site another option 'reach', or its namespace the label of Pod Security 'privileged'"
    )
    assert refused("exceeded quota: none") == "the cluster refuses it: exceeded quota: none"
