"""A Kubernetes cluster as a site: the calls of the contract."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from http import HTTPStatus
from pathlib import Path
from typing import Any

from typing_extensions import override

from skytether.api.manifest import ServiceSpec, Strict

from ..base import (
    Capacity,
    Launch,
    LogStream,
    Observation,
    OvertakenError,
    Phase,
    Runtime,
    RuntimeFailure,
    SiteSilentError,
    least_memory_mb,
)
from ..containers import USER, kept_owner, with_owner
from ..egress import resolve
from .budget import Budget
from .cluster import Cluster, ClusterSilentError, RefusedError
from .fence import Fence
from .health import Health
from .logs import PodLog
from .nodes import Nodes
from .objects import (
    OWNER,
    free_port,
    openings_policy,
    pod,
    refusal,
    secret,
    site_policy,
    usual_port,
)
from .options import KubernetesOptions
from .pod_changes import NETWORKING, end_pod, hold_claim, put, remove_pod
from .reports import ReportReader
from .resize import SUBRESOURCE, in_class_of, patch, resources_of
from .seen import PodState, observation, refused
from .services import Services
from .usage import Meter
from .watch import Watch

log = logging.getLogger(__name__)

_KEPT = 2
"""Earlier runs whose pods stay, for their logs."""
_FIND_OUT_S = 300.0
"""Seconds between two looks at what the API server offers."""
_POLICY_S = 10.0
"""Seconds between two looks whether pods are still closed off."""


class KubernetesRuntime(Runtime):
    """Runs services as pods of one namespace. What is seen comes from a watch; a start is some calls, and no wait."""

    Options = KubernetesOptions
    unique = "owner"
    runs_as_us = False
    owner_options = frozenset(
        {"kubeconfig", "context", "namespace", "egress", "tolerations", "priority_class", "image_pull_secrets"}
    )

    @override
    def __init__(self, site: str, folder: Path, options: Strict) -> None:
        if not isinstance(options, KubernetesOptions):
            raise TypeError("options must be KubernetesOptions")
        self._site = site
        self.options = options
        self._owner = options.owner or kept_owner(folder)
        self.cluster = Cluster(options)
        self._fence = Fence(self.cluster, self._owner)
        self._watch = Watch(self.cluster, f"{OWNER}={self._owner}")
        self._nodes = Nodes(self.cluster)
        self._budget = Budget(self.cluster, self._owner)
        self._services = Services(self.cluster, options, self._owner, self._must_lead)
        self._reports = ReportReader(self.cluster, self._ready)
        self._meter = Meter(self.cluster, self._owner, self._reports.usage)
        self._health = Health(self.cluster, self._watch.changed.set)
        self._lock = threading.Lock()
        self._unrun: dict[str, Observation] = {}
        """Of instances whose pod no node has taken when it was removed: nothing of it is left to be seen."""
        self._begun: set[str] = set()
        """Uids of pods whose Secret is known to be there."""
        self._waiting: dict[str, Launch] = {}
        """Of pods that we made and no node has taken yet, by uid."""
        self._refused: set[int] = set()
        """Ports that others have."""
        self._policy_at: float | None = None
        """When the NetworkPolicy of all pods was seen to be there, by the monotonic clock [s]."""
        self._blocked = ""
        self._new_enough = False
        self._resizes = False
        """Whether the API server changes what a pod has while it runs, as it said last."""
        self._found_out_at: float | None = None
        self._closed = ""
        """Why no node takes pods at present."""
        self._watch.start()
        self._nodes.start()

    @override
    @classmethod
    def completed(cls, options: dict[str, Any]) -> dict[str, Any]:
        return with_owner(options)

    def _ready(self) -> list[str]:
        return [seen.name for seen in self._watch.seen(0) if seen.running]

    @override
    def blocked(self) -> str:
        return self._blocked or self._closed

    @override
    def isolation(self) -> tuple[str, ...]:
        return (f"user {USER}", "no capabilities", "seccomp", "network policy")

    def refuses(self, spec: ServiceSpec) -> str | None:
        return refusal(spec, self.options)

    def capacity(self) -> Capacity:
        self._watch.seen(self.options.timeout_s)
        if not self._new_enough:
            self.cluster.check_version()
            self._new_enough = True
        self._find_out()
        total, self._closed = self._nodes.offered(self.options)
        return total

    def _find_out(self) -> None:
        """What the API server can do, now and then: clusters are upgraded."""
        if self._found_out_at is not None and time.monotonic() - self._found_out_at < _FIND_OUT_S:
            return
        try:
            self._resizes = self.cluster.offers(SUBRESOURCE)
        except RefusedError as error:
            log.info("site %s: what the API server offers is not told: %s", self._site, error)
        self._found_out_at = time.monotonic()

    @override
    def keeps_size(self, spec: ServiceSpec) -> str:
        return "" if self._resizes else "the cluster cannot change what a pod has while it runs (Kubernetes 1.33 can)"

    @override
    def resize(self, instance: str, attempt: int, spec: ServiceSpec) -> bool:
        there = self._watch.of(instance, self.options.timeout_s)
        seen = there[-1] if there else None
        if seen is None or seen.attempt != attempt or not seen.running or self._over(seen):
            return False
        if keeps := self.keeps_size(spec):
            raise RuntimeFailure(keeps)
        has = seen.resources
        if has is None:
            raise RuntimeFailure("somebody has taken away what its pod asks for")
        wanted = in_class_of(resources_of(spec), has)
        if wanted == has:
            if seen.unresized:
                raise RuntimeFailure(seen.unresized)
            return not seen.resizing
        used = self._meter.of(seen).memory_bytes
        if used is not None and wanted.memory_limit < min(has.memory_limit, least_memory_mb(used)):
            raise RuntimeFailure(f"it uses {used >> 20} MiB, and so much would be taken from it")
        self._must_lead()  # a change by an earlier leader that comes late is seen, and made good
        path = self.cluster.path("pods", f"{seen.name}/resize")
        with self._doubting():
            self._watch.update(self.cluster.merge_lists(path, patch(seen.uid, wanted)))
        return False  # until its node says so

    @override
    def lead(self, epoch: int) -> None:
        self._fence.lead(epoch)
        self._watch.catch_up()  # after that: what the leader before has begun is in it
        self._remove_unbegun()

    def _must_lead(self) -> None:
        with self._doubting():
            self._fence.must_lead()

    @contextmanager
    def _doubting(self) -> Iterator[None]:
        """Around a call: if the API server is silent, the next look says so."""
        try:
            yield
        except ClusterSilentError as error:
            self._watch.doubt(error)
            raise

    def start(self, launch: Launch) -> None:
        there = self._watch.of(launch.instance, self.options.timeout_s)
        self._must_lead()
        newest = there[-1] if there else None
        if newest is not None and newest.attempt > launch.attempt and not self._over(newest):
            raise OvertakenError(
                f"attempt {newest.attempt} of {launch.instance} runs, which another orchestrator has begun"
            )
        if newest is not None and newest.attempt == launch.attempt:
            if newest.removed:
                raise SiteSilentError("somebody has deleted its pod, which is not gone yet")
            return
        with self._lock:
            told = self._unrun.get(launch.instance)
            if told is not None and told.attempt >= launch.attempt:
                return
        if self._policy_at is None:
            self._hold_policy()
        for seen in there:
            if not self._over(seen) or seen.attempt < launch.attempt - _KEPT:
                self._delete(seen)
        with self._lock:
            self._unrun.pop(launch.instance, None)
        self._create(launch, newest.host_port if newest is not None else None)

    def _create(self, launch: Launch, preferred: int | None) -> None:
        """Have the pod made, and begun unless somebody else leads by now; ``preferred``: the UDP port."""
        openings = resolve(launch.spec.needs.openings)
        port = self._port(launch.instance, preferred) if self.options.reach == "hostport" else None
        node_port = self._services.make(launch.instance)
        if self.options.keep_data:
            hold_claim(self.cluster, launch, self.options, self._owner)
        asked = launch, self.options, self._owner, port, openings
        body = pod(*asked, node_port=node_port, epoch=self._fence.epoch)
        try:
            made = self.cluster.create(self.cluster.path("pods"), body)
        except RefusedError as error:
            if error.reason == "AlreadyExists":
                self._watch.catch_up()
                there = self._watch.of(launch.instance, self.options.timeout_s)
                if not any(seen.attempt == launch.attempt for seen in there):
                    raise SiteSilentError("a pod of this run was removed, and is not gone yet") from error
                return  # another orchestrator has begun this very run
            raise RuntimeFailure(refused(str(error))) from error
        try:
            self._must_lead()  # now that it is there for a later leader to see
            if openings:
                put(self.cluster, "networkpolicies", openings_policy(openings, made, self._owner), NETWORKING)
            put(self.cluster, "secrets", secret(launch, self._owner, made))
        except BaseException:
            with suppress(RuntimeFailure):
                remove_pod(self.cluster, made["metadata"]["name"], made["metadata"]["uid"], grace_s=0)
            raise
        self._begun.add(made["metadata"]["uid"])
        self._waiting[made["metadata"]["uid"]] = launch
        self._watch.update(made)

    def _port(self, instance: str, preferred: int | None) -> int:
        ports = self.options.ports
        there = self._watch.seen(self.options.timeout_s)
        # Its own of the run before is free: that run is ended.
        taken = {seen.host_port for seen in there if not self._over(seen) and seen.instance != instance} | self._refused
        if preferred is None or not ports[0] <= preferred <= ports[1]:
            preferred = usual_port(ports, self._owner, instance)
        port = free_port(ports, preferred, [port for port in taken if port is not None])
        if port is None:
            self._refused.clear()  # whoever had them may be gone
            raise RuntimeFailure(f"every UDP port from {ports[0]} to {ports[1]} is taken (option 'ports')")
        return port

    def _give_other_ports(self, there: Iterable[PodState]) -> None:
        """To pods of ours that no node takes, for others have their ports."""
        for seen in there:
            if seen.node or self._over(seen):
                self._waiting.pop(seen.uid, None)
            elif seen.port_taken and seen.host_port is not None and (launch := self._waiting.pop(seen.uid, None)):
                log.info("site %s: UDP port %d of every node is taken by others", self._site, seen.host_port)
                self._must_lead()
                self._refused.add(seen.host_port)
                self._delete(seen)
                try:
                    self._create(launch, seen.host_port + 1)
                except SiteSilentError:
                    raise
                except RuntimeFailure as error:
                    self._leave(seen, f"could not be started: {error}", unstarted=True)

    def _hold_policy(self) -> None:
        """Have the NetworkPolicy of all pods, as it is to be, whoever has changed or removed it."""
        body = site_policy(self._owner)
        path = self.cluster.path("networkpolicies", body["metadata"]["name"], group=NETWORKING)
        try:
            self.cluster.apply(path, body)
        except RefusedError as error:
            self._blocked = str(error)
            raise
        self._budget.hold()
        self._policy_at, self._blocked = time.monotonic(), ""

    def observe(self) -> Mapping[str, Observation]:
        with self._lock:
            unrun = dict(self._unrun)
        return self._observed(self._watch.seen(self.options.timeout_s), unrun)

    @override
    def observe_some(self, instances: Collection[str]) -> Mapping[str, Observation]:
        there = [seen for instance in instances for seen in self._watch.of(instance, self.options.timeout_s)]
        with self._lock:
            unrun = {instance: self._unrun[instance] for instance in instances if instance in self._unrun}
        return self._observed(there, unrun)

    def _observed(self, there: Iterable[PodState], unrun: Mapping[str, Observation]) -> Mapping[str, Observation]:
        """The newest run of each instance."""
        newest: dict[str, PodState] = {}
        for seen in there:
            if seen.removed:
                continue
            if seen.instance not in newest or newest[seen.instance].attempt < seen.attempt:
                newest[seen.instance] = seen
        found = {
            instance: observation(
                seen,
                self.options,
                self._nodes.address(seen.node),
                self._reports.of(seen.name),
                self._meter.of(seen),
                over=self._over(seen),
                trouble=self._health.trouble(seen, self._watch.ill(seen) and not seen.stops),
                leaving=self._nodes.leaving(seen.node),
                balancer=self._services.balancer(instance),
                step_s=self._reports.step_s(seen.name),
            )
            for instance, seen in newest.items()
        }
        for instance, told in unrun.items():
            if instance not in found or found[instance].attempt <= told.attempt:
                found[instance] = told
        return found

    def _over(self, seen: PodState) -> bool:
        """Whether nothing of it runs any more."""
        return self._watch.over(seen)

    def stop(self, instance: str, *, force: bool) -> None:
        there = self._watch.of(instance, self.options.timeout_s)
        left = [seen for seen in there if not self._over(seen) and not (seen.stops and (seen.running or not force))]
        if not left:
            return  # it is asked again and again until all has ended: the API server is not
        self._must_lead()  # after the look: nothing of it was begun by a later leader
        for seen in left:
            if seen.running:
                self._end(seen)
            else:
                self._delete(seen)
                self._leave(seen, "was stopped before it ran")

    def _leave(self, seen: PodState, detail: str, *, unstarted: bool = False) -> None:
        """Remember how a run ended of which nothing is left."""
        with self._lock:
            self._unrun[seen.instance] = Observation(seen.attempt, Phase.EXITED, detail=detail, unstarted=unstarted)

    def _end(self, seen: PodState, failure: str = "") -> None:
        if (pod := end_pod(self.cluster, seen.name, seen.uid, failure)) is not None:
            self._watch.update(pod)

    def _delete(self, seen: PodState) -> None:
        remove_pod(self.cluster, seen.name, seen.uid, grace_s=1 if seen.node else 0)
        if (
            not seen.node
        ):  # gone at once; the cluster collects its Secret later, by which another pod of its name begins
            self.cluster.delete(self.cluster.path("secrets", seen.name))
        self._watch.forget(seen)

    def remove(self, instance: str) -> None:
        there = self._watch.of(instance, self.options.timeout_s)
        self._must_lead()
        for seen in there:
            self._delete(seen)
        self._services.remove(instance)
        with self._lock:
            self._unrun.pop(instance, None)

    def logs(self, instance: str, lines: int) -> str:
        texts: list[str] = []
        left = lines
        for seen in reversed(self._watch.of(instance, self.options.timeout_s)):
            path = self.cluster.path("pods", f"{seen.name}/log")
            try:
                text = self.cluster.text(path, tailLines=left, limitBytes=4 << 20)
            except RefusedError as error:
                if error.status not in (HTTPStatus.NOT_FOUND, HTTPStatus.BAD_REQUEST):
                    raise
                continue  # it was never begun, or is gone
            texts.append(text)
            left -= text.count("\n")
            if left <= 0:
                break
        return "".join(reversed(texts))

    @override
    def follow(self, instance: str, lines: int) -> LogStream | None:
        there = self._watch.of(instance, self.options.timeout_s)
        return PodLog(self.cluster, there[-1].name, lines) if there and there[-1].running else None

    @override
    def tidy(self) -> None:
        """End what will never run, or runs beside a later run, and remove what was begun by halves."""
        if self._fence.epoch:
            with self._doubting():
                self._fence.lead(self._fence.epoch)  # anew, should somebody have removed what tells of it
        there = self._watch.seen(self.options.timeout_s)
        latest: dict[str, int] = {}
        for seen in there:
            if not self._over(seen):
                latest[seen.instance] = max(seen.attempt, latest.get(seen.instance, 0))
        for seen in there:
            if seen.hopeless and not self._over(seen) and not seen.failure:
                self._end(seen, seen.hopeless)
            elif not self._over(seen) and seen.attempt < latest[seen.instance]:
                self._must_lead()
                self._delete(seen)
        self._give_other_ports(there)
        self._remove_unbegun()
        self._give_up_unbalanced(there)
        if there and time.monotonic() - (self._policy_at or 0.0) >= _POLICY_S:
            with suppress(RefusedError):  # which blocks the site; what runs is looked after all the same
                self._hold_policy()
        self._health.keep({seen.uid for seen in there})
        self._reports.begin()
        self._meter.begin(there)

    def _give_up_unbalanced(self, there: Iterable[PodState]) -> None:
        """Those to which no load balancer passes on."""
        up = [seen for seen in there if seen.running and seen.started and not seen.stops and not self._over(seen)]
        ready = {seen.instance: seen for seen in up}
        all_, live = {seen.instance for seen in there}, {seen.instance for seen in there if not self._over(seen)}
        for instance in self._services.reconcile(all_, ready, all_ - live):
            self._must_lead()
            self._delete(ready[instance])
            within = f"{self.options.load_balancer_timeout_s:g} s"
            why = f"the cluster's load balancer has given its Service no address within {within} (option 'reach')"
            self._leave(ready[instance], f"could not be started: {why}", unstarted=True)

    def _remove_unbegun(self) -> None:
        """Pods that have no Secret: who made them was killed, had no answer, or does not lead any more."""
        for seen in self._watch.seen(self.options.timeout_s):
            if not (self._over(seen) or seen.running or self._is_begun(seen)):
                self._must_lead()
                self._delete(seen)
        self._begun &= {seen.uid for seen in self._watch.seen(self.options.timeout_s)}

    def _is_begun(self, seen: PodState) -> bool:
        if seen.uid in self._begun:
            return True
        try:
            there = self.cluster.get(self.cluster.path("secrets", seen.name))
        except RefusedError as error:
            if error.status == HTTPStatus.NOT_FOUND:
                return False
            raise
        if seen.uid not in [owner["uid"] for owner in there["metadata"].get("ownerReferences") or ()]:
            return False  # of an earlier pod of its name, which the cluster has not collected yet
        self._begun.add(seen.uid)
        return True

    @override
    def dismantle(self) -> None:
        for seen in self._watch.seen(self.options.timeout_s):
            self._delete(seen)
        self._services.clear()
        for one in self.cluster.labelled("networkpolicies", f"{OWNER}={self._owner}", group=NETWORKING):
            self.cluster.delete(self.cluster.path("networkpolicies", one["metadata"]["name"], group=NETWORKING))
        self._budget.remove()
        self._fence.clear()

    @override
    def close(self) -> None:
        self._health.close()
        self._reports.close()
        self._watch.close()
        self._nodes.close()
        self.cluster.close()
