"""What the doctor looks at, through sockets and the file system; `doctor` judges. Each look gives up after seconds."""

from __future__ import annotations

import importlib.util
import ssl
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import httpx

from skytether.api.client import ApiError, Client, Unreachable
from skytether.api.plain_http import is_readable_on_the_way
from skytether.bridge.echo import SMALLEST, EchoClient

from ..control import fallback
from .doctor import (
    EXTRAS,
    Finding,
    judge_certificate,
    judge_clock,
    judge_extras,
    judge_mtu,
    judge_nat,
    judge_udp,
)

_TIMEOUT_S = 3.0
_ANSWER_S = 1.0
_ASKS = 10
_PAUSE_S = 0.05
_TRIES = 3
"""A size that is lost this often in a row does not get through."""
_LARGEST = 1472
"""UDP payload of an Ethernet packet."""


def orchestrator(url: str, ca_file: Path | None) -> Iterator[Finding]:
    """Whether it answers, by a certificate that is trusted, and what time it is there."""
    before = time.time()
    try:
        verify = ssl.create_default_context(cafile=ca_file) if url.startswith("https://") else False
    except (OSError, ssl.SSLError) as error:
        todo = "give a PEM file of certificates with --ca-file"
        yield Finding("certificate", "trouble", f"{ca_file} cannot be read: {error.strerror or error}", todo)
        return
    try:
        answer = httpx.get(f"{url.rstrip('/')}/healthz", timeout=_TIMEOUT_S, verify=verify, trust_env=False)
    except (httpx.TransportError, httpx.InvalidURL) as error:
        if "CERTIFICATE_VERIFY_FAILED" in str(error):
            yield Finding("orchestrator", "ok", f"something answers at {url}")
            yield judge_certificate(url, str(error))
            return
        yield Finding(
            "orchestrator",
            "trouble",
            f"nobody answers at {url}: {error or type(error).__name__}",
            "start one with `skytether orchestrator run`, correct the address, or let TCP through to it; http and "
            "https are not the same",
        )
        return
    if answer.status_code != 200:
        todo = "give the address of the orchestrator"
        yield Finding("orchestrator", "trouble", f"{url} answers with HTTP {answer.status_code}", todo)
        return
    yield Finding("orchestrator", "ok", f"answers at {url}")
    if url.startswith("https://"):
        yield judge_certificate(url, "")
    elif is_readable_on_the_way(url):
        todo = "give the orchestrator a certificate (tls.certificate), or use it inside a VPN only"
        yield Finding("certificate", "trouble", "there is none: tokens can be read on the way", todo)
    yield judge_clock(answer.headers.get("date"), before, time.time())


def token(url: str, ca_file: Path | None, given: str, service: str | None, *, insecure_http: bool) -> Finding:
    """Whether the token is good, and for the service."""
    try:
        with Client(url, given, timeout=_TIMEOUT_S, ca_file=ca_file, insecure_http=insecure_http) as client:
            if service is None:
                client.services()
                return Finding("token", "ok", "is accepted")
            client.get_service(service)
    except Unreachable as error:
        return Finding("token", "skipped", str(error))
    except ApiError as error:
        todo = (
            "register the robot (skytether robot add NAME), or make a new token; `skytether service list` says what is"
        )
        return Finding("token", "trouble", str(error), todo)
    return Finding("token", "ok", f"is accepted, and may ask for {service}")


def network(host: str, port: int) -> Iterator[Finding]:
    """Whether UDP gets through, in which sizes, and how this machine is seen."""
    where = f"{host}:{port}"
    try:
        client = EchoClient(host, port)
    except OSError as error:
        todo = "correct the name, or this machine's name server"
        yield Finding("udp", "trouble", f"{host} has no address: {error.strerror or error}", todo)
        return
    with client:
        found: list[tuple[str, int]] = []
        for i in range(_ASKS):
            echo = client.ask(_ANSWER_S if found or i == 0 else _ANSWER_S / 4)
            if echo is not None:
                found.append(echo.seen_as)
            time.sleep(_PAUSE_S)
        yield judge_udp(where, _ASKS, len(found))
        yield judge_mtu(_largest(client) if found else None)
        yield judge_nat(found)


def extras(needed: Sequence[str]) -> Finding:
    """What of the optional parts is installed."""
    missing = {extra: [m for m in modules if not _there(m)] for extra, modules in EXTRAS.items()}
    return judge_extras(missing, needed)


def own_controller(name: str, options: dict[str, object]) -> Finding:
    """Whether the fallback can be had."""
    try:
        drives = fallback.load(name, options).drives
    except fallback.FallbackError as error:
        todo = "correct fallback in robot.yaml, or install the package that brings it"
        return Finding("fallback", "trouble", str(error), todo)
    return Finding("fallback", "ok", f"{name} {'drives' if drives else 'stops the robot'} when link or service fail")


def _largest(client: EchoClient) -> int | None:
    """Largest datagram that comes back, by halving."""

    def passes(size: int) -> bool:
        return any(client.ask(_ANSWER_S / 2, size) is not None for _ in range(_TRIES))

    if passes(_LARGEST):
        return _LARGEST
    low, high = SMALLEST, _LARGEST
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if passes(middle) else (low, middle)
    return low


def _there(module: str) -> bool:
    try:
        return importlib.util.find_spec(module) is not None
    except (ImportError, ValueError):
        return False
