"""What is asked of an API server, and what its answers mean: pure, data in and data out.

A run is a pod that is never restarted. It waits for a Secret of its own name, with the grant: it is made by that, and
begun when the Secret is there. All else that belongs to a run is owned by its pod, and goes with it.
"""

from __future__ import annotations

import base64
import zlib
from collections.abc import Iterable, Mapping
from typing import Any

from skytether.api.grant import GRANT_VARIABLE
from skytether.api.manifest import Opening, ServiceSpec

from ..base import Capacity, Launch
from ..containers import INNER_PORT, USER, data_name, image_refusal, is_pulled
from ..egress import refusal_of
from .options import KubernetesOptions
from .resize import quantity, resources_of

Document = Mapping[str, Any]
HEALTH_PORT = 7601
"""TCP port on which the SDK answers of its health, in the pod."""
GRACE_S = 5
"""Seconds between SIGTERM and SIGKILL."""
_ROOT = "/run/skytether"
_GRANT = f"{_ROOT}/grant"
_OWN = f"{_ROOT}/instance"
_DATA = f"{_ROOT}/data"
_PREFIX = "skytether.io"
OWNER, INSTANCE, ATTEMPT = f"{_PREFIX}/owner", f"{_PREFIX}/instance", f"{_PREFIX}/attempt"
EPOCH = f"{_PREFIX}/epoch"
"""Annotation: of the leader."""
SESSION = f"{_PREFIX}/session"
"""Annotation of a pod: id of its session, by which a relay forwards."""
NODE_PORT = f"{_PREFIX}/port"
"""Annotation of a pod: the port of its nodes at which a Service of its instance is reached."""
FAILURE = f"{_PREFIX}/failure"
"""Annotation of a pod that was given up: why."""
MANAGED = {"app.kubernetes.io/managed-by": "skytether", "app.kubernetes.io/part-of": "skytether"}
_GPU = "nvidia.com/gpu"
_PULL = {"missing": "IfNotPresent", "always": "Always", "never": "Never"}


def name_of(owner: str, instance: str, attempt: int) -> str:
    """Of a run's pod, and of its Secret."""
    return f"skytether-{owner}-{instance}-{attempt}"


def refusal(spec: ServiceSpec, options: KubernetesOptions) -> str | None:
    """Why a site with these options can never run the service; None: it can."""
    if refused := image_refusal(spec, pinned=options.pinned):
        return refused
    if spec.needs.devices:
        return f"a cluster gives no device files, and the service needs {', '.join(spec.needs.devices)}"
    return refusal_of(spec.needs.openings, options.egress)


def free_port(ports: tuple[int, int], preferred: int, taken: Iterable[int]) -> int | None:
    """The preferred one, or the next that nobody has, round and round; None: all are taken."""
    used, (first, last) = set(taken), ports
    size = last - first + 1
    begin = (preferred - first) % size
    return next((port for n in range(size) if (port := first + (begin + n) % size) not in used), None)


def usual_port(ports: tuple[int, int], owner: str, instance: str) -> int:
    """Where the search for an instance's port begins: elsewhere for each.

    Other sites may choose of the same range, and none knows of the ports that others have.
    """
    return ports[0] + zlib.crc32(f"{owner}/{instance}".encode()) % (ports[1] - ports[0] + 1)


Openings = Mapping[Opening, Iterable[str]]
"""What a run may connect to, with the addresses of each."""


