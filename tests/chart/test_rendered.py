"""The chart, rendered by Helm's own engine, and what comes of the values."""

from __future__ import annotations

import base64
import json
import re
import subprocess
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import yaml
from helm_chart import ABSENT, CHART, NEWEST, OLDEST, ROOT, Object, at, faults, files, objects, script
from value_sets import CASES, SETS, UPSTREAM

from skytether.api.rest import SiteCreate
from skytether.bridge.relay_config import RelayConfig
from skytether.orchestrator.config.settings import Settings
from skytether.orchestrator.config.sites_file import read_sites, stored_as
from skytether.orchestrator.config.sources import load
from skytether.orchestrator.domain.security import Secrets, new_token
from skytether.orchestrator.nodes.authority import Authority
from skytether.orchestrator.runtimes.kubernetes import KubernetesRuntime

_OTHERS = ("monitoring.coreos.com", "gateway.networking.k8s.io")
_GONE = {"v1.20.0": ("policy/v1", "autoscaling/v2"), "v1.37.0": ("policy/v1beta1", "autoscaling/v2beta2")}
"""By cluster, what it does not know yet, or any more."""


@cache
def rendered(values: str, kube: str = NEWEST) -> dict[str, Object]:
    return objects(SETS[values], kube)


def test_there_are_enough_of_them() -> None:
    assert len(SETS) >= 14
    assert len(CASES) >= 160
    assert {values for values, *_ in CASES} == set(SETS)


@pytest.mark.parametrize("values", SETS)
def test_what_the_values_say_is_what_is_rendered(values: str) -> None:
    wrong = []
    for _, what, path, expected in (case for case in CASES if case[0] == values):
        found: Any = at(rendered(values).get(what, ABSENT), path) if path else rendered(values).get(what)
        if found != expected:
            wrong.append(f"{what}: {path}: {found!r}, not {expected!r}")
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("values", SETS)
@pytest.mark.parametrize("kube", [OLDEST, "v1.25.0", NEWEST])
def test_a_cluster_of_any_version_takes_it(values: str, kube: str) -> None:
    for what, one in rendered(values, kube).items():
        assert one["apiVersion"] not in _GONE.get(kube, ()), what
        if kube != OLDEST and not one["apiVersion"].startswith(_OTHERS):
            assert faults(one, kube[1:5]) == [], what


def test_an_older_gateway_api_gets_its_own_version() -> None:
    for apis, version in (((), "v1"), (("gateway.networking.k8s.io/v1beta1",), "v1beta1")):
        made = objects(SETS["gateway"], apis=apis)["HTTPRoute/orchestrator"]
        assert made["apiVersion"] == f"gateway.networking.k8s.io/{version}"


def _pods(found: dict[str, Object]) -> dict[str, Object]:
    return {what: one["spec"]["template"] for what, one in found.items() if one["kind"] in ("Deployment", "Job")}


@pytest.mark.parametrize("values", SETS)
def test_all_pods_pass_pod_security_restricted(values: str) -> None:
    """https://kubernetes.io/docs/concepts/security/pod-security-standards/#restricted"""
    for what, pod in _pods(rendered(values)).items():
        spec = pod["spec"]
        assert spec["securityContext"]["runAsNonRoot"] is True, what
        assert spec["securityContext"]["seccompProfile"] == {"type": "RuntimeDefault"}, what
        assert not {"hostNetwork", "hostPID", "hostIPC"} & spec.keys(), what
        for volume in spec["volumes"]:
            assert volume.keys() - {"name"} <= {"configMap", "secret", "emptyDir", "persistentVolumeClaim"}, what
        for box in [*spec["containers"], *spec.get("initContainers", ())]:
            held = box["securityContext"]
            assert held["allowPrivilegeEscalation"] is False, what
            assert held["capabilities"] == {"drop": ["ALL"]}, what
            assert held["readOnlyRootFilesystem"] is True, what
            assert "privileged" not in held, what
            assert all("hostPort" not in port for port in box.get("ports", ())), what


