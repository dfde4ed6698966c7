"""What is asked of an API server, and what its answers mean, as data: no cluster needed."""

from __future__ import annotations

import base64
import json
from dataclasses import replace
from typing import Any

import pytest
from pydantic import ValidationError

from skytether.api.grant import Grant
from skytether.api.manifest import Opening, ServiceSpec
from skytether.orchestrator.runtimes.base import Launch, Observation, Phase
from skytether.orchestrator.runtimes.containers import data_name
from skytether.orchestrator.runtimes.kubernetes.objects import (
    claim,
    disruption_budget,
    free_port,
    openings_policy,
    pod,
    refusal,
    secret,
    site_policy,
    usual_port,
)
from skytether.orchestrator.runtimes.kubernetes.options import KubernetesOptions
from skytether.orchestrator.runtimes.kubernetes.pods import Pods
from skytether.orchestrator.runtimes.kubernetes.relayed import routes_of
from skytether.orchestrator.runtimes.kubernetes.resize import quantity
from skytether.orchestrator.runtimes.kubernetes.seen import PodState, observation, parse

KEY = base64.b64encode(bytes(range(32))).decode()


def options(**given: Any) -> KubernetesOptions:
    return KubernetesOptions.model_validate({"kubeconfig": "/k", **given})


def launch(attempt: int = 1, **given: Any) -> Launch:
    grant = Grant(
        instance="i1", service="toy", robot="walker", session_id="00112233445566aa", session_key=KEY, topics=()
    )
    return Launch(attempt, ServiceSpec.model_validate({"image": "toy:1", **given}), grant)


def made(**given: Any) -> dict[str, Any]:
    """A pod as the API server gives it back."""
    body = pod(launch(**given), options(), "o1", 20_000, {})
    body["metadata"] |= {"uid": "u1", "resourceVersion": "7", "creationTimestamp": "2026-11-25T07:00:00Z"}
    return body


def seen(state: dict[str, Any] | None = None, phase: str = "Running", **status: Any) -> PodState:
    container = {"name": "service", "state": state or {}, "started": status.pop("started", False)}
    container["ready"] = status.pop("ready", False)
    told = {"phase": phase, "hostIP": "10.0.0.5", "podIP": "10.1.0.9", "containerStatuses": [container], **status}
    found = parse({**made(), "status": told})
    assert found is not None
    return found


def looked_at(found: PodState, external: str = "") -> Observation:
    return observation(found, options(), external)


def test_a_pod_has_no_rights_and_is_found_by_its_labels() -> None:
    body = pod(
        launch(3, needs={"cpu": 0.5, "memory_mb": 64, "gpu": 1}), options(labels={"team": "a"}), "o1", 20_007, {}
    )
    spec, container = body["spec"], body["spec"]["containers"][0]
    assert body["metadata"]["name"] == "skytether-o1-i1-3"
    labels = body["metadata"]["labels"]
    assert labels["skytether.io/owner"] == "o1"
    assert labels["skytether.io/instance"] == "i1"
    assert labels["team"] == "a"
    assert (spec["restartPolicy"], spec["automountServiceAccountToken"]) == ("Never", False)
    # Pod Security `restricted`:
    assert spec["securityContext"]["runAsNonRoot"]
    assert spec["securityContext"]["seccompProfile"] == {"type": "RuntimeDefault"}
    assert container["securityContext"] == {
        "allowPrivilegeEscalation": False,
        "readOnlyRootFilesystem": True,
        "capabilities": {"drop": ["ALL"]},
    }
    assert container["resources"] == {
        "requests": {"cpu": "500m", "memory": "64Mi", "nvidia.com/gpu": "1"},
        "limits": {"cpu": "1000m", "memory": "64Mi", "nvidia.com/gpu": "1"},
    }
    assert container["ports"] == [{"containerPort": 7600, "protocol": "UDP", "hostPort": 20_007}]


