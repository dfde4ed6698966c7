"""Our node on a ROS 2 graph through rclpy: the program that has it, and what was made of it.

The program is started, watched and, if it ends, started again; everything is made anew then. A robot whose program is
away is told nothing, and says so.
"""

from __future__ import annotations

import itertools
import json
import logging
import os
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from math import inf
from pathlib import Path
from typing import Any, TypeVar

from skytether.guard.board import Place

from ..dialect import Endpoint, Kind, NodeName
from ..graph import mismatches
from ..node_base import NodeBase
from ..qos import Qos, clash
from .handles import Client, Handle, Publication, Server, Subscription
from .interpreter import find_python
from .side.frames import SHUT_DOWN, Frame, control, pull_frame
from .side.frames import Kind as FrameKind
from .side.outbox import Sender

SILENT_S = 5.0
"""Without a sign of life of the program, which gives one each half second: then it hangs, and is ended."""
BEGIN_S = 30.0
"""For the program to be our node; on a small computer that has just been started it takes some seconds."""
ALONE_S = 20.0
"""Without any other node in the graph: then that is said. ``--check`` waits for less."""
NOBODY = (
    "no other node is seen: do they have the same ROS_DOMAIN_ID and RMW_IMPLEMENTATION, and may they be "
    "discovered (ROS_AUTOMATIC_DISCOVERY_RANGE, ROS_STATIC_PEERS)?"
)
LEAVE_S = 3.0
"""For the program to end by itself."""
_SIDE = Path(__file__).parent / "side" / "__main__.py"
_BUFFER = 256 * 1024
_RETRY_S = (0.25, 0.5, 1.0, 2.0, 5.0)
_H = TypeVar("_H", bound=Handle)


