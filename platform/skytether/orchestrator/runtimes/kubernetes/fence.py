"""Which leader acts at a cluster: told by a ConfigMap, changed only by who has read it (``resourceVersion``).

An act cannot be kept from being overtaken between its look and its call. What makes that harmless: a pod is made first,
under a name that only one can have; then it is looked whether another one leads; only then it is begun, by its Secret.
Whatever a later leader finds made and not begun it removes, and the Secret that comes then goes with its pod.

Neither is server-side apply for: it makes what is not there, and changes what is, whoever was there meanwhile. The
ConfigMap is for who has read it, the pod's name for who is first, and both are refused to everybody else.
"""

from __future__ import annotations

from http import HTTPStatus
from typing import Any

from ..base import OvertakenError, SiteSilentError
from .cluster import Cluster, RefusedError
from .objects import leader

_TRIES = 10


class Fence:
    """That of one site. From any thread."""

    def __init__(self, cluster: Cluster, owner: str) -> None:
        self._cluster = cluster
        self._owner = owner
        self._name = leader(owner, 0)["metadata"]["name"]
        self.epoch = 0
        """Of the leader who acts here; 0: whoever it is."""

    def lead(self, epoch: int) -> None:
        """From now on act for the leader of this epoch, and let nobody act for an earlier one; may be called again.

        Raises:
            OvertakenError: A leader of a later epoch was here.
            RuntimeFailure: The API server does not answer, or refuses.
        """
        for _ in range(_TRIES):
            there = self._there()
            found = _epoch(there)
            if found > epoch:
                raise OvertakenError.by_leader(f"the ConfigMap {self._name}", found)
            body = leader(self._owner, epoch)
            try:
                if there is None:
                    self._cluster.create(self._cluster.path("configmaps"), body)
                elif found < epoch:
                    body["metadata"]["resourceVersion"] = there["metadata"]["resourceVersion"]
                    self._cluster.replace(self._cluster.path("configmaps", self._name), body)
            except RefusedError as error:
                if error.status != HTTPStatus.CONFLICT:
                    raise
                continue  # somebody else was faster: look again
            self.epoch = epoch
            return
        raise OvertakenError(f"others change the ConfigMap {self._name} all the time")

    def must_lead(self) -> None:
        """See whether another leader was here.

        Raises:
            OvertakenError: One of a later epoch.
            SiteSilentError: Nobody can tell: what tells of it was removed. Whoever leads makes it again (``lead``).
            RuntimeFailure: The API server does not answer.
        """
        epoch = self.epoch
        if not epoch:
            return
        there = self._there()
        if there is None:
            raise SiteSilentError(f"somebody has removed the ConfigMap {self._name}; it is made again within seconds")
        if (found := _epoch(there)) > epoch:
            raise OvertakenError.by_leader(f"the ConfigMap {self._name}", found)

    def clear(self) -> None:
        """Leave nothing: the site is no more."""
        self._cluster.delete(self._cluster.path("configmaps", self._name))

    def _there(self) -> Any:
        try:
            return self._cluster.get(self._cluster.path("configmaps", self._name))
        except RefusedError as error:
            if error.status == HTTPStatus.NOT_FOUND and error.reason == "NotFound":
                return None
            raise


def _epoch(document: Any) -> int:
    told = str(((document or {}).get("data") or {}).get("epoch", ""))
    return int(told) if told.isdecimal() else 0