def test_no_label_of_the_site_takes_the_place_of_ours() -> None:
    body = pod(launch(), options(labels={"skytether.io/owner": "other"}), "o1", None, {})
    assert body["metadata"]["labels"]["skytether.io/owner"] == "o1"


def test_where_pods_go_and_how_images_come_are_the_sites_options() -> None:
    toleration = {"key": "robots", "operator": "Exists"}
    given = options(
        node_selector={"zone": "a"},
        tolerations=[toleration],
        priority_class="high",
        image_pull_secrets=["registry"],
        pull="never",
        environment={"TZ": "UTC"},
    )
    spec = pod(launch(), given, "o1", None, {})["spec"]
    assert spec["nodeSelector"] == {"zone": "a"}
    assert spec["tolerations"] == [toleration]
    assert spec["priorityClassName"] == "high"
    assert spec["imagePullSecrets"] == [{"name": "registry"}]
    assert spec["containers"][0]["imagePullPolicy"] == "Never"
    assert {"name": "TZ", "value": "UTC"} in spec["containers"][0]["env"]


@pytest.mark.parametrize("image", ["skytether/virtual-trail:1", "docker.io/skytether/recorder", "skytether/x"])
def test_our_own_names_are_never_pulled_and_others_are(image: str) -> None:
    def policy(name: str) -> str:
        return str(
            pod(launch(image=name), options(pull="always"), "o1", None, {})["spec"]["containers"][0]["imagePullPolicy"]
        )

    assert policy(image) == "Never"
    for owned in (f"{image}@sha256:{'a' * 64}", "registry.example/skytether/x:1", "example/toy:1"):
        assert policy(owned) == "Always"


def test_the_key_is_in_the_secret_alone_which_goes_with_its_pod() -> None:
    document = made()
    assert KEY not in json.dumps(document)
    grant = secret(launch(), "o1", document)
    assert grant["metadata"]["name"] == document["metadata"]["name"]
    assert grant["metadata"]["ownerReferences"][0]["uid"] == "u1"
    told = Grant.model_validate_json(base64.b64decode(grant["data"]["grant.json"]))
    assert (told.session_key, told.bind_port, told.health_port) == (KEY, 7600, 7601)


def test_data_goes_with_its_run_or_is_kept_for_a_robot_and_a_service() -> None:
    def volume(given: KubernetesOptions) -> Any:
        return next(one for one in pod(launch(), given, "o1", None, {})["spec"]["volumes"] if one["name"] == "data")

    assert volume(options(data_mb=64)) == {"name": "data", "emptyDir": {"sizeLimit": "64Mi"}}
    kept = options(data_mb=64, keep_data=True, storage_class="fast")
    name = "skytether-o1-data-walker-toy"
    assert volume(kept) == {"name": "data", "persistentVolumeClaim": {"claimName": name}}
    assert claim(launch(), kept, "o1") == {
        "apiVersion": "v1",
        "kind": "PersistentVolumeClaim",
        "metadata": {
            "name": name,
            "labels": {
                "app.kubernetes.io/managed-by": "skytether",
                "app.kubernetes.io/part-of": "skytether",
                "skytether.io/owner": "o1",
                "skytether.io/robot": "walker",
                "skytether.io/service": "toy",
            },
        },
        "spec": {
            "accessModes": ["ReadWriteOnce"],
            "resources": {"requests": {"storage": "64Mi"}},
            "storageClassName": "fast",
        },
    }
    by_default = claim(launch(), options(keep_data=True, storage_access="ReadWriteMany"), "o1")["spec"]
    assert "storageClassName" not in by_default
    assert by_default["accessModes"] == ["ReadWriteMany"]


def test_names_of_data_do_not_collide() -> None:
    assert data_name("o1", "a-b", "c") != data_name("o1", "a", "b-c")
    assert data_name("o1", "a-b", "c") == "skytether-o1-data-a-b.c"


