"""What a pod's description means: pure, data in and data out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from datetime import datetime
from typing import Any

from skytether.api.service_report import ServiceReport
from skytether.api.usage import NO_USAGE, Usage

from ..base import Observation, Phase
from ..containers import INNER_PORT, exit_status, last_line, out_of_memory
from ..hosts import parse_address, rendezvous
from .objects import ATTEMPT, FAILURE, INSTANCE, NODE_PORT, SESSION
from .options import KubernetesOptions
from .resize import Resources, differ, pull_progress, pull_resources, quantity

Document = Mapping[str, Any]
_NO_FREE_PORT = "didn't have free ports"
"""What a scheduler says of nodes where another pod has the port."""
_CLAIM = "persistentVolumeClaim"
_HOPELESS = {
    "ErrImageNeverPull": "its image '{image}' is not on the node, and is never pulled",
    "ImagePullBackOff": "its image '{image}' cannot be pulled",
    "InvalidImageName": "'{image}' is not a valid name of an image",
    "CreateContainerConfigError": "its container cannot be made",
    "CreateContainerError": "its container cannot be made",
    "RunContainerError": "its container cannot be run",
}
"""Of a container that waits: for nothing that will come."""


@dataclass(frozen=True, slots=True)
class PodState:
    """One pod of ours as the API server describes it."""

    name: str
    uid: str
    version: str
    """Of its description."""
    instance: str
    attempt: int
    memory_limit: str
    cpu_limit: str
    made_at: float
    """By the API server's clock [s since the epoch]."""
    phase: str
    """``Pending``, ``Running``, ``Succeeded``, ``Failed`` or ``Unknown``."""
    waits_for: str = ""
    """What keeps it from being started, in words."""
    hopeless: str = ""
    """Why it never will be."""
    port_taken: bool = False
    """No node has its port free."""
    running: bool = False
    """Its container is."""
    started: bool = False
    """Its service has said that it is ready."""
    healthy: bool = False
    exit_code: int | None = None
    """Of its container, when that has ended."""
    ended_how: str = ""
    """``OOMKilled``, ``Evicted``: where the exit code does not tell."""
    last_words: str = ""
    node: str = ""
    host: str = ""
    """Address of its node."""
    address: str = ""
    """Its own."""
    host_port: int | None = None
    """At which its node is asked for it."""
    session: str = ""
    """Its session's id."""
    failure: str = ""
    """Why it was given up."""
    stops: bool = False
    """It was asked to end."""
    disrupted: str = ""
    """Why the cluster is about to end it."""
    resources: Resources | None = None
    """As its description says."""
    resizing: bool = False
    """Its node is about to give it these."""
    unresized: str = ""
    """Why its node will not."""
    removed: bool = False
    """It is deleted, by us or anybody: its node ends what runs of it yet."""

    @property
    def lingers(self) -> bool:
        """It has ended, says its node, whose last word of the container is that it runs.

        Nodes before Kubernetes 1.22 say so when they begin to end it, and nothing more.
        """
        return self.phase in ("Succeeded", "Failed") and self.running and not self.failure

    @property
    def ended(self) -> bool:
        over = self.phase in ("Succeeded", "Failed") and not self.running
        return over or bool(self.failure) or self.exit_code is not None


def parse(document: Document) -> PodState | None:
    """A pod out of its description; None: it is not one of ours."""
    meta, spec, status = document["metadata"], document["spec"], document.get("status") or {}
    labels, notes = meta.get("labels") or {}, meta.get("annotations") or {}
    if INSTANCE not in labels or not labels.get(ATTEMPT, "").isdecimal():
        return None
    container = spec["containers"][0]
    told = _container_status(status, container["name"])
    state = told.get("state") or {}
    waiting, terminated = state.get("waiting") or {}, state.get("terminated") or {}
    waits_for = _waits_for(spec, status, waiting)
    asked = container.get("resources") or {}
    limits = asked.get("limits") or {}
    resources, (at_it, never) = pull_resources(asked), pull_progress(status)
    return PodState(
        name=meta["name"],
        uid=meta["uid"],
        version=meta.get("resourceVersion", ""),
        instance=labels[INSTANCE],
        attempt=int(labels[ATTEMPT]),
        memory_limit=str(limits.get("memory", "")),
        cpu_limit=str(limits.get("cpu", "")),
        made_at=datetime.fromisoformat(meta["creationTimestamp"]).timestamp(),
        phase=status.get("phase", "Pending"),
        waits_for=waits_for,
        port_taken=_NO_FREE_PORT in waits_for and not spec.get("nodeName"),
        hopeless=_hopeless(waiting, container["image"]),
        running=state.get("running") is not None,
        started=bool(told.get("started")),
        healthy=bool(told.get("ready")),
        exit_code=terminated.get("exitCode"),
        ended_how=_ended_how(status, terminated),
        last_words=str(terminated.get("message") or ""),
        node=spec.get("nodeName", ""),
        host=status.get("hostIP", ""),
        address=status.get("podIP", ""),
        host_port=_host_port(container, notes),
        session=notes.get(SESSION, ""),
        failure=notes.get(FAILURE, ""),
        stops=bool(spec.get("activeDeadlineSeconds")) or bool(meta.get("deletionTimestamp")),
        disrupted=_disrupted(status),
        resources=resources,
        resizing=at_it or differ(pull_resources(told.get("resources") or {}), resources),
        unresized=never,
        removed=bool(meta.get("deletionTimestamp")),
    )