@pytest.mark.parametrize("values", SETS)
def test_what_belongs_together_finds_each_other(values: str) -> None:
    """Services, budgets, policies and monitors select pods that are there; mounts have volumes; accounts exist."""
    found = rendered(values)
    pods = _pods(found)
    labels = [pod["metadata"]["labels"] for pod in pods.values()]
    for what, one in found.items():
        spec = one.get("spec", {})
        chosen = {
            "Service": lambda spec=spec: spec["selector"],
            "PodDisruptionBudget": lambda spec=spec: spec["selector"]["matchLabels"],
            "NetworkPolicy": lambda spec=spec: spec["podSelector"]["matchLabels"],
            "Deployment": lambda spec=spec: spec["selector"]["matchLabels"],
        }.get(one["kind"])
        if chosen:
            assert sum(chosen().items() <= given.items() for given in labels) == 1, what
    for what, pod in pods.items():
        volumes = {volume["name"] for volume in pod["spec"]["volumes"]}
        for box in [*pod["spec"]["containers"], *pod["spec"].get("initContainers", ())]:
            assert {mount["name"] for mount in box["volumeMounts"]} <= volumes, what


def test_everything_has_the_labels_and_annotations_that_were_given() -> None:
    found = rendered("pinned")
    for what, one in found.items():
        assert one["metadata"]["labels"]["cost-centre"] == "7", what
        assert one["metadata"]["annotations"]["owner"] == "ward-3", what
    for what, pod in _pods(found).items():
        assert pod["metadata"]["labels"]["cost-centre"] == "7", what


def test_labels_that_are_given_do_not_hide_what_pods_are_found_by() -> None:
    given = {"app.kubernetes.io/component": "mine"}
    made = objects({"labels": given, "orchestrator": {"podLabels": given}})["Deployment/orchestrator"]
    assert made["spec"]["template"]["metadata"]["labels"]["app.kubernetes.io/component"] == "orchestrator"


@pytest.mark.parametrize("values", SETS)
def test_the_orchestrator_understands_its_configuration(values: str, tmp_path: Path) -> None:
    found = rendered(values)
    data = found["ConfigMap/orchestrator"]["data"]
    settings = Settings.model_validate(yaml.safe_load(data["orchestrator.yaml"]))
    assert settings.insecure_http is (settings.tls.certificate is None)
    assert not settings.local_site
    (tmp_path / "sites.yaml").write_text(data["sites.yaml"])
    sites = {site.name: site for site in read_sites(tmp_path / "sites.yaml")}
    assert sites.keys() == {"cluster", *SETS[values].get("sites", {})} - (
        {"cluster"} if values == "no-sites" else set()
    )
    for site in sites.values():
        if site.runtime == "kubernetes":
            stored_as(site, None, KubernetesRuntime)
    if "Deployment/relay" in found:
        RelayConfig.model_validate(yaml.safe_load(found["ConfigMap/relay"]["data"]["relay.yaml"]))


def test_sites_in_this_cluster_are_told_where_they_are_and_by_which_name_their_pods_are_found(tmp_path: Path) -> None:
    (tmp_path / "sites.yaml").write_text(rendered("sites")["ConfigMap/orchestrator"]["data"]["sites.yaml"])
    sites = {site.name: site.options for site in read_sites(tmp_path / "sites.yaml")}
    assert sites["cluster"] == {"reach": "pod", "cpu": 4, "memory_mb": 8192, "namespace": "ns", "owner": "demo-cluster"}
    assert sites["ward"] == {"namespace": "ward", "owner": "demo-ward"}
    assert sites["far"] == {"kubeconfig": "/etc/far/config"}
    assert sites["engine"] == {"engine": "ssh://docker@192.0.2.7"}
    removed = yaml.safe_load(rendered("sites")["ConfigMap/uninstall"]["data"]["sites.yaml"])
    assert removed.keys() == {"cluster", "ward"}