def test_what_a_claim_waits_for_is_said_with_where_to_look() -> None:
    document = made()
    document["spec"]["volumes"] = pod(launch(), options(keep_data=True), "o1", None, {})["spec"]["volumes"]
    message = "0/1 nodes are available: 1 pod has unbound immediate PersistentVolumeClaims."
    condition = {"type": "PodScheduled", "status": "False", "message": message}
    found = parse({**document, "status": {"phase": "Pending", "conditions": [condition]}})
    assert found is not None
    assert looked_at(found).detail == (
        f"no node takes it: {message} "
        "('kubectl describe pvc skytether-o1-data-walker-toy' says why; site's option 'storage_class')"
    )


def test_a_pod_reaches_what_its_site_opens_and_knows_it_by_name() -> None:
    openings = {
        Opening("db.example.org", 5432): ("192.0.2.7", "2001:db8::7"),
        Opening("10.0.0.0/8", 53, "udp"): ("10.0.0.0/8",),
    }
    body = pod(launch(), options(), "o1", None, openings)
    assert body["spec"]["hostAliases"] == [
        {"ip": "192.0.2.7", "hostnames": ["db.example.org"]},
        {"ip": "2001:db8::7", "hostnames": ["db.example.org"]},
    ]
    policy = openings_policy(openings, made(), "o1")
    assert policy["spec"]["podSelector"]["matchLabels"]["skytether.io/attempt"] == "1"
    assert policy["spec"]["egress"] == [
        {
            "to": [{"ipBlock": {"cidr": "192.0.2.7/32"}}, {"ipBlock": {"cidr": "2001:db8::7/128"}}],
            "ports": [{"port": 5432, "protocol": "TCP"}],
        },
        {"to": [{"ipBlock": {"cidr": "10.0.0.0/8"}}], "ports": [{"port": 53, "protocol": "UDP"}]},
    ]
    assert site_policy("o1")["spec"]["egress"] == []


def test_what_a_cluster_cannot_run_is_refused_with_the_reason() -> None:
    assert refusal(ServiceSpec(image="toy"), options()) is None
    assert "process site" in str(refusal(ServiceSpec(entrypoint="x"), options()))
    assert "digest" in str(refusal(ServiceSpec(image="toy"), options(pinned=True)))
    devices = ServiceSpec.model_validate({"image": "toy", "needs": {"devices": ["/dev/video0"]}})
    assert "/dev/video0" in str(refusal(devices, options()))
    opens = ServiceSpec.model_validate({"image": "toy", "needs": {"egress": ["db.example.org:5432"]}})
    assert "option 'egress'" in str(refusal(opens, options()))
    assert refusal(opens, options(egress=["*.example.org"])) is None


def test_a_port_is_kept_over_runs_and_none_is_given_twice() -> None:
    assert free_port((10, 12), 11, []) == 11
    assert free_port((10, 12), 11, [11]) == 12
    assert free_port((10, 12), 12, [12]) == 10
    assert free_port((10, 11), 10, [10, 11]) is None


def test_sites_that_choose_of_one_range_begin_elsewhere() -> None:
    ports = [usual_port((20_000, 29_999), f"site{n}", "i1") for n in range(50)]
    assert len(set(ports)) > 45
    assert all(20_000 <= port <= 29_999 for port in ports)
    assert usual_port((20_000, 20_000), "o1", "i1") == 20_000


def test_a_pod_of_somebody_else_is_none_of_ours() -> None:
    document = made()
    del document["metadata"]["labels"]["skytether.io/instance"]
    assert parse(document) is None


