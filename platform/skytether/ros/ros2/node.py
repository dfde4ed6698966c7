"""Our node on a ROS 2 graph: the Zenoh session, kept in one thread, and what was made of it.

The router need not be there yet: the node tries on, says so once, and says when it has joined. A router that goes and
comes back is found again by Zenoh, which declares everything anew.
"""

from __future__ import annotations

import json
import logging
import queue
import threading
from collections import deque
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from itertools import chain, repeat
from math import inf
from pathlib import Path
from typing import Any, TypeVar

import zenoh

from .dialect import Dialect, Endpoint, NodeName
from .endpoints import Client, Handle, Publication, Server, Subscription
from .graph import Graph, learned_hash, mismatches
from .node_base import NodeBase
from .seam import Ros2Error

_log = logging.getLogger(__name__)

DEFAULT_ROUTER = "tcp/127.0.0.1:7447"
MAX_OUTBOX = 1000
"""Messages of reliable topics that wait for Zenoh."""
MAX_CHANGES = 100_000
"""Changes of the graph that wait for the node's thread."""
_POLL_S = 0.5
_LOOK_S = (2.0, 4.0, 8.0, 16.0)
_RETRY_S = (0.25, 0.5, 1.0, 2.0)
_H = TypeVar("_H", bound=Handle)