def test_a_site_without_a_word_is_one_that_this_cluster_runs(tmp_path: Path) -> None:
    (tmp_path / "sites.yaml").write_text(rendered("defaults")["ConfigMap/orchestrator"]["data"]["sites.yaml"])
    (site,) = read_sites(tmp_path / "sites.yaml")
    options = {"reach": "nodeport", "namespace": "ns", "owner": "demo-cluster"}
    assert site == SiteCreate(name="cluster", tier="edge", runtime="kubernetes", options=options)


def test_the_relay_follows_the_pods_of_the_release_unless_it_is_told_otherwise() -> None:
    def told(values: str) -> Any:
        return yaml.safe_load(rendered(values)["ConfigMap/relay"]["data"]["relay.yaml"])

    assert told("relay") == {"listen": {"host": "0.0.0.0", "port": 8700}, "kubernetes": {"namespace": "ns"}}
    assert told("relay-fixed") == {"listen": {"host": "0.0.0.0", "port": 9000}, **UPSTREAM}


def test_names_by_which_it_is_asked() -> None:
    data = rendered("ingress")["ConfigMap/orchestrator"]["data"]
    hosts = yaml.safe_load(data["orchestrator.yaml"])["hosts"]
    inside = "demo-skytether-orchestrator"
    assert hosts[:4] == [inside, f"{inside}.ns", f"{inside}.ns.svc", f"{inside}.ns.svc.cluster.local"]
    assert hosts[4:] == ["cloud.example.org", "b.example.org", "c.example.org"]


def test_the_account_may_what_the_documentation_says_and_nothing_else() -> None:
    text = (ROOT / "docs" / "kubernetes.md").read_text().partition("## What the account may do")[::2]
    role, cluster_role = yaml.safe_load_all(text[1].split("```")[1])
    relay = yaml.safe_load(text[0].split("```")[-2])
    assert rendered("relay")["Role/relay"]["rules"] == relay["rules"]
    found = rendered("defaults")
    assert found["Role/orchestrator"]["rules"] == role["rules"]
    assert found["Role/uninstall"]["rules"] == role["rules"]
    assert found["ClusterRole/nodes"]["rules"] == cluster_role["rules"]


def test_rules_and_dashboard_are_those_of_the_project() -> None:
    images = ROOT / "images"
    for name, original in (
        ("rules.yml", "prometheus/rules.yml"),
        ("dashboard.json", "grafana/dashboards/skytether.json"),
    ):
        assert (CHART / "files" / name).resolve() == images / original, "it is the same file, which Helm follows"
    found = rendered("monitoring")
    assert found["PrometheusRule/orchestrator"]["spec"] == yaml.safe_load((images / "prometheus/rules.yml").read_text())
    given = json.loads(found["ConfigMap/dashboard"]["data"]["skytether.json"])
    text = (images / "grafana/dashboards/skytether.json").read_text()
    assert given == json.loads(text.replace("skytether-prometheus", "thanos"))
    assert "thanos" not in text


def test_a_change_of_the_configuration_begins_new_pods() -> None:
    def sums(values: dict[str, Any]) -> set[str]:
        found = objects(values)
        return {
            pod["metadata"]["annotations"]["checksum/config"]
            for what, pod in _pods(found).items()
            if what != "Job/uninstall"
        }

    before = sums({})
    assert before == sums({"orchestrator": {"service": {"type": "NodePort"}}})
    assert before != sums({"config": {"limits": {"events": 7}}})
    assert before != sums({"sites": {"cluster": {"cost": 3}}})
    assert before != sums({"catalog": SETS["sites"]["catalog"]})


def test_secrets_are_made_of_256_random_bits_and_never_the_same() -> None:
    made = [objects({})["Secret/secrets"]["data"] for _ in range(2)]
    plain = [{key: base64.b64decode(value).decode() for key, value in one.items()} for one in made]
    assert plain[0].keys() == {"secret.key", "operator.token", "metrics.token"}
    assert len({*plain[0].values(), *plain[1].values()}) == 6
    for one in plain:
        assert len(one["secret.key"]) == 64
        for name in ("operator.token", "metrics.token"):
            assert len(one[name].strip()) == len(new_token())
            assert one[name].startswith("sky-")