def test_a_run_starts_then_runs_where_robots_reach_it() -> None:
    assert looked_at(seen({"waiting": {"reason": "ContainerCreating"}}, "Pending")) == Observation(
        1, Phase.STARTING, unstarted=True
    )
    running = {"running": {"startedAt": "2026-11-25T07:00:01Z"}}
    assert looked_at(seen(running)).phase is Phase.STARTING  # its service has not said that it is ready
    found = seen(running, started=True, ready=True)
    assert looked_at(found) == Observation(1, Phase.RUNNING, "10.0.0.5", 20_000)
    assert looked_at(found, "203.0.113.5").host == "203.0.113.5"
    assert observation(found, options(advertise_host="robots.example.org")).host == "robots.example.org"
    assert observation(found, options(reach="pod")).host == "10.1.0.9"
    assert observation(found, options(reach="pod")).port == 7600
    assert observation(found, options(), trouble="its loop has hung").detail == "its loop has hung"


def test_a_robot_is_told_the_relay_that_its_session_chooses() -> None:
    running = {"running": {"startedAt": "2026-11-25T07:00:01Z"}}
    found = seen(running, started=True, ready=True)
    one = options(reach="relay", relay="203.0.113.5:8700")
    assert observation(found, one) == Observation(1, Phase.RUNNING, "203.0.113.5", 8700)
    relays = ["[2001:db8::5]:8700", "relay.example.org:8701", "203.0.113.5:8702"]
    told = [observation(found, options(reach="relay", relay=given)) for given in (relays, relays[::-1])]
    assert told[0] == told[1]
    assert told[0].host in ("2001:db8::5", "relay.example.org", "203.0.113.5")
    others = {observation(replace(found, session=f"{n:016x}"), options(reach="relay", relay=relays)) for n in range(30)}
    assert {one.port for one in others} == {8700, 8701, 8702}


def test_a_relay_sends_each_session_to_its_newest_run() -> None:
    running: dict[str, Any] = {"state": {"running": {}}}
    now = replace(seen(running["state"]), attempt=2, address="10.1.0.10")
    ended = seen({"terminated": {"exitCode": 1}}, "Failed")
    nowhere = replace(now, session="00000000000000bb", address="")
    nobodys = replace(now, session="*")
    assert routes_of([now, seen(running["state"]), nowhere, nobodys]) == {"00112233445566aa": ("10.1.0.10", 7600)}
    assert routes_of([ended]) == {}


def test_what_keeps_a_pod_from_being_started_is_said() -> None:
    condition = {"type": "PodScheduled", "status": "False", "message": "0/1 nodes are available: 1 Insufficient cpu."}
    told = looked_at(seen({}, "Pending", conditions=[condition]))
    assert (told.phase, told.detail) == (
        Phase.STARTING,
        "no node takes it: 0/1 nodes are available: 1 Insufficient cpu.",
    )
    waits = {"waiting": {"reason": "ErrImagePull", "message": "no such host"}}
    assert looked_at(seen(waits, "Pending")).detail == "ErrImagePull no such host"
    assert seen(waits, "Pending").hopeless == ""  # it is tried again
    never = seen({"waiting": {"reason": "ErrImageNeverPull", "message": 'image "toy:1" is not present'}}, "Pending")
    assert never.hopeless == "its image 'toy:1' is not on the node, and is never pulled"


def test_a_run_that_was_given_up_has_ended_and_left_nothing() -> None:
    document = made()
    document["metadata"]["annotations"]["skytether.io/failure"] = "its image 'toy:1' cannot be pulled"
    found = parse({**document, "status": {"phase": "Pending"}})
    assert found is not None
    told = looked_at(found)
    assert (told.phase, told.unstarted) == (Phase.EXITED, True)
    assert told.detail == "could not be started: its image 'toy:1' cannot be pulled"


@pytest.mark.parametrize(("code", "status"), [(0, 0), (1, 1), (137, -9), (143, -15), (255, 255)])
def test_how_a_run_ended(code: int, status: int) -> None:
    ended = {"terminated": {"exitCode": code, "reason": "Error", "message": "first\nboom\n"}}
    told = looked_at(seen(ended, "Failed"))
    assert told == Observation(1, Phase.EXITED, exit_status=status, last_line="boom")


