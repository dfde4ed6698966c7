"""The Services by which the instances of a site are reached: at ports of the nodes, or at a load balancer."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection
from typing import Any

from ..base import RuntimeFailure, SiteSilentError
from .cluster import Cluster, RefusedError
from .objects import INSTANCE, OWNER, balanced_address, service, service_name
from .options import KubernetesOptions

_SWEEP_S = 60.0
"""Seconds between two looks for Services whose instances are gone."""
_STEP_S = 10.0
"""How often it is told anew for how long a load balancer has been waited for."""
Address = tuple[str, int]


class Services:
    """Those of one site. Used from the site's own thread."""

    def __init__(
        self,
        cluster: Cluster,
        options: KubernetesOptions,
        owner: str,
        must_lead: Callable[[], None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """``must_lead``: raises where another orchestrator leads by now."""
        self._cluster = cluster
        self._options = options
        self._owner = owner
        self._must_lead = must_lead
        self._clock = clock
        self._balanced = options.reach == "loadbalancer"
        self._used = self._balanced or options.reach == "nodeport"
        self._swept_at = clock() if not self._balanced else -_SWEEP_S
        self._addresses: dict[str, Address] = {}
        """Of load balancers, by instance."""
        self._waits_since: dict[str, float] = {}
        """Instances whose pod is ready and whose load balancer has given no address, by the clock [s]."""
        self._idle_since: dict[str, float] = {}
        """Instances of which nothing runs, by the clock [s]."""

    def make(self, instance: str) -> int | None:
        """Have the instance's Service, as it was made before or anew; its port of the nodes, None: it has none.

        Raises:
            SiteSilentError: The one before is not gone yet.
            RuntimeFailure: The API server does not answer, or refuses.
        """
        if not self._used:
            return None
        try:
            there = self._cluster.apply(self._path(instance), service(instance, self._owner, self._options))
        except RefusedError as error:
            raise RuntimeFailure(f"the cluster refuses it: {error}") from error
        if "deletionTimestamp" in there["metadata"]:
            raise SiteSilentError("somebody has deleted its Service, which is not gone yet")
        return None if self._balanced else int(there["spec"]["ports"][0]["nodePort"])

    def balancer(self, instance: str) -> Address | str | None:
        """At which a load balancer passes on to it, or why there is no such address; None: it is reached otherwise."""
        if not self._balanced:
            return None
        if instance in self._addresses:
            return self._addresses[instance]
        for_s = int(self._waited_s(instance) // _STEP_S * _STEP_S)
        return (
            f"the cluster's load balancer has given its Service no address yet, for {for_s} s: "
            f"'kubectl -n {self._cluster.namespace} describe service {service_name(self._owner, instance)}' says why"
        )

    def reconcile(self, there: Collection[str], ready: Collection[str], idle: Collection[str] = ()) -> list[str]:
        """See which addresses were given, remove what is left of others, and make again what somebody has removed.

        Args:
            there: Instances that have pods.
            ready: Those of them whose service is up.
            idle: Those of them of which nothing runs: they have ended, or wait for their next run. That is begun within
                a minute, or else at another port or address.

        Returns:
            Those of ``ready`` that have waited for an address for too long.

        Raises:
            OvertakenError: Another orchestrator leads by now.
            RuntimeFailure: The API server does not answer, or refuses.
        """
        if not self._used:
            return []
        now = self._clock()
        waiting = self._balanced and any(instance not in self._addresses for instance in ready)
        if not waiting and now - self._swept_at < _SWEEP_S:
            return []
        self._swept_at = now
        found = {one["metadata"]["labels"].get(INSTANCE, ""): one for one in self._list()}
        self._idle_since = {instance: self._idle_since.get(instance, now) for instance in idle if instance in found}
        left = {instance for instance, since in self._idle_since.items() if now - since >= _SWEEP_S}
        for instance, one in found.items():
            if (instance not in there or instance in left) and "deletionTimestamp" not in one["metadata"]:
                self._must_lead()
                self._cluster.delete(self._cluster.path("services", one["metadata"]["name"]))
        if not self._balanced:
            return []
        given = {instance: balanced_address(one) for instance, one in found.items() if instance in there}
        self._addresses = {instance: address for instance, address in given.items() if address is not None}
        for instance in ready:
            if instance not in found:
                self._must_lead()
                self.make(instance)
        lacking = [instance for instance in ready if instance not in self._addresses]
        self._waits_since = {instance: self._waits_since.get(instance, now) for instance in lacking}
        return [one for one in lacking if self._waited_s(one) > self._options.load_balancer_timeout_s]

    def _waited_s(self, instance: str) -> float:
        now = self._clock()
        return now - self._waits_since.get(instance, now)

    def remove(self, instance: str) -> None:
        """One that is not there is removed already."""
        if self._used:
            self._cluster.delete(self._path(instance))
        self._addresses.pop(instance, None)
        self._waits_since.pop(instance, None)

    def clear(self) -> None:
        """Leave none: the site is no more."""
        for one in self._list() if self._used else ():
            self._cluster.delete(self._cluster.path("services", one["metadata"]["name"]))

    def _path(self, instance: str) -> str:
        return self._cluster.path("services", service_name(self._owner, instance))

    def _list(self) -> list[dict[str, Any]]:
        return self._cluster.labelled("services", f"{OWNER}={self._owner}")