def pod(
    launch: Launch,
    options: KubernetesOptions,
    owner: str,
    port: int | None,
    openings: Openings,
    *,
    node_port: int | None = None,
    epoch: int = 0,
) -> dict[str, Any]:
    """The pod of a run.

    Args:
        launch: What to start.
        options: The site's.
        owner: Whose pods these are.
        port: UDP port of its node; None: it has none.
        openings: What it may connect to: it knows the names of these.
        node_port: Of the Service by which it is reached; None: there is none.
        epoch: Of the leader; 0: there is none.
    """
    grant = launch.grant
    return {
        "apiVersion": "v1",
        "kind": "Pod",
        "metadata": {
            "name": name_of(owner, grant.instance, launch.attempt),
            "labels": {
                **options.labels,
                **MANAGED,
                "app.kubernetes.io/name": grant.service,
                "app.kubernetes.io/instance": grant.instance,
                f"{_PREFIX}/robot": grant.robot,
                f"{_PREFIX}/service": grant.service,
                OWNER: owner,
                INSTANCE: grant.instance,
                ATTEMPT: str(launch.attempt),
            },
            "annotations": {
                EPOCH: str(epoch),
                SESSION: grant.session_id,
                **({NODE_PORT: str(node_port)} if node_port else {}),
            },
        },
        "spec": {
            "restartPolicy": "Never",
            "terminationGracePeriodSeconds": GRACE_S,
            "automountServiceAccountToken": False,
            "enableServiceLinks": False,
            "shareProcessNamespace": True,  # as process 1, a service that has no handler yet could not be ended
            "securityContext": {
                "runAsNonRoot": True,
                "runAsUser": USER,
                "runAsGroup": USER,
                "fsGroup": USER,
                "seccompProfile": {"type": "RuntimeDefault"},
            },
            **_names(openings),
            **_scheduling(options, owner),
            "containers": [_container(launch.spec, options, port)],
            "volumes": _volumes(launch, options, owner),
        },
    }


def _names(openings: Openings) -> dict[str, Any]:
    """What a pod knows by name: what it may connect to, and nothing else."""
    aliases = [
        {"ip": address, "hostnames": [opening.host]}
        for opening, addresses in openings.items()
        for address in addresses
        if "/" not in address
    ]
    return {
        "dnsPolicy": "None",  # nobody to ask: names would be a way out
        "dnsConfig": {"nameservers": ["127.0.0.1"]},
        **({"hostAliases": aliases} if aliases else {}),
    }


def _scheduling(options: KubernetesOptions, owner: str) -> dict[str, Any]:
    """On which nodes a site's pods may be, and what these need to get an image."""
    given = {
        "nodeSelector": options.node_selector,
        "tolerations": list(options.tolerations),
        "priorityClassName": options.priority_class,
        "imagePullSecrets": [{"name": secret} for secret in options.image_pull_secrets],
    }
    spread = {
        "maxSkew": 1,
        "topologyKey": "kubernetes.io/hostname",
        "whenUnsatisfiable": "ScheduleAnyway",
        "labelSelector": {"matchLabels": {OWNER: owner}},
    }
    return {**{key: value for key, value in given.items() if value}, "topologySpreadConstraints": [spread]}


def _container(spec: ServiceSpec, options: KubernetesOptions, port: int | None) -> dict[str, Any]:
    environment = {**options.environment, GRANT_VARIABLE: f"{_GRANT}/grant.json"}
    health = {"httpGet": {"path": "/healthz", "port": HEALTH_PORT}, "periodSeconds": 1, "timeoutSeconds": 1}
    return {
        "name": "service",
        "image": spec.image,
        "imagePullPolicy": _PULL[options.pull if is_pulled(spec.image or "") else "never"],
        "env": [{"name": key, "value": value} for key, value in environment.items()],
        "ports": [{"containerPort": INNER_PORT, "protocol": "UDP", **({"hostPort": port} if port is not None else {})}],
        "resources": _resources(spec),
        "securityContext": {
            "allowPrivilegeEscalation": False,
            "readOnlyRootFilesystem": True,
            "capabilities": {"drop": ["ALL"]},
        },
        # Until its service is ready; how long that may take the orchestrator knows.
        "startupProbe": {**health, "failureThreshold": 1_000_000},
        "readinessProbe": {**health, "failureThreshold": 2},
        "terminationMessagePolicy": "FallbackToLogsOnError",
        "volumeMounts": [
            {"name": "grant", "mountPath": _GRANT, "readOnly": True},
            {"name": "own", "mountPath": _OWN},
            {"name": "data", "mountPath": _DATA},
            {"name": "tmp", "mountPath": "/tmp"},  # noqa: S108 (the container's own)
        ],
    }


def _volumes(launch: Launch, options: KubernetesOptions, owner: str) -> list[dict[str, Any]]:
    secret_name = name_of(owner, launch.grant.instance, launch.attempt)
    return [
        {"name": "grant", "secret": {"secretName": secret_name, "defaultMode": 0o440}},
        {"name": "own", "emptyDir": {"medium": "Memory", "sizeLimit": "1Mi"}},
        _data(launch, options, owner),
        {"name": "tmp", "emptyDir": {"medium": "Memory", "sizeLimit": "64Mi"}},
    ]


