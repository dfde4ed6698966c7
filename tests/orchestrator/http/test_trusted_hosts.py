"""DNS rebinding: a web page whose name has become the orchestrator's address; and the page that it serves itself."""

from __future__ import annotations

import re
import socket
from pathlib import Path
from typing import Any

import httpx
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skytether.api.hosts import is_own
from skytether.orchestrator.config.settings import Settings
from skytether.orchestrator.core import Orchestrator
from skytether.orchestrator.domain.errors import InvalidError
from skytether.orchestrator.domain.validation import parse
from skytether.orchestrator.http.trusted_hosts import own_names

ALWAYS = (
    "127.0.0.1",
    "127.0.0.1:8600",
    "localhost",
    "LOCALHOST:1",
    "localhost.",
    "[::1]:8600",
    "192.0.2.7",
    "10.1.2.3:80",
)
"""As probes of Kubernetes ask (the pod's address), Prometheus with targets that are addresses, and people at home."""
PATHS = ("/healthz", "/readyz", "/metrics", "/docs", "/openapi.json", "/api/v1/sites", "/api/v1/prometheus/targets")


@pytest.mark.parametrize("path", PATHS)
def test_a_page_that_was_given_our_address_reads_nothing(served: Any, path: str) -> None:
    headers = {"Authorization": f"Bearer {served.token}", "Host": "evil.example"}
    answer = httpx.get(f"{served.url}{path}", headers=headers, trust_env=False, timeout=30)
    assert answer.status_code == 421
    assert "'hosts'" in answer.json()["detail"]
    assert "SKYTETHER_HOSTS" in answer.json()["detail"]


@pytest.mark.parametrize("host", ALWAYS)
def test_addresses_and_loopback_names_need_no_setting(served: Any, host: str) -> None:
    assert httpx.get(f"{served.url}/healthz", headers={"Host": host}, trust_env=False, timeout=30).status_code == 200


def test_names_that_were_set_are_good(served_with: Any) -> None:
    served = served_with(hosts=("Cloud.example.org", "*.robots.example"), advertise="http://orch-1:8600")
    for host in ("cloud.example.org:443", "a.robots.example", "orch-1:8600", socket.gethostname()):
        assert (
            httpx.get(f"{served.url}/healthz", headers={"Host": host}, trust_env=False, timeout=30).status_code == 200
        ), host
    for host in ("robots.example", "evilrobots.example", "cloud.example.org.evil.example", "xcloud.example.org"):
        assert (
            httpx.get(f"{served.url}/healthz", headers={"Host": host}, trust_env=False, timeout=30).status_code == 421
        ), host


@pytest.mark.parametrize(
    "host", ["", "[", "a b", "localhost:x", "localhost/evil.example", "evil@localhost", "@", "[::1"]
)
def test_what_is_no_host_is_nobodys(served: Any, host: str) -> None:
    with socket.create_connection(httpx.URL(served.url).netloc.decode().split(":"), timeout=10) as one:
        one.sendall(f"GET /healthz HTTP/1.1\r\nHost: localhost\r\nHost: {host}\r\nConnection: close\r\n\r\n".encode())
        assert one.recv(4096).split()[1] in (b"400", b"421")


@given(st.text(max_size=40))
def test_nothing_that_was_sent_raises(header: str) -> None:
    assert is_own(header, ("cloud",)) in (True, False)
    assert is_own(header, ("*",)) or not re.fullmatch(r"[a-z]+", header)


@pytest.mark.parametrize("wrong", ["http://cloud", "cloud:8600", "a b", "", "**.x"])
def test_a_wrong_name_is_refused_by_key(wrong: str) -> None:
    with pytest.raises(InvalidError, match="hosts"):
        parse(Settings, {"hosts": [wrong]}, "")


def test_where_it_listens_is_its_name() -> None:
    assert "cloud.lan" in own_names(Settings(host="cloud.lan"))


def test_the_page_loads_nothing_from_elsewhere(served: Any) -> None:
    with httpx.Client(base_url=served.url, trust_env=False, timeout=30) as http:
        page = http.get("/docs")
        sources = re.findall(r'(?:src|href)="([^"]+)"', page.text)
        assert "docs/swagger-ui-bundle.js" in sources
        for source in sources:
            if not source.startswith("data:"):
                found = http.get(f"/{source}")
                assert found.status_code == 200, source
                assert len(found.content) > 100
        assert not re.search(r"https?://", page.text)
        assert "<script>" not in page.text
        policy = page.headers["Content-Security-Policy"]
        assert policy.startswith("default-src 'none'; script-src 'self';")
        assert "http" not in policy
        assert http.get("/docs/../openapi.json").status_code in (200, 404)
        assert http.get("/redoc").status_code == 404
        assert "/docs" not in http.get("/openapi.json").json()["paths"]


def test_an_open_state_folder_is_closed(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    folder = tmp_path / "state"
    folder.mkdir(mode=0o755)
    folder.chmod(0o755)
    for name in ("state.db", "state.db-wal"):
        (folder / name).touch(0o644)
        (folder / name).chmod(0o644)
    core = Orchestrator(Settings(state_dir=folder))
    core.store.migrate()
    assert folder.stat().st_mode & 0o777 == 0o700
    assert {path.stat().st_mode & 0o077 for path in folder.iterdir() if path.is_file()} == {0}
    assert "others could read" in caplog.text
    core.store.close()


def test_a_new_database_is_nobody_elses(tmp_path: Path) -> None:
    core = Orchestrator(Settings(state_dir=tmp_path / "state"))
    core.store.migrate()
    assert {path.stat().st_mode & 0o777 for path in (tmp_path / "state").glob("state.db*")} == {0o600}
    core.store.close()
