"""The chart on the real cluster: installed, used by robots outside, upgraded, rolled back and removed."""

from __future__ import annotations

import json
import secrets
import subprocess
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
import yaml
from docker_site import Images
from helm_chart import OLDEST, Values, helm_python, objects
from helm_release import PATIENCE, HelmRelease
from kubernetes_house import be_driven
from kubernetes_site import LITTLE
from postgres_server import own_server
from value_sets import SETS

from skytether.api.client import ApiError
from skytether.api.rest import InstanceCreate
from skytether.orchestrator.scheduling.catalog import read_builtin

pytestmark = [pytest.mark.slow, pytest.mark.docker, pytest.mark.kubernetes]

_RELAY_PORT = 30870
_EVENTS = {"config": {"limits": {"events": 777}}}


@pytest.fixture
def images(docker_images: Images, orchestrator_image: str) -> Images:
    return docker_images


def catalog(images: Images) -> Values:
    """``virtual-trail`` as ``trail``, with the image of this run of the tests."""
    from importlib.metadata import entry_points

    manifests, _ = read_builtin(entry_points(group="skytether.services", name="virtual-trail"))
    document = manifests["virtual-trail"].model_dump(mode="json", by_alias=True)
    document["metadata"]["name"] = "trail"
    document["spec"] |= {"image": images.name("virtual-trail"), "entrypoint": None}
    document["spec"]["needs"] |= LITTLE
    return {"catalog": {"trail": document}}


@pytest.fixture
def volume(kubeconfig: str, tmp_path: Path) -> Iterator[str]:
    """A PersistentVolume, for the cluster has nobody who makes any."""
    name, folder = f"skytether-test-{secrets.token_hex(4)}", tmp_path / "volume"
    folder.mkdir()
    folder.chmod(0o777)
    made = {
        "apiVersion": "v1",
        "kind": "PersistentVolume",
        "metadata": {"name": name},
        "spec": {
            "capacity": {"storage": "1Gi"},
            "accessModes": ["ReadWriteOnce"],
            "persistentVolumeReclaimPolicy": "Retain",
            "hostPath": {"path": str(folder)},
        },
    }
    kubectl = ["kubectl", "--kubeconfig", kubeconfig]
    subprocess.run([*kubectl, "apply", "-f", "-"], input=json.dumps(made), text=True, check=True, capture_output=True)
    yield name
    subprocess.run([*kubectl, "delete", "pv", name, "--wait=false"], check=True, capture_output=True)


def site(**options: object) -> Values:
    return {"sites": {"cluster": {"options": {"pull": "never", **options}}}}


def test_a_release_drives_robots_outlives_its_upgrade_and_leaves_nothing(
    images: Images, kubeconfig: str, volume: str
) -> None:
    """And another one beside it, by way of its relay, notices nothing of that."""
    unique = secrets.token_hex(4)
    kept = {"persistence": {"storageClass": "", "volumeName": volume}}
    service = {"type": "NodePort", "nodePort": _RELAY_PORT}
    with ExitStack() as stack:
        first = HelmRelease(images, kubeconfig, f"skytether-chart-{unique}-a", catalog(images) | site() | kept)
        stack.callback(first.close)
        at_relay = site(reach="relay", relay=f"{first.node()}:{_RELAY_PORT}")
        values = catalog(images) | at_relay | {"persistence": {"enabled": False}}
        values |= {"relay": {"enabled": True, "service": service}, "echo": {"enabled": True}}
        second = HelmRelease(images, kubeconfig, f"skytether-chart-{unique}-b", values)
        stack.callback(second.close)
        both = (first, second)
        with ThreadPoolExecutor() as pool:
            list(pool.map(HelmRelease.install, both))
        assert not {*first.secrets().values()} & {*second.secrets().values()}

        robots = [stack.enter_context(release.robot("walker")) for release in both]
        held = [release.ask(robot, "walker", "trail") for release, robot in zip(both, robots, strict=True)]
        keys = [robot.claim_session(one.id, "0123456789abcdef") for robot, one in zip(robots, held, strict=True)]

        def drive() -> None:
            """A service that no robot is linked with for two minutes ends, and is begun anew."""
            for one, key in zip(held, keys, strict=True):
                assert one.session is not None
                be_driven(one.session, key)

        drive()
        assert held[1].session is not None
        assert held[1].session.port == _RELAY_PORT
        for release in both:
            assert len(release.pods("skytether.io/owner=demo-cluster")) == 1, "each has what it has started"

        before, pods = first.secrets(), first.pods("skytether.io/owner=demo-cluster")
        orchestrator = first.pods("app.kubernetes.io/component=orchestrator")
        first.upgrade(_EVENTS)
        drive()
        _is_as_before(first, before, pods, "walker")
        assert first.pods("app.kubernetes.io/component=orchestrator") != orchestrator, "what has changed is used"
        assert "events: 777" in first.kubectl("get", "configmap", "demo-skytether-orchestrator", "-o", "yaml")
        first.rollback()
        drive()
        _is_as_before(first, before, pods, "walker")
        assert "events: 777" not in first.kubectl("get", "configmap", "demo-skytether-orchestrator", "-o", "yaml")
        assert first.revisions() == [1, 2, 3]

        first.uninstall()
        assert first.left() == []
        beside = robots[1].get_instance(held[1].id)
        assert (beside.state, beside.restarts) == ("running", 0), beside
        assert second.pods("skytether.io/owner=demo-cluster"), "what belongs to the other is still there"
        second.uninstall()
        assert second.left() == []