def _data(launch: Launch, options: KubernetesOptions, owner: str) -> dict[str, Any]:
    """The volume for what a service writes."""
    if not options.keep_data:
        return {"name": "data", "emptyDir": {"sizeLimit": f"{options.data_mb}Mi"}}
    named = data_name(owner, launch.grant.robot, launch.grant.service)
    return {"name": "data", "persistentVolumeClaim": {"claimName": named}}


def claim(launch: Launch, options: KubernetesOptions, owner: str) -> dict[str, Any]:
    """What keeps what a service writes for a robot; nobody owns it, so that it outlives runs and instances."""
    robot, service = launch.grant.robot, launch.grant.service
    labels = {**MANAGED, OWNER: owner, f"{_PREFIX}/robot": robot, f"{_PREFIX}/service": service}
    return {
        "apiVersion": "v1",
        "kind": "PersistentVolumeClaim",
        "metadata": {"name": data_name(owner, robot, service), "labels": labels},
        "spec": {
            "accessModes": [options.storage_access],
            "resources": {"requests": {"storage": f"{options.data_mb}Mi"}},
            **({"storageClassName": options.storage_class} if options.storage_class is not None else {}),
        },
    }


def _resources(spec: ServiceSpec) -> dict[str, Any]:
    gpus = {_GPU: str(spec.needs.gpu)} if spec.needs.gpu else {}
    return {key: {**amounts, **gpus} for key, amounts in resources_of(spec).document().items()}


def owned_by(made: Document) -> list[dict[str, Any]]:
    """``ownerReferences`` of what belongs to a pod."""
    meta = made["metadata"]
    return [{"apiVersion": "v1", "kind": "Pod", "name": meta["name"], "uid": meta["uid"], "controller": True}]


def secret(launch: Launch, owner: str, made: Document) -> dict[str, Any]:
    """With the grant, for the pod that was made."""
    told = {
        "bind_host": "0.0.0.0",  # noqa: S104 (in its own network)
        "bind_port": INNER_PORT,
        "health_port": HEALTH_PORT,
        "ready_file": f"{_OWN}/ready.json",
        "data_dir": _DATA,
    }
    grant = launch.grant.model_copy(update=told).model_dump_json().encode()
    return {
        "apiVersion": "v1",
        "kind": "Secret",
        "type": "Opaque",
        "immutable": True,
        "metadata": {
            "name": made["metadata"]["name"],
            "labels": {**MANAGED, OWNER: owner, INSTANCE: launch.instance},
            "ownerReferences": owned_by(made),
        },
        "data": {"grant.json": base64.b64encode(grant).decode()},
    }


def service_name(owner: str, instance: str) -> str:
    """Of the Service of an instance."""
    return f"skytether-{owner}-{instance}"


def service(instance: str, owner: str, options: KubernetesOptions) -> dict[str, Any]:
    """The Service of an instance, by which each of its runs is reached at the same address or port."""
    balanced = options.reach == "loadbalancer"
    return {
        "apiVersion": "v1",
        "kind": "Service",
        "metadata": {
            "name": service_name(owner, instance),
            "labels": {**MANAGED, OWNER: owner, INSTANCE: instance},
            **({"annotations": options.service_annotations} if options.service_annotations else {}),
        },
        "spec": {
            "type": "LoadBalancer" if balanced else "NodePort",
            **({"loadBalancerClass": options.load_balancer_class} if options.load_balancer_class else {}),
            "externalTrafficPolicy": options.external_traffic_policy,
            "selector": {OWNER: owner, INSTANCE: instance},
            "ports": [{"port": INNER_PORT, "protocol": "UDP"}],
        },
    }


def balanced_address(made: Document) -> tuple[str, int] | None:
    """At which a load balancer passes on to a Service; None: it has given none yet."""
    given = ((made.get("status") or {}).get("loadBalancer") or {}).get("ingress") or ()
    host = next(
        (str(one.get("ip") or one.get("hostname")) for one in given if one.get("ip") or one.get("hostname")), ""
    )
    return (host, int(made["spec"]["ports"][0]["port"])) if host else None


