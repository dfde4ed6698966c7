"""Refusals of a real cluster, and of what only looks like one: each says what to do, and leaves nothing behind."""

from __future__ import annotations

import base64
import json
import ssl
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import docker_runs
import pytest
from certificates import certificate
from docker_runs import launch
from kubernetes_site import KubernetesSite

from skytether.orchestrator.runtimes.base import Phase, RuntimeFailure

pytestmark = [pytest.mark.slow, pytest.mark.docker, pytest.mark.kubernetes]

until = partial(docker_runs.until, patience_s=90.0)
POD_SECURITY = 'violates PodSecurity "restricted:latest": hostPort (container "service" uses hostPort 20000)'


@contextmanager
def answering(answer: Any, tls: tuple[Path, Path] | None = None) -> Iterator[int]:
    """A server of loopback that answers JSON; its port. ``answer``: of method, path and document."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.do_POST()

        def do_POST(self) -> None:
            asked = self.rfile.read(int(self.headers.get("Content-Length", 0)))
            body = json.dumps(answer(self.path, json.loads(asked or b"{}"))).encode()
            self.send_response(200)
            self.send_header("Content-Type", "application/json")
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *_: object) -> None:
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        if tls is not None:
            context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
            context.load_cert_chain(*tls)
            server.socket = context.wrap_socket(server.socket, server_side=True)
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        yield server.server_address[1]
        server.shutdown()
        thread.join()


@contextmanager
def webhook(site: KubernetesSite, tls: tuple[Path, Path], port: int) -> Iterator[None]:
    """Have the cluster ask who listens there of each new pod in the site's namespace, and of nothing else."""
    name = site.namespace
    rule = {"apiGroups": [""], "apiVersions": ["v1"], "operations": ["CREATE"], "resources": ["pods"]}
    authority = base64.b64encode(tls[0].read_bytes()).decode()
    hook = {
        "name": "careful.example.org",
        "clientConfig": {"url": f"https://127.0.0.1:{port}/", "caBundle": authority},
        "rules": [rule],
        "namespaceSelector": {"matchLabels": {"webhook": name}},
        "admissionReviewVersions": ["v1"],
        "sideEffects": "None",
        "timeoutSeconds": 5,
    }
    kind = {"apiVersion": "admissionregistration.k8s.io/v1", "kind": "ValidatingWebhookConfiguration"}
    site.kubectl("label", "namespace", name, f"webhook={name}", "--overwrite")
    site.kubectl("create", "-f", "-", given=json.dumps({**kind, "metadata": {"name": name}, "webhooks": [hook]}))
    try:
        yield
    finally:
        site.kubectl("delete", "validatingwebhookconfiguration", name)


def test_a_webhook_that_refuses_says_why_and_one_that_is_silent_is_named(
    kubernetes_site: KubernetesSite, tmp_path: Path
) -> None:
    says = ["robots rest on Sundays"]

    def deny(_: str, review: Any) -> Any:
        denied = {"uid": review["request"]["uid"], "allowed": False, "status": {"code": 403, "message": says[0]}}
        return {**review, "response": denied}

    tls = certificate(tmp_path)
    with closing(kubernetes_site.open(tmp_path)) as runtime:
        with answering(deny, tls) as port, webhook(kubernetes_site, tls, port):
            # The API server learns of a new webhook a moment later: what it let through until then is removed.
            until(lambda: told(runtime, kubernetes_site, "denied the request: robots rest on Sundays"))
            says[0] = POD_SECURITY
            assert told(runtime, kubernetes_site, "hostPort 20000): give the site another option 'reach'")
        with webhook(kubernetes_site, tls, port):
            until(lambda: told(runtime, kubernetes_site, 'failed calling webhook "careful.example.org"'))
        assert runtime.observe() == {}
    assert kubernetes_site.there("secrets", "skytether.io/owner") == []


def told(runtime: Any, site: KubernetesSite, words: str) -> bool:
    """Whether a start is refused with these words; it is undone if not."""
    try:
        runtime.start(launch(site))
    except RuntimeFailure as error:
        return words in str(error)
    runtime.remove("i1")
    return False


@pytest.mark.whole_cluster
def test_a_taint_is_named_where_it_keeps_pods_away(kubernetes_site: KubernetesSite, tmp_path: Path) -> None:
    node = kubernetes_site.kubectl("get", "nodes", "-o", "jsonpath={.items[0].metadata.name}")
    sized = {"cpu": 2, "memory_mb": 1024}
    with (
        closing(kubernetes_site.open(tmp_path, **sized)) as told_size,
        closing(kubernetes_site.open(tmp_path)) as runtime,
    ):
        kubernetes_site.kubectl("taint", "nodes", node, "skytether-test=yes:NoSchedule")
        try:
            told_size.start(launch(kubernetes_site))
            until(lambda: runtime.capacity() and runtime.blocked())
            assert f"{node} has the taint skytether-test=yes:NoSchedule" in runtime.blocked()
            waiting = until(lambda: (seen := told_size.observe()["i1"]).detail and seen)
        finally:
            kubernetes_site.kubectl("taint", "nodes", node, "skytether-test-")
        assert waiting.phase is Phase.STARTING
        assert "had taint {skytether-test: yes}" in waiting.detail
        until(lambda: told_size.observe()["i1"].phase is Phase.RUNNING)
        until(lambda: runtime.capacity() and not runtime.blocked())


def test_a_cluster_that_is_too_old_is_refused_by_its_version(kubernetes_site: KubernetesSite, tmp_path: Path) -> None:
    def old(path: str, _: Any) -> Any:
        empty = {"items": [], "metadata": {"resourceVersion": "1"}}
        return {"major": "1", "minor": "18+"} if path == "/version" else empty

    with answering(old) as port:
        user, cluster = {"token": "t"}, {"server": f"http://127.0.0.1:{port}"}
        with closing(kubernetes_site.open(tmp_path, kubeconfig=kubeconfig(tmp_path, cluster, user))) as runtime:
            for _ in range(2):
                with pytest.raises(RuntimeFailure, match=r"has Kubernetes 1\.18, and 1\.20 is the oldest that can be"):
                    runtime.capacity()


def test_a_certificate_that_has_expired_is_told_with_its_date(kubernetes_site: KubernetesSite, tmp_path: Path) -> None:
    cert, key = certificate(tmp_path, days=-1)
    real = json.loads(kubernetes_site.kubectl("config", "view", "--raw", "-o", "json"))["clusters"][0]["cluster"]
    user = {"client-certificate": str(cert), "client-key": str(key)}
    with (
        closing(kubernetes_site.open(tmp_path, kubeconfig=kubeconfig(tmp_path, real, user))) as runtime,
        pytest.raises(RuntimeFailure, match="the API server does not know us: the certificate expired at 20"),
    ):
        runtime.observe()


def kubeconfig(folder: Path, cluster: Any, user: Any) -> str:
    path = folder / "made.kubeconfig"
    document = {
        "clusters": [{"name": "c", "cluster": cluster}],
        "users": [{"name": "u", "user": user}],
        "contexts": [{"name": "x", "context": {"cluster": "c", "user": "u"}}],
        "current-context": "x",
    }
    path.write_text(json.dumps(document))
    return str(path)