def test_two_orchestrators_over_postgresql_lose_and_double_nothing_when_the_leader_is_killed(
    images: Images, kubeconfig: str, postgres_programs: None
) -> None:
    """In the midst of starts; and what the robots have is driven all the time."""
    values = catalog(images) | site() | {"database": {"existingSecret": "database"}}
    values["orchestrator"] = {"replicas": 2, "service": {"type": "NodePort"}, "resources": {"requests": {"cpu": "50m"}}}
    release = HelmRelease(images, kubeconfig, f"skytether-chart-{secrets.token_hex(4)}", values)
    with ExitStack() as stack:
        release.kubectl("create", "namespace", release.namespace)
        stack.callback(release.close)
        server = stack.enter_context(own_server(address=release.node()))
        release.kubectl("create", "secret", "generic", "database", f"--from-literal=url={server.url_from_outside}")
        release.install()
        assert len(release.pods("app.kubernetes.io/component=orchestrator")) == 2

        robot = stack.enter_context(release.robot("walker"))
        held = release.ask(robot, "walker", "trail")
        assert held.session is not None
        key = robot.claim_session(held.id, "0123456789abcdef")
        be_driven(held.session, key)
        (pod,) = release.pods("skytether.io/owner=demo-cluster")

        leader = release.leader()
        asked = [robot.create_instance(InstanceCreate(robot="walker", service="trail", lease_s=600)) for _ in range(3)]
        release.kubectl("delete", "pod", leader, "--grace-period=0", "--force")
        be_driven(held.session, key)
        for one in asked:
            assert robot.wait_running(one.id, PATIENCE).restarts == 0
        assert release.leader() != leader
        assert robot.get_instance(held.id).restarts == 0
        pods = release.pods("skytether.io/owner=demo-cluster")
        assert pod in pods
        assert len(pods) == 4

        for one in (held, *asked):
            robot.delete_instance(one.id)
        release.kubectl("delete", "secret", "database")  # which is ours, and not the chart's
        release.uninstall()
        assert release.left() == []


def _is_as_before(release: HelmRelease, secrets_: dict[str, str], pods: list[str], robot: str) -> None:
    """Secrets, robots and instances; and the token of Prometheus may measure, and nothing else."""
    assert release.secrets() == secrets_
    with release.until_it_answers() as operator:
        assert [one.name for one in operator.robots()] == [robot]
        (held,) = operator.instances()
        assert (operator.wait_running(held.id, PATIENCE).restarts, held.successor) == (0, None), held
    assert release.pods("skytether.io/owner=demo-cluster") == pods
    with release.client(release.secret("metrics.token")) as prometheus:
        assert 'skytether_site_up{site="cluster"} 1.0' in prometheus.metrics()
        with pytest.raises(ApiError, match="its scopes are: metrics"):
            prometheus.robots()


@pytest.mark.parametrize("values", ["more", "relay", "storage", "ingress", "fenced", "tls", "pinned"])
def test_the_oldest_cluster_takes_what_is_rendered_for_it(values: str, kubeconfig: str) -> None:
    """Its own API server says so: `kubernetes-validate` knows none as old."""
    known = [one for one in objects(SETS[values], OLDEST).values() if "coreos" not in one["apiVersion"]]
    for one in known:
        if one["metadata"].get("namespace"):
            one["metadata"]["namespace"] = "default"
    command = ["kubectl", "--kubeconfig", kubeconfig, "apply", "--dry-run=server", "--validate=true", "-f", "-"]
    done = subprocess.run(command, input=yaml.safe_dump_all(known), text=True, capture_output=True)
    assert done.returncode == 0, done.stderr
    assert len(done.stdout.splitlines()) == len(known)


@pytest.mark.parametrize(
    ("values", "says"),
    [
        ({"orchestrator": {"replica": 2}}, "at '/orchestrator': additional properties 'replica' not allowed"),
        ({"orchestrator": {"replicas": 2}}, "SQLite serves one: name the Secret"),
    ],
)
def test_what_is_wrong_is_refused_and_leaves_nothing(kubeconfig: str, values: dict[str, Any], says: str) -> None:
    name = f"skytether-chart-{secrets.token_hex(4)}"
    release = HelmRelease(Images("none/", [], Path()), kubeconfig, name, {})
    release.values = values
    with pytest.raises(helm_python.HelmError) as refused:
        release.install()
    assert says in str(refused.value)
    assert release.left() == []
    release.close()
