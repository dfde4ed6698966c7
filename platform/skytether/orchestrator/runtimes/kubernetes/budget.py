"""The PodDisruptionBudget of a site: who drains a node waits until what serves there has been moved."""

from __future__ import annotations

import logging
from http import HTTPStatus

from .cluster import Cluster, RefusedError
from .objects import disruption_budget

log = logging.getLogger(__name__)

_KIND = "poddisruptionbudgets"
_VERSIONS = ("policy/v1", "policy/v1beta1")
"""The second one until Kubernetes 1.21, which has the first."""


class Budget:
    """That of one site."""

    def __init__(self, cluster: Cluster, owner: str) -> None:
        self._cluster = cluster
        self._owner = owner
        self._versions: tuple[str, ...] = _VERSIONS
        """That may be the cluster's; none: we have no right to it."""

    def hold(self) -> None:
        """Have it, whoever has changed or removed it, unless we may not: that is said once.

        Raises:
            SiteSilentError: The API server does not answer.
        """
        for version in self._versions:
            try:
                self._cluster.apply(self._path(version), disruption_budget(self._owner, version))
            except RefusedError as error:
                if error.status == HTTPStatus.NOT_FOUND and version != self._versions[-1]:
                    continue
                log.warning("who drains a node will not wait until robots have been handed over: %s", error)
                self._versions = ()
            else:
                self._versions = (version,)
            return

    def remove(self) -> None:
        """Have it no more."""
        for version in self._versions:
            try:
                self._cluster.delete(self._path(version))
            except RefusedError as error:
                if error.status != HTTPStatus.FORBIDDEN:  # so nor could we make it
                    raise

    def _path(self, version: str) -> str:
        return self._cluster.path(_KIND, f"skytether-{self._owner}", group=version)