class RclpyNode(NodeBase):
    """One node of a ROS 2 graph; every method may be called from any thread.

    Args:
        name: Who we are.
        python: That has rclpy; None: it is found.
        domain: ``ROS_DOMAIN_ID``; None: as in the environment.
        environment: Of the program; None: this process's.
        arguments: For rclpy, as they follow ``--ros-args``: remappings, enclave, log level.
        say: Told each trouble once, and its end; by default it is logged.
        place: Where the program says that it is about to publish something with ``fresh_s``.

    Raises:
        Ros2Error: There is no Python with rclpy.
    """

    def __init__(
        self,
        name: NodeName | None = None,
        *,
        python: str | None = None,
        domain: int | None = None,
        environment: Mapping[str, str] | None = None,
        arguments: Sequence[str] = (),
        say: Callable[[str], object] | None = None,
        place: Place | None = None,
    ) -> None:
        super().__init__(name, say)
        self._place = place
        given = os.environ if environment is None else environment
        self.python = find_python(python, given)
        """That has rclpy."""
        self._environment = dict(given) if domain is None else {**given, "ROS_DOMAIN_ID": str(domain)}
        self._arguments = list(arguments)
        self._lock = threading.RLock()
        self._handles: dict[int, Handle] = {}
        self._channels = itertools.count(1)
        self._sender: Sender | None = None
        self._link: socket.socket | None = None
        self._lost: dict[int, tuple[int, int]] = {}
        """By channel: messages that the program lost, and those that it did not take for they had waited."""
        self.nodes = 0
        """Other nodes of the graph."""
        self.middleware = ""
        """``rmw_fastrtps_cpp``, once joined."""
        self.domain = ""
        """``ROS_DOMAIN_ID``, once joined."""
        self.pid = 0
        """Of the program; 0: there is none now."""
        self.sim_time = False
        """Whether our node's parameter ``use_sim_time`` is set now."""
        self._definitions: dict[str, str | None] = {}
        """By type; None: the program is asked."""
        self.log_level = logging.INFO
        """Of our node's logger: ``--log-level`` and the service ``set_logger_levels`` set it."""
        self._heard = 0
        """Frames of the program."""
        self._hung_s = 0.0
        """For how long a program was silent that was ended for it [s]; 0: it ended by itself."""

    def _jobs(self) -> Sequence[Callable[[], None]]:
        return (self._run, self._see_that_it_answers)

    def _interrupt(self) -> None:
        with self._lock:
            if self._link is not None:
                self._link.shutdown(socket.SHUT_RDWR)

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
        """Be a publisher; see `skytether.ros.ros2.seam.GraphNode`."""
        return self._add(
            Publication(
                self,
                next(self._channels),
                endpoint,
                waits=waits,
                farewell=farewell,
                farewell_after_s=farewell_after_s,
                fresh_s=fresh_s,
                stuck_s=stuck_s,
                awaited=awaited,
            )
        )

    def subscribe(
        self,
        endpoint: Endpoint,
        take: Callable[[bytes], object],
        *,
        lose: Callable[[int], object] | None = None,
        every_kept: bool = False,
    ) -> Subscription:
        """Be a subscription; the function gets each serialised message, in the node's thread."""
        return self._add(Subscription(self, next(self._channels), endpoint, take, lose, every_kept=every_kept))

    def serve(self, endpoint: Endpoint, answer: Callable[[bytes], bytes]) -> Server:
        """Be a service; see `Server`."""
        return self._add(Server(self, next(self._channels), endpoint, answer))

    def client(self, endpoint: Endpoint) -> Client:
        """Be a client of a service."""
        return self._add(Client(self, next(self._channels), endpoint))

    def definition(self, type_name: str) -> str | None:
        """See `skytether.ros.ros2.seam.GraphNode`: the program looks for it."""
        with self._lock:
            if type_name not in self._definitions and self._sender is not None:
                self._definitions[type_name] = None
                self._sender.put(control(do="define", kind=type_name))
            return self._definitions.get(type_name)

    # --- Host --------------------------------------------------------------------------------------------------------

    def remove(self, handle: Handle) -> None:
        """Host: have the graph without it."""
        with self._lock:
            if self._handles.pop(handle.channel, None) is None:
                return
            handle.leave()
            if self._sender is not None:
                self._sender.put(control(do="close", channel=handle.channel))
                self._sender.remove(handle.channel)
        for what in ("overrun", "stale"):
            self.settle(f"{what} {handle.channel}")

    # --- the program -------------------------------------------------------------------------------------------------

    def _add(self, handle: _H) -> _H:
        with self._lock:
            self._handles[handle.channel] = handle
            if self._sender is not None:
                handle.join(self._sender)
                if self.middleware:
                    handle.begin()
                self._review(handle)
        return handle

    def _run(self) -> None:
        """Thread of the node."""
        tried = 0
        while not self._closing.is_set():
            try:
                key, why = "program", f"{self._why(self._be_one_program())}; it is started again"
            except (OSError, RuntimeError) as error:  # no descriptor, memory or thread is left, or no Python is there
                key, why = "start", f"cannot be started: {error}; it is tried again"
            if self._joined.is_set():
                tried = 0
                self._joined.clear()
            if not self._closing.is_set():
                self.report(key, f"the program that is our ROS 2 node {why}")
                self._closing.wait(_RETRY_S[min(tried, len(_RETRY_S) - 1)])
                tried += 1

    def _be_one_program(self) -> int:
        """Start the program and keep it until it ends; returns its exit code.

        Raises:
            OSError, RuntimeError: It cannot be started or kept.
        """
        ours, its = socket.socketpair()
        with ours:
            with its:
                program = subprocess.Popen(
                    [self.python, str(_SIDE), str(its.fileno())],
                    pass_fds=[its.fileno(), *([self._place.file] if self._place else [])],
                    stdin=subprocess.DEVNULL,
                    env=self._environment,
                )
            self.pid = program.pid
            try:
                self._keep(ours)
            finally:
                self.pid = 0
                code = _end(program)
        return code

    def _why(self, code: int) -> str:
        """How the program ended."""
        hung_s, self._hung_s = self._hung_s, 0.0
        if hung_s:
            return f"did not answer for {hung_s:g} s and was ended"
        if code == SHUT_DOWN:
            return "ended because ROS 2 was shut down in it"
        return f"ended by {signal.Signals(-code).name}" if code < 0 else f"ended with code {code}"

    def _see_that_it_answers(self) -> None:
        """Thread that ends a program which hangs, and says if there is no other node, or too much comes.

        It counts its own turns, for this process may stand still, too.
        """
        turn_s, known, silent, alone = SILENT_S / 10, (0, 0), 0, 0
        while not self._closing.wait(turn_s):
            seen = self._heard, self.pid
            silent = silent + 1 if seen == known and self.pid else 0
            known = seen
            alone = alone + 1 if self._joined.is_set() and not self.nodes else 0
            if alone * turn_s >= ALONE_S:
                self.report("alone", f"ROS 2 graph ({self.middleware}, domain {self.domain}): {NOBODY}")
            elif self.nodes:
                self.settle("alone")
            self._check_queues(time.monotonic())
            limit_s = SILENT_S if self.middleware else BEGIN_S
            if silent * turn_s >= limit_s:
                silent, self._hung_s = 0, limit_s
                with self._lock:
                    if self._link is not None:  # then it is ended by whoever started it
                        self._link.shutdown(socket.SHUT_RDWR)

    def _keep(self, link: socket.socket) -> None:
        """Tell a new program what to be, and take what it tells until it ends."""
        sender = Sender(link)
        name = self._name
        sender.put(
            control(node=name.name, namespace=name.namespace, arguments=self._arguments, speaks=self._place or ())
        )
        with self._lock:
            if self._closing.is_set():
                return
            self._link, self._sender = link, sender
            for handle in self._handles.values():
                handle.join(sender)
        try:
            with link.makefile("rb", buffering=_BUFFER) as stream:
                while (frame := pull_frame(stream)) is not None:
                    self._heard += 1
                    self._on_frame(frame)
        except OSError:
            pass
        finally:
            with self._lock:
                self._link = self._sender = None
                self._known, self._lost, self.middleware = {}, {}, ""
                self._definitions = {kind: text for kind, text in self._definitions.items() if text is not None}
                for handle in self._handles.values():
                    handle.leave()
            sender.close()

    def _on_frame(self, frame: Frame) -> None:
        if frame.kind is not FrameKind.CONTROL:
            handle = self._handles.get(frame.channel)
            if handle is not None:
                handle.on_frame(frame)
            return
        told = json.loads(frame.body)
        match told["what"]:
            case "ready":
                self.middleware, self.domain = told["rmw"], told["domain"]
                with self._lock:
                    for handle in self._handles.values():
                        handle.begin()
                self._troubles.settle("refused")
                self._troubles.settle("start")
                self._troubles.settle("program", "our ROS 2 node is there again")
            case "refused":
                self.report("refused", f"ROS 2 does not let us be a node: {told['why']}; trying on")
            case "trouble":
                self._trouble(told["channel"], told["why"])
            case "definition":
                self._definitions[told["kind"]] = told["text"]
            case "graph":
                self._update_graph(told)
                self._joined.set()

    def _trouble(self, channel: int, why: str) -> None:
        handle = self._handles.get(channel)
        name = handle.endpoint.name if handle is not None else "ROS 2"
        self.report(f"trouble {name} {why}", f"{name}: {why}")

    # --- the graph ---------------------------------------------------------------------------------------------------

    def _update_graph(self, told: dict[str, Any]) -> None:
        """The graph is another."""
        self.nodes, self.sim_time, self.log_level = told["nodes"], told["sim_time"], told["log_level"]
        known = {str(row[0]): _endpoint(row) for row in told["endpoints"]}
        changed = known != self._known
        self._known = known
        with self._lock:
            handles = list(self._handles.values())
            if changed:
                for handle in handles:
                    self._review(handle)
            for handle in handles:
                lost, stale = told["lost"].get(str(handle.channel), (0, 0))
                self._count(handle, lost, stale)
        if told["same"]:
            name = f"{self._name.namespace.rstrip('/')}/{self._name.name}"
            self.report(
                "same", f"another node of this ROS 2 graph is called {name}, too: name ours otherwise (ros2.node)"
            )
        else:
            self.settle("same")

    def _review(self, handle: Handle) -> None:
        """See whether a handle of ours fits the graph, and have it follow."""
        ours = handle.endpoint
        others = self.endpoints(ours.name, ours.kind.answers)
        found = mismatches(ours, others)
        # A publisher is taken from nobody who fits by somebody who does not: ROS 2 connects the former alone.
        fits = ours.kind is Kind.PUBLISHER and len(found) < len(others)
        handle.refused = found[0].reason if found and not fits else ""
        sentences = [mismatch.reason for mismatch in found]
        if ours.kind is Kind.PUBLISHER:
            sentences += [f"{ours.name}: {c}" for c in clashes(ours, others)]
        self._troubles.keep(ours.name, sentences)
        handle.review([other for other in others if other.type == ours.type])

    def _count(self, handle: Handle, lost: int, stale: int) -> None:
        """What the program lost because somebody was too slow, and what it did not take because it had waited."""
        lost_before, stale_before = self._lost.get(handle.channel, (0, 0))
        self._lost[handle.channel] = lost, stale
        if lost > lost_before:
            handle.lose(lost - lost_before)
        if isinstance(handle, Subscription) and stale > stale_before:
            handle.discard(stale - stale_before)

    def _check_queues(self, now: float) -> None:
        with self._lock:
            subscriptions = [handle for handle in self._handles.values() if isinstance(handle, Subscription)]
        for handle in subscriptions:
            for what, sentence in (("overrun", handle.overrun(now)), ("stale", handle.stood_still())):
                if sentence:
                    self.report(f"{what} {handle.channel}", sentence)
                else:
                    self.settle(f"{what} {handle.channel}")


def clashes(ours: Endpoint, others: Sequence[Endpoint]) -> list[str]:
    """Subscriptions that get nothing of what we publish, because they ask for more than we offer; a sentence each."""
    found = ((other.node, clash(ours.qos, other.qos)) for other in others if other.kind is Kind.SUBSCRIPTION)
    return [f"the subscription{' of ' if node else ''}{node} gets nothing: {why}" for node, why in found if why]


def _endpoint(row: list[Any]) -> Endpoint:
    _, kind, name, type_name, type_hash, node, reliable, transient_local, depth, *more = row
    deadline, manual, lease, *parts = more
    qos = Qos(reliable, transient_local, depth, deadline, manual, lease)
    return Endpoint(Kind(kind), name, type_name, type_hash, qos, node, parts=(parts[0], parts[1]))


def _end(program: subprocess.Popen[bytes]) -> int:
    """The program has lost us, so it ends; whatever hangs is killed."""
    try:
        return program.wait(LEAVE_S)
    except subprocess.TimeoutExpired:
        program.kill()
        return program.wait()