def site_policy(owner: str) -> dict[str, Any]:
    """The NetworkPolicy of a site's pods: robots reach their services, and these reach nobody."""
    return {
        "apiVersion": "networking.k8s.io/v1",
        "kind": "NetworkPolicy",
        "metadata": {"name": f"skytether-{owner}", "labels": {**MANAGED, OWNER: owner}},
        "spec": {
            "podSelector": {"matchLabels": {OWNER: owner}},
            "policyTypes": ["Ingress", "Egress"],
            "ingress": [{"ports": [{"port": INNER_PORT, "protocol": "UDP"}, {"port": HEALTH_PORT, "protocol": "TCP"}]}],
            "egress": [],
        },
    }


def disruption_budget(owner: str, version: str) -> dict[str, Any]:
    """That no pod that serves is evicted: who drains a node waits until its robots have been handed over.

    More pods are to be left than there ever are: that is how a budget of bare pods says "none".
    """
    return {
        "apiVersion": version,
        "kind": "PodDisruptionBudget",
        "metadata": {"name": f"skytether-{owner}", "labels": {**MANAGED, OWNER: owner}},
        "spec": {"minAvailable": 2**31 - 1, "selector": {"matchLabels": {OWNER: owner}}},
    }


def openings_policy(openings: Openings, made: Document, owner: str) -> dict[str, Any]:
    """The NetworkPolicy of one run that may connect to some addresses."""
    meta = made["metadata"]
    return {
        "apiVersion": "networking.k8s.io/v1",
        "kind": "NetworkPolicy",
        "metadata": {
            "name": meta["name"],
            "labels": {**MANAGED, OWNER: owner, INSTANCE: meta["labels"][INSTANCE]},
            "ownerReferences": owned_by(made),
        },
        "spec": {
            "podSelector": {"matchLabels": {key: meta["labels"][key] for key in (OWNER, INSTANCE, ATTEMPT)}},
            "policyTypes": ["Egress"],
            "egress": [
                {
                    "to": [{"ipBlock": {"cidr": _network(address)}} for address in addresses],
                    "ports": [{"port": opening.port, "protocol": opening.protocol.upper()}],
                }
                for opening, addresses in openings.items()
            ],
        },
    }


def _network(address: str) -> str:
    return address if "/" in address else f"{address}/{128 if ':' in address else 32}"


def leader(owner: str, epoch: int) -> dict[str, Any]:
    """The ConfigMap that says who leads."""
    return {
        "apiVersion": "v1",
        "kind": "ConfigMap",
        "metadata": {"name": f"skytether-{owner}-leader", "labels": {**MANAGED, OWNER: owner}},
        "data": {"epoch": str(epoch)},
    }


def capacity(nodes: Iterable[Document], options: KubernetesOptions) -> Capacity:
    """What nodes give, or what the site's options say instead."""
    cpu = memory = 0.0
    gpu = 0
    architectures = set()
    for node in nodes:
        gives = node["status"]["allocatable"]
        cpu += quantity(gives["cpu"])
        memory += quantity(gives["memory"])
        gpu += int(quantity(gives.get(_GPU, "0")))
        architectures.add(node["status"]["nodeInfo"]["architecture"])
    return Capacity(
        cpu=options.cpu if options.cpu is not None else cpu,
        memory_mb=options.memory_mb if options.memory_mb is not None else int(memory) >> 20,
        gpu=options.gpu if options.gpu is not None else gpu,
        architecture=architectures.pop() if len(architectures) == 1 else "",
    )


def tolerated(taint: Document, options: KubernetesOptions) -> bool:
    """Whether pods of the site may be on a node with this taint."""
    if taint["effect"] == "PreferNoSchedule":
        return True
    for toleration in options.tolerations:
        key, effect = toleration.get("key"), toleration.get("effect")
        if key not in (None, "", taint["key"]) or effect not in (None, "", taint["effect"]):
            continue
        if toleration.get("operator", "Equal") == "Exists" or toleration.get("value", "") == taint.get("value", ""):
            return True
    return False


def external_address(node: Document) -> str:
    """At which others reach a node; empty: it says nothing of that."""
    by_kind = {one["type"]: one["address"] for one in (node.get("status") or {}).get("addresses") or ()}
    return str(by_kind.get("ExternalIP") or by_kind.get("InternalIP") or "")
