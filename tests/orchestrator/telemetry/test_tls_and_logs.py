"""HTTPS of the orchestrator's own, its log as JSON, and who did what: the real program."""

from __future__ import annotations

import json
import logging
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from certificates import certificate
from orchestrator_program import Program, until, with_toy

from skytether.api.client import ApiError, Client, Unreachable
from skytether.api.rest import GateReport, InstanceCreate, RobotCreate
from skytether.orchestrator.telemetry.audit import verify
from skytether.orchestrator.telemetry.logs import TextFormatter

pytestmark = pytest.mark.slow


@pytest.fixture
def program(tmp_path: Path) -> Iterator[Callable[..., Program]]:
    made: list[Program] = []

    def make(**settings: Any) -> Program:
        (tmp_path / "one").mkdir(exist_ok=True)
        (tmp_path / "orchestrator.yaml").write_text(json.dumps(settings))
        made.append(Program(tmp_path / "one" / "state", "--config", str(tmp_path / "orchestrator.yaml")))
        return made[-1]

    yield make
    for one in made:
        one.clean_up()


def test_https_with_a_certificate_of_ones_own(program: Callable[..., Program], tmp_path: Path) -> None:
    cert, key = certificate(tmp_path)
    running = program(tls={"certificate": str(cert), "key": str(key)})
    with running.start() as client:
        url = (running.folder / "address").read_text().strip()
        assert url.startswith("https://127.0.0.1:")
        with pytest.raises(Unreachable, match=r"is not trusted .*self-signed.*SKYTETHER_CA_FILE"):
            client.sites()
    token = (running.folder / "operator.token").read_text().strip()
    with Client(url, token, ca_file=cert) as client:
        assert [site.name for site in client.sites()] == ["local"]


def test_a_clock_that_is_wrong_is_no_wrong_certificate(
    program: Callable[..., Program], tmp_path: Path, faketime: str
) -> None:
    cert, key = certificate(tmp_path)
    running = program(tls={"certificate": str(cert), "key": str(key)})
    running.start().close()
    url = (running.folder / "address").read_text().strip()
    token = (running.folder / "operator.token").read_text().strip()
    for offset, says in (("+10d", "certificate has expired"), ("-10d", "certificate is not yet valid")):
        wrong = {"LD_PRELOAD": faketime, "FAKETIME": offset, "FAKETIME_DONT_FAKE_MONOTONIC": "1"}
        ours = {"SKYTETHER_CA_FILE": str(cert), "SKYTETHER_TOKEN": token}
        command = [sys.executable, "-m", "skytether.cli", "site", "list", "--url", url]
        done = subprocess.run(command, env={**os.environ, **wrong, **ours}, capture_output=True, text=True)
        said = " ".join(done.stderr.split())
        assert done.returncode == 1
        assert f"is not trusted (certificate verify failed: {says}): correct this machine's clock" in said
    with Client(url.replace("https:", "http:"), token) as client, pytest.raises((Unreachable, ApiError)):
        client.sites()
    elsewhere = Client(url.replace("127.0.0.1", "localhost"), token, ca_file=cert)
    with elsewhere as client, pytest.raises(Unreachable, match=r"is not trusted .*localhost"):
        client.sites()


def test_without_a_certificate_nothing_listens_beyond_loopback_unasked(
    program: Callable[..., Program], tmp_path: Path
) -> None:
    status, text = program(host="0.0.0.0").fails()
    assert status == 2
    assert "could be read on the way to 0.0.0.0: give a certificate" in text
    assert "--insecure-http" in text
    told = program(host="0.0.0.0", insecure_http=True)
    with told.start() as client:
        assert client.sites()
    assert told.end() == 0
    cert, key = certificate(tmp_path)
    secret = program(host="0.0.0.0", tls={"certificate": str(cert), "key": str(key)})
    secret.start().close()
    url = (secret.folder / "address").read_text().strip().replace("0.0.0.0", "127.0.0.1")
    with Client(url, (secret.folder / "operator.token").read_text().strip(), ca_file=cert) as client:
        assert client.sites()


def test_a_renewed_certificate_is_used_without_a_restart(program: Callable[..., Program], tmp_path: Path) -> None:
    cert, key = certificate(tmp_path)
    running = program(tls={"certificate": str(cert), "key": str(key)})
    running.start().close()
    url = (running.folder / "address").read_text().strip()
    token = (running.folder / "operator.token").read_text().strip()
    (tmp_path / "new").mkdir()
    new, new_key = certificate(tmp_path / "new")
    with Client(url, token, ca_file=cert) as open_before:
        assert open_before.sites()
        cert_before = cert.read_bytes()
        key.write_bytes(new_key.read_bytes())  # half of the pair: not used
        until(lambda: "cannot be used" in running.log, running)
        (tmp_path / "old.pem").write_bytes(cert_before)
        with Client(url, token, ca_file=tmp_path / "old.pem") as client:
            assert client.sites()
        cert.write_bytes(new.read_bytes())
        until(lambda: "was renewed" in running.log, running)
        with Client(url, token, ca_file=new) as client:
            assert client.sites()
        assert open_before.sites()


