"""What a Kubernetes site is told."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, model_validator

from skytether.api.manifest import Strict

from ..hosts import AdvertisedHost, check_advertised, parse_address

Port = Annotated[int, Field(ge=1, le=65_535)]
Label = Annotated[str, Field(max_length=253)]


class KubernetesOptions(Strict):
    """Options of a Kubernetes site."""

    kubeconfig: str | None = None
    """File that says where the cluster is and who we are; None: the cluster that the orchestrator runs in, as its
    service account."""
    context: str | None = None
    """Of the kubeconfig; None: its current one."""
    namespace: Annotated[str, Field(pattern=r"^[a-z0-9]([a-z0-9-]{0,61}[a-z0-9])?$")] = "skytether"
    """Where the pods are. It is there already: who makes it says with quotas and roles what may be done in it."""
    reach: Literal["hostport", "nodeport", "loadbalancer", "pod", "relay"] = "hostport"
    """How a robot reaches a service: at a UDP port of the pod's node, out of ``ports``; at one that the cluster chooses
    (a Service of type NodePort); at the address that the cluster's load balancer gives a Service of the instance; at
    the pod's own address, where that is routable; or by way of a relay."""
    relay: Annotated[
        tuple[str, ...],
        BeforeValidator(
            lambda told: (told,) if isinstance(told, str) else told, json_schema_input_type=str | tuple[str, ...]
        ),
    ] = ()
    """``HOST:PORT`` of the relay as robots reach it; of several, its session's id chooses one for each robot."""
    ports: tuple[Port, Port] = (20_000, 29_999)
    """First and last UDP port of nodes that instances may have; for ``hostport``."""
    advertise_host: AdvertisedHost | None = None
    """Address that robots are told; None: the external address of the pod's node, or else its internal one."""
    load_balancer_class: str | None = None
    """Which load balancer is to serve, where there are several; for ``loadbalancer``, from Kubernetes 1.24 on."""
    load_balancer_timeout_s: Annotated[float, Field(gt=0)] = 300.0
    """A service whose load balancer has given no address for this long is given up."""
    external_traffic_policy: Literal["Local", "Cluster"] = "Local"
    """Of the instances' Services. ``Local``: only the pod's own node is asked, and the service sees its robot's
    address. ``Cluster``: each node passes on to it."""
    service_annotations: dict[Label, str] = {}
    """Of the instances' Services, as the cluster's load balancer wants them."""
    cpu: Annotated[float, Field(gt=0)] | None = None
    """Cores that instances may ask for in all; None: all that the nodes give, which needs the right to list them."""
    memory_mb: Annotated[int, Field(gt=0)] | None = None
    """The same of memory."""
    gpu: Annotated[int, Field(ge=0)] | None = None
    """The same of GPUs (``nvidia.com/gpu``)."""
    node_selector: dict[Label, str] = {}
    """Labels that a node must have."""
    tolerations: tuple[dict[str, Any], ...] = ()
    """As in a pod."""
    priority_class: str | None = None
    """Of the pods; it has to be there."""
    pull: Literal["missing", "always", "never"] = "missing"
    """When a node fetches a service's image from its registry. `skytether/...` without a registry is never fetched but
    by its digest, as on Docker: anybody may have the name at the public index."""
    pinned: bool = False
    """Take only images that are named with their digest, NAME@sha256:..."""
    image_pull_secrets: tuple[str, ...] = ()
    """Names of Secrets in the namespace, with the credentials of private registries."""
    data_mb: Annotated[int, Field(ge=1)] = 1024
    """MiB that one run may write; what writes beyond is evicted by its node. It goes with the run."""
    keep_data: bool = False
    """What a service writes for a robot outlives its runs, in a PersistentVolumeClaim of ``data_mb``, and is left when
    the site is deleted."""
    storage_class: str | None = None
    """Of these claims; None: the cluster's default."""
    storage_access: Literal["ReadWriteOnce", "ReadWriteMany"] = "ReadWriteOnce"
    """Of these claims. ``ReadWriteOnce``: the next run, or a successor, waits until the one before has ended, unless
    both are on one node."""
    egress: tuple[Annotated[str, Field(min_length=1, max_length=300)], ...] = ()
    """Patterns of what manifests may open (``needs.egress``), such as ``*.example.org:443/tcp``; ``*`` is everything.
    It, and that nothing else is reached, holds where the cluster's network enforces NetworkPolicies."""
    environment: dict[Annotated[str, Field(pattern=r"^[A-Za-z_][A-Za-z0-9_]*$")], str] = {}
    """More variables for the services. No secrets: whoever may look at pods sees them."""
    labels: dict[Label, Annotated[str, Field(max_length=63)]] = {}
    """More labels for the pods."""
    owner: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9-]{0,31}$")] | None = None
    """Under this name pods are found again; None: one is made up when the site is added."""
    timeout_s: Annotated[float, Field(gt=0, le=300)] = 10.0
    """An API server that has not answered for this long is unreachable."""

    @model_validator(mode="after")
    def _robots_can_connect(self) -> KubernetesOptions:
        if self.advertise_host is not None:
            check_advertised(self.advertise_host)
        if self.storage_class is not None and not self.keep_data:
            raise ValueError("storage_class: data that goes with its run has none; set keep_data, too")
        for one in self.relay:
            parse_address(one)
        if (self.reach == "relay") != bool(self.relay):
            raise ValueError("relay: HOST:PORT of the relay goes with reach: relay, and with that alone")
        if self.ports[0] > self.ports[1]:
            raise ValueError("ports: the first is above the last")
        if self.context is not None and self.kubeconfig is None:
            raise ValueError("context is of a kubeconfig: name that, too")
        return self