def test_machines_that_join_find_the_door_and_know_it_by_a_key_that_outlives_the_pod(tmp_path: Path) -> None:
    found = rendered("nodes")
    given = yaml.safe_load(found["ConfigMap/orchestrator"]["data"]["orchestrator.yaml"])["nodes"]
    nodes = Settings.model_validate({"nodes": given}).nodes
    assert (nodes.port, nodes.host, nodes.certificate_days) == (8603, "0.0.0.0", 7)
    assert nodes.urls == ("https://nodes.example.org:443",)
    keys = [base64.b64decode(objects(SETS["nodes"])["Secret/secrets"]["data"]["nodes.key"]) for _ in range(2)]
    assert keys[0] != keys[1]
    (tmp_path / "nodes.key").write_bytes(keys[0])
    (tmp_path / "nodes.key").chmod(0o600)
    pins = {Authority(tmp_path, lambda: 1.8e9).pin for _ in range(2)}
    assert len(pins) == 1
    script = at(found["Deployment/orchestrator"], "spec template spec initContainers secrets args 0")
    script = script.replace("/from/", f"{tmp_path}/").replace("/run/", f"{tmp_path}/run/")
    (tmp_path / "secrets").mkdir()
    refused = subprocess.run(["/bin/sh", "-ceu", script], capture_output=True, text=True)
    assert (refused.returncode, "the Secret demo-skytether-secrets has no nodes.key" in refused.stderr) == (1, True)
    assert not (tmp_path / "run").exists()
    assert "skytether site invite ward" in files(SETS["nodes"])["NOTES.txt"]


def test_a_pods_own_copies_of_secrets_are_its_own_alone_and_the_database_is_whatever_its_secret_says(
    tmp_path: Path,
) -> None:
    """The script that runs before the orchestrator, with the folders that it is given in its pod."""
    found = rendered("postgres")
    box = at(found["Deployment/orchestrator"], "spec template spec initContainers secrets")
    address = "postgresql://sky:it's:#\"50%25@db/sky?sslmode=require"
    given = {
        "from/secrets/secret.key": "k" * 64,
        "from/secrets/operator.token": new_token(),
        "from/secrets/metrics.token": new_token(),
        "from/database": address,
        "etc/skytether/orchestrator.yaml": found["ConfigMap/orchestrator"]["data"]["orchestrator.yaml"],
    }
    (tmp_path / "run/skytether").mkdir(parents=True)
    for name, text in given.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    script = re.sub(r"(?<![\w/])/(from|etc|run)/", rf"{tmp_path}/\1/", box["args"][0])
    for _ in range(2):  # a container may be started again
        subprocess.run([*box["command"], script], check=True)
    made = tmp_path / "run/skytether"
    assert load(made / "orchestrator.yaml", {}, {}).database_url == address
    assert made.joinpath("orchestrator.yaml").stat().st_mode & 0o777 == 0o600
    held = Secrets(made / "secrets")
    assert held.is_operator(given["from/secrets/operator.token"])
    assert held.may_measure(given["from/secrets/metrics.token"])


def test_nothing_secret_is_in_an_argument_or_a_variable() -> None:
    text = json.dumps(_pods(rendered("postgres")))
    assert "secretKeyRef" not in text
    assert "postgresql://" not in text