def test_a_certificate_that_cannot_be_used_is_one_sentence(program: Callable[..., Program], tmp_path: Path) -> None:
    cert, key = certificate(tmp_path)
    key.write_text("rubbish")
    status, text = program(tls={"certificate": str(cert), "key": str(key)}).fails()
    assert status == 2
    assert "cannot be used" in text
    with pytest.raises(ApiError, match="no file of certificates"):
        Client("https://127.0.0.1:1", "t", ca_file=key)


def test_the_log_is_json_and_the_audit_names_who_did_what(
    program: Callable[..., Program], manifest: Any, tmp_path: Path
) -> None:
    file = tmp_path / "audit.log"
    running = program(logs={"format": "json", "audit_file": str(file)}, proxies=["127.0.0.0/8"])
    with running.start() as operator:
        with_toy(operator, manifest)
        operator.put_service("renew", manifest("renew"))
        operator.put_service("renew", manifest("renew", params={}))
        operator.delete_service("renew")
        token = operator.create_robot(RobotCreate(name="walker")).token
        url = (running.folder / "address").read_text().strip()
        with Client(url, token) as robot:
            made = robot.create_instance(InstanceCreate(robot="walker", service="toy"))
            with pytest.raises(ApiError):
                robot.delete_robot("walker")
            robot.renew_instance(made.id)
            robot.report_gate("walker", GateReport())
            robot.instances()
            robot.delete_instance(made.id)
        with Client(url, "sky-wrong") as stranger, pytest.raises(ApiError):
            stranger.sites()
        # A proxy adds whom it has seen at the end; what stands before that may be made up.
        httpx.delete(f"{url}/api/v1/sites/local", headers={"X-Forwarded-For": "192.0.2.1, 198.51.100.9"})
        until(lambda: len(file.read_text().splitlines()) == 8)
        until(lambda: running.log.count("skytether.strangers") == 2)
    lines = [json.loads(line) for line in file.read_text().splitlines()]
    assert [(line["who"], line["method"], line.get("made", line["path"]), line["status"]) for line in lines] == [
        ("operator", "PUT", "/api/v1/catalog/toy", 201),
        ("operator", "PUT", "/api/v1/catalog/renew", 201),
        ("operator", "PUT", "/api/v1/catalog/renew", 200),
        ("operator", "DELETE", "/api/v1/catalog/renew", 204),
        ("operator", "POST", "/api/v1/robots/walker", 201),
        ("robot:walker", "POST", f"/api/v1/instances/{made.id}", 201),
        ("robot:walker", "DELETE", "/api/v1/robots/walker", 403),
        ("robot:walker", "DELETE", f"/api/v1/instances/{made.id}", 204),
    ]
    assert verify(file).lines == 8
    assert [line["address"] for line in lines] == ["127.0.0.1"] * 8
    log = [json.loads(line) for line in running.log.splitlines()]
    strangers = [line for line in log if line["logger"] == "skytether.strangers"]
    assert [(line["who"], line["method"], line["path"], line["status"], line["address"]) for line in strangers] == [
        ("nobody", "GET", "/api/v1/sites", 401, "127.0.0.1"),
        ("nobody", "DELETE", "/api/v1/sites/local", 401, "198.51.100.9"),
    ]
    assert {"time", "level", "logger", "message"} <= log[0].keys()
    assert token not in running.log + file.read_text()


def test_a_robot_that_asks_too_often_is_told_to_wait(program: Callable[..., Program]) -> None:
    running = program(limits={"requests_per_s": 1, "requests_burst": 5})
    with running.start() as operator:
        token = operator.create_robot(RobotCreate(name="walker")).token
        url = (running.folder / "address").read_text().strip()
        with httpx.Client(base_url=url, headers={"Authorization": f"Bearer {token}"}, trust_env=False) as robot:
            answers = [robot.get("/api/v1/sites") for _ in range(20)]
        refused = [answer for answer in answers if answer.status_code == 429]
        assert refused
        assert int(refused[0].headers["retry-after"]) >= 1
        assert "too many requests" in refused[0].json()["detail"]
        assert len([operator.sites() for _ in range(20)]) == 20  # an operator is not limited
    assert running.log.count("skytether.audit: robot:walker 127.0.0.1 GET /api/v1/sites 429") == len(refused)
    assert "nobody" not in running.log


def test_what_others_send_is_no_line_of_its_own() -> None:
    path = "/api/v1/sites/x\n2026-11-22 operator 10.0.0.1 DELETE /api/v1/sites/edge 204\x1b[2J"
    record = logging.LogRecord("skytether.audit", logging.INFO, "", 0, "%s", (path,), None)
    text = TextFormatter("%(levelname)s: %(message)s").format(record)
    assert text == "INFO: /api/v1/sites/x\\n2026-11-22 operator 10.0.0.1 DELETE /api/v1/sites/edge 204\\x1b[2J"
