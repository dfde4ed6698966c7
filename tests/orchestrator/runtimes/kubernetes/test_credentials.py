"""Credentials of a Kubernetes site that are replaced on disk, before an API server that knows one token at a time."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import closing
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread

import pytest

from skytether.orchestrator.runtimes.base import RuntimeFailure
from skytether.orchestrator.runtimes.kubernetes import cluster
from skytether.orchestrator.runtimes.kubernetes.cluster import Cluster, RefusedError
from skytether.orchestrator.runtimes.kubernetes.options import KubernetesOptions


class OneTokenServer(ThreadingHTTPServer):
    """Answers whoever has its token."""

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.token = "first"
        self.asked = 0


class _Handler(BaseHTTPRequestHandler):
    server: OneTokenServer

    def do_GET(self) -> None:
        self.server.asked += 1
        known = self.headers["Authorization"] == f"Bearer {self.server.token}"
        body = json.dumps({"items": []} if known else {"message": "Unauthorized", "reason": "Unauthorized"}).encode()
        self.send_response(200 if known else 401)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def server() -> Iterator[OneTokenServer]:
    with OneTokenServer() as server:
        thread = Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        yield server
        server.shutdown()
        thread.join()


@pytest.fixture
def opened(server: OneTokenServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Cluster]:
    monkeypatch.setattr(cluster, "RENEW_S", 0.0)
    (tmp_path / "token").write_text("first")
    address = f"http://127.0.0.1:{server.server_port}"
    config = {
        "apiVersion": "v1",
        "kind": "Config",
        "current-context": "c",
        "clusters": [{"name": "c", "cluster": {"server": address}}],
        "users": [{"name": "c", "user": {"tokenFile": str(tmp_path / "token")}}],
        "contexts": [{"name": "c", "context": {"cluster": "c", "user": "c"}}],
    }
    (tmp_path / "config").write_text(json.dumps(config))
    with closing(Cluster(KubernetesOptions(kubeconfig=str(tmp_path / "config")))) as opened:
        yield opened


def test_a_token_that_is_replaced_on_disk_is_taken_once_the_one_before_is_refused(
    server: OneTokenServer, opened: Cluster, tmp_path: Path
) -> None:
    assert opened.get("/api/v1/nodes") == {"items": []}
    server.token = "second"
    (tmp_path / "token").write_text("second")
    server.asked = 0
    assert opened.get("/api/v1/nodes") == {"items": []}
    assert server.asked == 2  # refused, and asked again
    assert opened.get("/api/v1/nodes") == {"items": []}
    assert server.asked == 3


def test_a_token_that_is_not_replaced_is_told_to_be_wrong_or_expired(server: OneTokenServer, opened: Cluster) -> None:
    server.token = "second"
    with pytest.raises(RefusedError, match="does not know us: the token or certificate is wrong or expired"):
        opened.get("/api/v1/nodes")


def test_a_file_that_is_being_written_is_read_again_later(
    server: OneTokenServer, opened: Cluster, tmp_path: Path
) -> None:
    server.token = "second"
    whole = (tmp_path / "config").read_text()
    (tmp_path / "config").write_text(whole[:40])
    with pytest.raises(RefusedError, match="does not know us"):
        opened.get("/api/v1/nodes")
    (tmp_path / "config").write_text(whole)
    (tmp_path / "token").write_text("second")
    assert opened.get("/api/v1/nodes") == {"items": []}


@pytest.mark.parametrize(
    "text",
    [
        "",
        "hello",
        "[]",
        "{}",
        '{"current-context": "',
        "current-context: c",
        "{current-context: c, clusters: 1, contexts: 2, users: 3}",
        "{current-context: c, contexts: [{name: c, context: {cluster: c, user: c}}], clusters: [], users: []}",
        "{current-context: c, contexts: [{name: c}], clusters: [{name: c}], users: [{name: c}]}",
    ],
)
def test_a_file_that_is_no_kubeconfig_is_refused_in_one_line(tmp_path: Path, text: str) -> None:
    path = tmp_path / "config"
    path.write_text(text)
    with pytest.raises(RuntimeFailure) as told:
        Cluster(KubernetesOptions(kubeconfig=str(path)))
    assert str(told.value).startswith(f"kubeconfig {path}")
    assert "\n" not in str(told.value)