def test_what_the_cluster_ended_it_for_is_said() -> None:
    killed = {"terminated": {"exitCode": 137, "reason": "OOMKilled"}}
    assert looked_at(seen(killed, "Failed")).detail == (
        "ran out of memory: its limit is 128 MiB (limits.memory_mb of its manifest)"
    )
    evicted = looked_at(seen({}, "Failed", reason="Evicted", message="The node was low on memory."))
    assert evicted.phase is Phase.EXITED
    assert evicted.detail == "was ended by the cluster: Evicted: The node was low on memory."


def test_one_that_was_asked_to_end_runs_until_it_has() -> None:
    # At once when it is asked, its node says that the pod has failed; its container still runs.
    found = seen({"running": {}}, "Failed", started=True, ready=True, reason="DeadlineExceeded")
    assert looked_at(found).phase is Phase.RUNNING
    assert looked_at(seen({"terminated": {"exitCode": 0}}, "Failed", reason="DeadlineExceeded")).detail == ""


def test_no_pod_of_a_site_is_evicted_while_it_serves() -> None:
    budget = disruption_budget("o1", "policy/v1")
    assert budget["spec"]["selector"]["matchLabels"].items() <= made()["metadata"]["labels"].items()
    assert budget["spec"]["minAvailable"] == 2**31 - 1  # an integer: budgets of bare pods know nothing else


def test_what_the_cluster_is_about_to_end_says_so_until_it_was_asked_to_end() -> None:
    condition = {"type": "DisruptionTarget", "status": "True", "message": "deleting by taint manager"}
    up = seen({"running": {}}, started=True, ready=True, conditions=[condition])
    assert looked_at(up).leaving == "the cluster is about to end its pod: deleting by taint manager"
    well = seen({"running": {}}, started=True, ready=True)
    assert observation(well, options(), leaving="its node n1 is cordoned").leaving == "its node n1 is cordoned"
    assert observation(replace(well, stops=True), options(), leaving="its node n1 is cordoned").leaving == ""


def test_quantities_are_read_as_kubernetes_writes_them() -> None:
    assert [quantity(text) for text in ("2", "500m", "1Ki", "8Gi", "100M", "1e3")] == [2, 0.5, 1024, 8 << 30, 1e8, 1000]
    with pytest.raises(ValueError, match="could not convert"):
        quantity("many")


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"ports": [3, 2]}, "first is above the last"),
        ({"advertise_host": "0.0.0.0"}, "wildcard"),
        ({"namespace": "Robots"}, "namespace"),
        ({"nodeport": True}, "nodeport"),
        ({"storage_class": "fast"}, "set keep_data, too"),
        ({"reach": "relay"}, "relay: HOST:PORT of the relay goes with reach: relay"),
        ({"relay": "203.0.113.5:8700"}, "relay: HOST:PORT of the relay goes with reach: relay"),
        ({"reach": "relay", "relay": "203.0.113.5"}, "must be HOST:PORT"),
        ({"reach": "relay", "relay": ["0.0.0.0:8700"]}, "wildcard address 0.0.0.0"),
        ({"kubeconfig": None, "context": "lab"}, "context is of a kubeconfig"),
    ],
)
def test_options_that_cannot_be_are_refused_by_name(given: dict[str, Any], words: str) -> None:
    with pytest.raises(ValidationError, match=words):
        options(**given)


def test_pods_are_found_by_their_instance_and_forgotten_with_it() -> None:
    one, two, other = seen(), replace(seen(), name="p2", attempt=2), replace(seen(), name="p3", instance="i2")
    pods = Pods([two, one, other])
    assert [pod.attempt for pod in pods.of("i1")] == [1, 2]
    pods.put(replace(one, version="9"))
    assert pods.get(one.name) == replace(one, version="9")
    assert len(pods.all()) == 3
    pods.drop(one.name)
    pods.drop("p3")
    assert [pod.name for pod in pods.of("i1")] == ["p2"]
    assert pods.of("i2") == []