class Ros2Node(NodeBase):
    """One node of a ROS 2 graph; every method may be called from any thread.

    Args:
        dialect: How the graph is written in Zenoh.
        router: Address of the graph's Zenoh router, as Zenoh writes it (``tcp/HOST:PORT``, ``tls/HOST:PORT``); None:
            as the configuration file says, or `DEFAULT_ROUTER`.
        config_file: Zenoh's configuration (JSON5), for certificates and the like; we are a client whatever it says.
        name: Who we are.
        say: Told each trouble once, and its end; by default it is logged.
        sim_time: Use simulated time.

    Raises:
        Ros2Error: The configuration file cannot be used.
    """

    def __init__(
        self,
        dialect: Dialect,
        *,
        router: str | None = None,
        config_file: Path | None = None,
        name: NodeName | None = None,
        say: Callable[[str], object] | None = None,
        sim_time: bool = False,
    ) -> None:
        super().__init__(name, say)
        self.dialect = dialect
        self.sim_time = sim_time
        self.log_level = logging.INFO
        self._router = router or ("the one that its configuration names" if config_file else DEFAULT_ROUTER)
        self._config = _config(router or (None if config_file else DEFAULT_ROUTER), config_file)
        self._lock = threading.Lock()
        self._wake = threading.Event()
        self._handles: list[Handle] = []
        self._changes: deque[tuple[str, bool]] = deque(maxlen=MAX_CHANGES)
        self._outbox: queue.Queue[Callable[[], object] | None] = queue.Queue(MAX_OUTBOX)

    def _jobs(self) -> Sequence[Callable[[], None]]:
        return (self._run, self._post)

    def _interrupt(self) -> None:
        self._wake.set()

    def publish(
        self,
        endpoint: Endpoint,
        *,
        waits: bool = False,
        farewell: bytes = b"",
        farewell_after_s: float = 0.0,
        fresh_s: float = inf,
        stuck_s: float | None = None,
        awaited: Collection[str] = (),
    ) -> Publication:
        """Be a publisher; a farewell is not said, because a router has no way to do it for us, and none waits here."""
        del farewell, farewell_after_s, fresh_s, stuck_s, awaited
        publication = Publication(self, endpoint)
        publication.waits = waits
        return self._add(publication)

    def subscribe(
        self,
        endpoint: Endpoint,
        take: Callable[[bytes], object],
        *,
        lose: Callable[[int], object] | None = None,
        every_kept: bool = False,
    ) -> Subscription:
        """Be a subscription; the function gets each serialised message, in a thread of Zenoh's, which drops none."""
        del lose, every_kept
        return self._add(Subscription(self, endpoint, take))

    def serve(self, endpoint: Endpoint, answer: Callable[[bytes], bytes]) -> Server:
        """Be a service; see `Server`."""
        return self._add(Server(self, endpoint, answer))

    def client(self, endpoint: Endpoint) -> Client:
        """Be a client of a service."""
        return self._add(Client(self, endpoint))

    # --- Host --------------------------------------------------------------------------------------------------------

    def changed(self) -> None:
        """Host: have the node's thread look at its handles."""
        self._wake.set()

    def outbox(self, send: Callable[[], object], name: str) -> bool:
        """Host: have something sent that may have to wait."""
        try:
            self._outbox.put_nowait(send)
        except queue.Full:
            self._troubles.report(
                f"outbox {name}", f"{name}: the ROS 2 graph takes messages too slowly; some were dropped"
            )
            return False
        return True

    # --- threads -----------------------------------------------------------------------------------------------------

    def _add(self, handle: _H) -> _H:
        with self._lock:
            self._handles.append(handle)
        self._wake.set()
        return handle

    def _post(self) -> None:
        """Thread of the outbox."""
        while not self._closing.is_set():
            try:
                send = self._outbox.get(timeout=_POLL_S)
            except queue.Empty:
                continue
            if send is not None:
                send()

    def _run(self) -> None:
        """Thread of the session."""
        tried = 0
        while not self._closing.is_set():
            try:
                session = zenoh.open(self._config())
            except zenoh.ZError as error:
                reason = str(error).partition(" at ")[0].strip()
                self._troubles.report(
                    "router", f"the ROS 2 graph's router ({self._router}) is not there: {reason}; trying on"
                )
                self._closing.wait(_RETRY_S[min(tried, len(_RETRY_S) - 1)])
                tried += 1
                continue
            try:
                self._keep(session)
            except zenoh.ZError as error:
                self._troubles.report("router", f"the ROS 2 graph was lost: {error}; trying on")
                self._closing.wait(_RETRY_S[0])
            finally:
                self._joined.clear()
                session.close()  # type: ignore[no-untyped-call]

    def _keep(self, session: zenoh.Session) -> None:
        ours = str(session.zid())
        graph = Graph(self.dialect, ours)
        declared: dict[Handle, list[Any]] = {}
        numbers: dict[Handle, int] = {}
        self._changes.clear()
        live = session.liveliness()
        token = live.declare_token(self.dialect.node_token(ours, self._name))
        # In Zenoh's own thread: what was told before an answer is known before the answer is.
        on_token = zenoh.handlers.Callback(self._on_token, indirect=False)
        watch = live.declare_subscriber(self.dialect.watched, on_token, history=True)
        try:
            patience = chain(_LOOK_S, repeat(_LOOK_S[-1]))
            whole = self._query_graph(session, next(patience))
            while not self._closing.is_set():
                self._check_router(session)
                changed = self._apply_changes(graph)
                with self._lock:
                    self._handles = [h for h in self._handles if not h.closed]
                    wanted = list(self._handles)
                for handle in set(declared) - set(wanted):
                    _retract(handle, declared.pop(handle))
                for handle in wanted:
                    learned = (changed or handle not in declared) and self._review(handle, graph)
                    if learned:
                        _retract(handle, declared.pop(handle, []))
                    if handle not in declared:
                        number = numbers.setdefault(handle, len(numbers) + 1)
                        declared[handle] = self._declare(session, ours, number, handle)
                if not whole:
                    whole = self._query_graph(session, next(patience))
                    continue
                self._joined.set()
                self._wake.wait(_POLL_S)
                self._wake.clear()
        finally:
            for handle, things in declared.items():
                _retract(handle, things)
            watch.undeclare()  # type: ignore[no-untyped-call]
            token.undeclare()  # type: ignore[no-untyped-call]

    def _query_graph(self, session: zenoh.Session, patience_s: float) -> bool:
        """Ask for the graph; whether the answer is whole: who has joined knows all of it.

        The router tells each endpoint once: in this answer, or before it to the subscription.
        """
        replies = list(session.liveliness().get(self.dialect.watched, timeout=patience_s))
        self._changes.extend((str(reply.ok.key_expr), True) for reply in replies if reply.ok is not None)
        if all(reply.ok is not None for reply in replies):
            self.settle("graph")
            return True
        text = f"the ROS 2 graph's router ({self._router}) does not tell of all the graph within {patience_s:g} s"
        self._troubles.report("graph", f"{text}; it is asked again")
        return False

    def _declare(self, session: zenoh.Session, ours: str, number: int, handle: Handle) -> list[Any]:
        token = self.dialect.token(ours, number, self._name, handle.endpoint)
        return [*handle.declare(session, token), session.liveliness().declare_token(token)]

    def _apply_changes(self, graph: Graph) -> bool:
        """Whether the graph is another than before."""
        changed = False
        while self._changes:
            changed |= graph.update(*self._changes.popleft()) is not None
        if changed:
            self._known = graph.known()
        return changed

    def _review(self, handle: Handle, graph: Graph) -> bool:
        """See whether a handle of ours fits the graph. True if it learned its type's hash."""
        ours = handle.endpoint
        others = graph.endpoints(ours.name)
        found = mismatches(ours, others)
        self._troubles.keep(ours.name, [mismatch.reason for mismatch in found])
        # In rmw_zenoh's keys the types stand, so what does not fit never meets; with DDS one has to look.
        handle.refused = found[0].reason if found and not self.dialect.attaches else ""
        if ours.type_hash:
            return False
        handle.endpoint = replace(ours, type_hash=learned_hash(ours, others))
        return handle.endpoint.type_hash != ""

    def _check_router(self, session: zenoh.Session) -> None:
        info = session.info
        if info.routers_zid() or info.peers_zid():
            self._troubles.settle("router", f"the ROS 2 graph's router ({self._router}) is there now")
        else:
            self._troubles.report("router", f"the ROS 2 graph's router ({self._router}) went away; waiting for it")

    def _on_token(self, sample: zenoh.Sample) -> None:
        """In a thread of Zenoh's."""
        self._changes.append((str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT))
        self._wake.set()


def _retract(handle: Handle, things: list[Any]) -> None:
    handle.retract()
    for thing in things:
        thing.undeclare()


def _config(router: str | None, file: Path | None) -> Callable[[], zenoh.Config]:
    """What makes Zenoh's configuration; made once now, so that a mistake in it is told at once."""
    settings: dict[str, Any] = {
        "mode": "client",
        "scouting/multicast/enabled": False,
        "transport/shared_memory/enabled": False,
        "timestamping/enabled": True,  # caches of transient-local publishers go by time stamps
    }
    if router is not None:
        settings["connect/endpoints"] = [router]

    def make() -> zenoh.Config:
        config = zenoh.Config.from_file(file) if file is not None else zenoh.Config()
        for key, value in settings.items():
            config.insert_json5(key, json.dumps(value))
        return config

    try:
        config = make()
        if router is None and not json.loads(config.get_json("connect/endpoints")):
            raise Ros2Error(f"Zenoh configuration {file} names no connect/endpoints; name the graph's router")
    except zenoh.ZError as error:
        what = f"configuration {file}" if file is not None else f"address {router}"
        raise Ros2Error(f"Zenoh does not take the {what}: {str(error).partition(' at ')[0].strip()}") from error
    return make
