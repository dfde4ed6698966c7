"""Where the sessions of a namespace's pods are, for a relay: its routes follow the pods."""

from __future__ import annotations

import logging
import re
import threading
from collections.abc import Callable, Iterable

from ..base import RuntimeFailure
from ..containers import INNER_PORT
from .cluster import Cluster
from .objects import MANAGED, OWNER
from .options import KubernetesOptions
from .seen import PodState
from .watch import Watch

log = logging.getLogger(__name__)

_LOOK_S = 1.0
_SESSION = re.compile("[0-9a-f]{16}")
Address = tuple[str, int]


def routes_of(pods: Iterable[PodState]) -> dict[str, Address]:
    """Where the newest run of each session listens, as far as it has an address."""
    newest: dict[str, PodState] = {}
    for seen in pods:
        if seen.ended or not seen.address or not _SESSION.fullmatch(seen.session):
            continue
        if seen.session not in newest or newest[seen.session].attempt < seen.attempt:
            newest[seen.session] = seen
    return {session: (seen.address, INNER_PORT) for session, seen in newest.items()}


class PodRoutes:
    """Follows the pods in a thread of its own. While the API server is silent, the routes stay as they are."""

    def __init__(
        self,
        options: KubernetesOptions,
        owner: str | None,
        add: Callable[[str, str, int], None],
        remove: Callable[[str], object],
    ) -> None:
        """Prepare; nothing is asked before ``start``.

        Args:
            options: Of them kubeconfig, context and namespace.
            owner: Of one site; None: the pods of all sites of the namespace.
            add: Routes a session to a host and port, from now on.
            remove: Ends the route of a session.

        Raises:
            RuntimeFailure: The cluster can never be reached.
        """
        self._cluster = Cluster(options)
        labels = {**MANAGED, **({OWNER: owner} if owner is not None else {})}
        self._watch = Watch(self._cluster, ",".join(f"{key}={value}" for key, value in labels.items()))
        self._add, self._remove = add, remove
        self._routes: dict[str, Address] = {}
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="kubernetes-routes", daemon=True)

    def start(self) -> None:
        self._watch.start()
        self._thread.start()

    def close(self) -> None:
        self._closing.set()
        self._watch.changed.set()
        self._thread.join(5.0)
        self._watch.close()
        self._cluster.close()

    def _run(self) -> None:
        while not self._closing.is_set():
            self._watch.changed.wait(_LOOK_S)
            self._watch.changed.clear()
            try:
                wanted = routes_of(seen for seen in self._watch.seen(0) if not self._watch.over(seen))
                self._follow(wanted)
            except RuntimeFailure as error:
                log.debug("routes stay as they are: %s", error)
            except Exception:
                log.exception("routes of a relay are not followed")

    def _follow(self, wanted: dict[str, Address]) -> None:
        for session in [one for one in self._routes if one not in wanted]:
            self._remove(session)
            del self._routes[session]
        for session, address in wanted.items():
            if self._routes.get(session) != address:
                self._add(session, *address)
                self._routes[session] = address