@pytest.mark.parametrize(
    ("values", "says"),
    [
        ({"orchestrator": {"replicas": 2}}, "orchestrator.replicas is 2, and SQLite serves one: name the Secret"),
        (
            {**SETS["postgres"], "nodes": {"enabled": True}},
            "orchestrator.replicas is 3 with nodes.enabled: a node is linked with each orchestrator at an address of",
        ),
        ({"ingress": {"enabled": True}}, "ingress.enabled: name at least one of ingress.hosts"),
        ({"gateway": {"enabled": True}}, "gateway.enabled: name the Gateway in gateway.parentRefs"),
        (
            {"relay": {**SETS["relay"]["relay"], "autoscaling": {"enabled": True, "minReplicas": 9}}},
            "relay.autoscaling: minReplicas (9) is above maxReplicas (8)",
        ),
        ({"image": {"tag": ""}}, "image: give a tag or a digest"),
        (
            {"catalog": {"other": SETS["sites"]["catalog"]["trail"]}},
            "catalog.other: its manifest's metadata.name is 'trail': give both the same name",
        ),
    ],
)
def test_what_cannot_be_is_refused_in_a_sentence(values: dict[str, Any], says: str) -> None:
    with pytest.raises(Exception, match="error") as refused:
        objects(values)
    assert says in str(refused.value)


def test_the_notes_tell_the_next_command() -> None:
    said = files({})["NOTES.txt"]
    assert (
        "kubectl -n ns exec deployment/demo-skytether-orchestrator -c orchestrator -- skytether robot add walker"
        in said
    )
    assert "kubectl -n ns port-forward service/demo-skytether-orchestrator 8600:8600" in said
    assert "Look at these values" not in said
    assert "The API: https://cloud.example.org\n" in files(SETS["ingress"])["NOTES.txt"]
    assert f"under {script().metadata()['version']}" in files({}, upgrade=True)["NOTES.txt"]


def test_the_notes_say_what_an_old_cluster_does_not_know() -> None:
    assert "orchestrator.service.loadBalancerClass is left out" in files(SETS["tls"], OLDEST)["NOTES.txt"]
    assert "is left out" not in files(SETS["tls"], NEWEST)["NOTES.txt"]


@pytest.mark.parametrize(
    ("values", "says"),
    [
        ({"sites": {"cluster": None}}, "sites: there is none, so no instance can run"),
        (
            {"persistence": {"enabled": False}},
            "persistence.enabled is false: robots, tokens and instances are forgotten",
        ),
        ({"database": {"existingSecret": "pg"}}, "orchestrator.replicas is 1: PostgreSQL lets two share the work"),
        ({"ingress": {"enabled": True, "hosts": ["a"]}}, "ingress.tls is empty: robots and commands ask no http://"),
        ({"ingress": {"enabled": True, "hosts": ["a"]}}, "config.proxies is empty: behind an ingress or a gateway"),
        ({"orchestrator": {"service": {"type": "NodePort"}}}, "type is NodePort without orchestrator.tlsSecret"),
        ({"config": {"open_metrics": True}}, "config.open_metrics is true: whoever reaches the API"),
        ({"image": {"tag": "latest"}}, "image.tag is 'latest'"),
        ({"sites": {"cluster": {"options": {"reach": "hostport"}}}}, "sites.cluster.options.reach is hostport"),
        ({"rbac": {"nodes": False}}, "sites.cluster: without rbac.nodes it wants options.cpu and options.memory_mb"),
        ({"rbac": {"nodes": False}}, "no node's external address is known; give options.advertise_host"),
        ({"rbac": {"create": False}}, "rbac.create is false: give the service account demo-skytether-orchestrator"),
        ({"prometheusRule": {"enabled": True}}, "prometheusRule is enabled and serviceMonitor is not"),
        (
            {"database": {"existingSecret": "pg"}, "persistence": {"existingClaim": "a"}},
            "persistence.existingClaim is not used",
        ),
        (
            {"nodes": {"enabled": True}},
            "nodes.enabled: `helm uninstall` does not reach what runs at machines that joined",
        ),
        ({"relay": {"enabled": True}}, "relay is enabled and no site uses it"),
        (
            {"relay": {**SETS["relay"]["relay"], "resources": {"requests": None}}},
            "relay.autoscaling has nothing to go by",
        ),
    ],
)
def test_the_notes_say_what_will_not_do_as_it_seems(values: dict[str, Any], says: str) -> None:
    assert says in files(values)["NOTES.txt"].partition("Look at these values:")[2]