def _container_status(status: Document, name: str) -> Document:
    return next((one for one in status.get("containerStatuses") or () if one["name"] == name), {})


def _host_port(container: Document, notes: Document) -> int | None:
    """That of its instance's Service comes first."""
    if notes.get(NODE_PORT, "").isdecimal():
        return int(notes[NODE_PORT])
    return next((port["hostPort"] for port in container.get("ports") or () if port.get("hostPort")), None)


def _waits_for(spec: Document, status: Document, waiting: Document) -> str:
    waits_for = _unscheduled(status)
    if waits_for is None:
        reason = str(waiting.get("reason", ""))
        usual = reason in ("ContainerCreating", "PodInitializing")
        waits_for = "" if usual else f"{reason} {waiting.get('message', '')}".strip()
    claims = [one[_CLAIM]["claimName"] for one in spec.get("volumes") or () if one.get(_CLAIM)]
    if _CLAIM.lower() in waits_for.lower() and claims:
        waits_for += f" ('kubectl describe pvc {claims[0]}' says why; site's option 'storage_class')"
    return waits_for


def _unscheduled(status: Document) -> str | None:
    for condition in status.get("conditions") or ():
        if condition["type"] == "PodScheduled" and condition["status"] == "False":
            return f"no node takes it: {condition.get('message', '')}".rstrip(": ")
    return None


def _disrupted(status: Document) -> str:
    for condition in status.get("conditions") or ():
        if condition["type"] == "DisruptionTarget" and condition["status"] == "True":
            return f"the cluster is about to end its pod: {condition.get('message') or condition.get('reason', '')}"
    return ""


def _hopeless(waiting: Document, image: str) -> str:
    reason, message = str(waiting.get("reason", "")), str(waiting.get("message", ""))
    if reason not in _HOPELESS:
        return ""
    text = _HOPELESS[reason].format(image=image)
    return f"{text}: {message}" if message and image not in message else text


def _ended_how(status: Document, terminated: Document) -> str:
    if terminated.get("reason") == "OOMKilled":
        return "OOMKilled"
    if status.get("reason") in (None, "", "DeadlineExceeded"):
        return ""
    return f"{status['reason']}: {status.get('message', '')}".rstrip(": ")


def refused(message: str) -> str:
    """What to tell of a pod that the API server refuses; ``message``: its own words."""
    advice = ""
    if "violates PodSecurity" in message and "hostPort" in message:
        advice = ": give the site another option 'reach', or its namespace the label of Pod Security 'privileged'"
    return f"the cluster refuses it: {message}{advice}"


def observation(
    seen: PodState,
    options: KubernetesOptions,
    external: str = "",
    reports: tuple[ServiceReport, ...] = (),
    usage: Usage = NO_USAGE,
    *,
    over: bool = False,
    trouble: str = "",
    leaving: str = "",
    balancer: tuple[str, int] | str | None = None,
    step_s: float | None = None,
) -> Observation:
    """What the contract calls it.

    Args:
        seen: The pod.
        options: The site's.
        external: Address of its node, as others reach it.
        reports: Of its service.
        usage: What it uses, as known last.
        over: It has lingered for as long as it could.
        trouble: What is wrong with its service.
        leaving: Why its node is about to be without it.
        step_s: How long it says that its steps take.
        balancer: At which a load balancer passes on to it, or why there is no such address yet; None: there is none.
    """
    if seen.ended or over:
        if seen.failure:
            why = f"could not be started: {seen.failure}"
            return Observation(seen.attempt, Phase.EXITED, detail=why, unstarted=True)
        code = seen.exit_code
        return Observation(
            seen.attempt,
            Phase.EXITED,
            exit_status=exit_status(code) if code is not None else None,
            last_line=last_line(seen.last_words),
            detail=_detail(seen, usage),
            out_of_memory=seen.ended_how == "OOMKilled",
            reports=reports,
        )
    if (seen.started or seen.lingers) and seen.running:
        if isinstance(balancer, str):
            return Observation(seen.attempt, Phase.STARTING, detail=balancer, reports=reports)
        host, port = balancer or where(seen, options, external)
        return Observation(
            seen.attempt,
            Phase.RUNNING,
            host,
            port,
            detail=trouble,
            leaving="" if seen.stops else seen.disrupted or leaving,
            step_s=step_s,
            reports=reports,
            **asdict(usage),
        )
    return Observation(seen.attempt, Phase.STARTING, detail=seen.waits_for, unstarted=not seen.node, reports=reports)


def where(seen: PodState, options: KubernetesOptions, external: str) -> tuple[str, int | None]:
    """Host and port at which robots reach it."""
    if options.reach == "pod":
        return seen.address, INNER_PORT
    if options.reach == "relay":
        return parse_address(rendezvous(seen.session, options.relay))
    return options.advertise_host or external or seen.host, seen.host_port


def _detail(seen: PodState, usage: Usage) -> str:
    if seen.ended_how == "OOMKilled":
        text = out_of_memory(int(quantity(seen.memory_limit)) >> 20)
        used = usage.memory_bytes
        return text if used is None else f"{text}, and it used {used >> 20} MiB when that was last looked at"
    return f"was ended by the cluster: {seen.ended_how}" if seen.ended_how else ""
