"""The node: does what the agent says over the socket, tells it what comes, and ends when the agent is gone."""

from __future__ import annotations

import base64
import contextlib
import json
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable
from inspect import signature
from math import inf
from typing import Any

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.serialization import deserialize_message, serialize_message
from rclpy.service import Service
from rclpy.signals import SignalHandlerOptions
from rclpy.subscription import Subscription
from rclpy.utilities import get_rmw_implementation_identifier

try:
    from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
except ImportError:  # Humble
    from rclpy.qos_event import PublisherEventCallbacks, SubscriptionEventCallbacks

from . import definitions, graph, types
from .frames import (
    FOR_ALL,
    SHUT_DOWN,
    Frame,
    Kind,
    control,
    fresh,
    numbered,
    pull_frame,
    pull_fresh,
    pull_number,
    push_head,
)
from .fresh import FreshPublisher
from .outbox import FIRST, Sender
from .speaking import Speaking
from .stalls import STOOD_S, TURN_S, Stalls

LOOK_S = 0.2
"""Between two looks at the topics that the agent has something to do with."""
EVERY = 10
"""Each so many of them it is the whole graph."""
GRAPH = 0xFFFF_FFFF
"""Channel in which the newest graph waits; where it is read slowly, older ones are left out."""
ALIVE = 0xFFFF_FFFE
"""Channel of a sign of life each `ALIVE_S`, from the thread that does the work."""
ALIVE_S = 0.5
MAX_ASKED = 64
"""Calls of one service that wait for the agent; who comes then is not answered."""
NAMED_S = 1.0
"""For an endpoint's node to be known, which comes a moment later; then it counts without a name."""
HEAR_S, HEARS = 0.005, 4
"""Between looks whether a message is acknowledged, and how many of them follow each message."""
VELOCITIES = {"geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped"}
"""Late, they are worse than none: whoever has them drives on."""
_TELLS_TIMES = hasattr(Subscription, "CallbackType")
"""Whether this `rclpy` says of a message when it was published."""


class _Server:
    """A service whose answers come later, from the agent."""

    def __init__(self, service: Service, ask: Callable[[int, bytes], object]) -> None:
        self.service = service
        self._ask = ask
        self._waiting: dict[int, Any] = {}
        self._numbers = 0
        # An executor hands the callback's result to `send_response`, beside the header that tells who asked: so the
        # request is what our callback gives back, and it is answered when the answer is there. A coroutine would do the
        # same, but keeps executors of several distributions busy as long as it waits.
        service.send_response = self._asked

    def _asked(self, request: Any, header: Any) -> None:
        if len(self._waiting) >= MAX_ASKED:
            del self._waiting[next(iter(self._waiting))]
        self._numbers += 1
        self._waiting[self._numbers] = header
        self._ask(self._numbers, bytes(serialize_message(request)))

    def answer(self, number: int, body: bytes) -> None:
        """Answer a call."""
        header = self._waiting.pop(number, None)
        if header is not None:
            Service.send_response(self.service, deserialize_message(body, self.service.srv_type.Response), header)

    def leave(self, number: int) -> None:
        """Do not answer a call: ROS 2 has no word for a failure, and its client waits as long as it wants to."""
        self._waiting.pop(number, None)


class Program:
    """One node.

    Args:
        link: To the agent.
        start: Name, namespace, arguments, and where to say that it is about to publish a velocity, as the agent tells
            them.
    """

    def __init__(self, link: socket.socket, start: dict[str, Any]) -> None:
        self._ended, self._spoke = threading.Event(), threading.Event()
        # A log file below the home folder is of use to nobody, and where that cannot be written there is no node.
        arguments = ["skytether", "--ros-args", "--disable-external-lib-logs", *start["arguments"]]
        rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
        knows = "enable_logger_service" in signature(rclpy.create_node).parameters  # Jazzy and newer
        more = {"enable_logger_service": True} if knows else {}
        self._node = rclpy.create_node(start["node"], namespace=start["namespace"], **more)
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self._node)
        # The reader sees the end too, behind what was told before it: no velocity may follow the farewell.
        self._sender = Sender(link)
        for channel in (GRAPH, ALIVE):
            self._sender.set(channel, FIRST, 1)
        self._lock = threading.Lock()
        self._names: dict[int, str] = {}
        self._publishers: dict[int, Any] = {}
        self._fresh: dict[int, FreshPublisher] = {}
        """Of those the ones whose messages are published in time or never."""
        self._farewells: dict[int, tuple[bytes, float]] = {}
        place = start["speaks"]
        self._speaking: Callable[[], contextlib.AbstractContextManager[None]]
        self._speaking = Speaking(*place) if place else contextlib.nullcontext
        self._subscriptions: dict[int, Any] = {}
        self._besides: dict[int, Any] = {}
        """To what some publishers keep for newcomers, where others keep nothing."""
        self._servers: dict[int, _Server] = {}
        self._clients: dict[int, Any] = {}
        self._pending: dict[tuple[int, int], Any] = {}
        self._lost: dict[int, int] = {}
        self._stale: dict[int, int] = {}
        """What came while this process stood still, and was not taken."""
        self._all: list[list[Any]] = []
        self._unnamed: dict[str, float] = {}
        self._send(
            what="ready",
            rmw=get_rmw_implementation_identifier(),
            domain=os.environ.get("ROS_DOMAIN_ID", "0"),
            distribution=os.environ.get("ROS_DISTRO", ""),
            name=self._node.get_fully_qualified_name(),
        )

    def run(self, stream: Any) -> int:
        """Be the node until the agent's end of the socket is closed, or ROS 2 is shut down; returns the exit code."""
        self._stalls = Stalls(_now())  # to become the node took its time
        for job in (lambda: self._read(stream), self._watch, self._turn, self._hear):
            threading.Thread(target=job, daemon=True).start()
        alive_at = 0.0
        while not self._ended.is_set() and rclpy.ok():
            if time.monotonic() >= alive_at:
                alive_at = time.monotonic() + ALIVE_S
                self._sender.put(control(what="alive"), ALIVE)
            try:
                self._executor.spin_once(timeout_sec=ALIVE_S)
            except ExternalShutdownException:
                break
            except Exception as error:  # one bad message or request must not end the node
                self._report(0, error)
        code = 0 if self._ended.is_set() else SHUT_DOWN
        self._leave()
        return code

    def _leave(self) -> None:
        page = self._speaking.page if isinstance(self._speaking, Speaking) else bytes
        for channel, (body, after_s) in self._farewells.items():
            with contextlib.suppress(Exception):
                self._fresh[channel].say_farewell(body, after_s, page)
        self._sender.close()
        with contextlib.suppress(Exception):
            rclpy.try_shutdown()

    def _send(self, **what: Any) -> None:
        self._sender.put(control(**what))

    def _report(self, channel: int, error: Exception) -> None:
        """Tell what went wrong; where ROS 2 was shut down nothing can go well, and the exit code tells of that."""
        if rclpy.ok():
            said = str(error) if isinstance(error, types.NotInstalledError) else f"{type(error).__name__}: {error}"
            self._send(what="trouble", channel=channel, why=said)

    # --- from the agent ----------------------------------------------------------------------------------------------

    def _read(self, stream: Any) -> None:
        while True:
            frame = None
            with contextlib.suppress(OSError):  # of an agent that was killed before it had read all of ours
                frame = pull_frame(stream)
            if frame is None:
                self._ended.set()
                self._executor.create_task(lambda: None)  # wakes it
                return
            try:
                self._do(frame)
            except Exception as error:
                self._report(frame.channel, error)

    def _do(self, frame: Frame) -> None:
        if frame.kind is Kind.DATA:
            publisher = self._publishers.get(frame.channel)
            if publisher is not None:
                publisher.publish(frame.body)
        elif frame.kind is Kind.FRESH:
            if (publication := self._fresh.get(frame.channel)) is not None:
                try:
                    publication.publish(*pull_fresh(frame.body))
                finally:  # or what waits for an answer would wait for ever
                    self._sender.put(publication.answer(frame.channel))
                    self._spoke.set()
        elif frame.kind is Kind.CONTROL:
            what = json.loads(frame.body)
            try:
                getattr(self, f"_do_{what.pop('do')}")(**what)
            except types.NotInstalledError as error:
                self._report(what.get("channel", 0), error)
        elif frame.kind is Kind.REQUEST:
            self._call(frame.channel, *pull_number(frame.body))
        elif frame.channel in self._servers:
            number, body = pull_number(frame.body)
            server = self._servers[frame.channel]
            if frame.kind is Kind.RESPONSE:
                server.answer(number, body)
            else:
                server.leave(number)

    def _do_publish(
        self,
        channel: int,
        name: str,
        kind: str,
        reliable: bool,
        transient_local: bool,
        depth: int,
        farewell: str,
        farewell_after_s: float,
        lifespan_s: float | None,
        awaited: list[str],
    ) -> None:
        self._names[channel] = name
        self._sender.set(channel, FIRST, 1)
        qos = graph.profile(reliable, transient_local, depth, lifespan_s)
        cls, came = types.load(kind), [0]
        try:  # an event that nobody takes would have the executor wait no more
            events = PublisherEventCallbacks(matched=lambda event: came.__setitem__(0, event.total_count))
            publisher = self._node.create_publisher(cls, name, qos, event_callbacks=events)
        except Exception:  # Humble, or this middleware, does not tell
            publisher, came = self._node.create_publisher(cls, name, qos), []
        self._publishers[channel] = publisher
        self._fresh[channel] = FreshPublisher(
            self._node,
            publisher,
            inf if lifespan_s is None else lifespan_s,
            lambda: came[0] if came else None,
            awaited,
            self._speaking,
            _now,
        )
        if farewell:
            self._farewells[channel] = base64.b64decode(farewell), farewell_after_s

    def _do_watch(self, channel: int, name: str) -> None:
        self._names[channel] = name

    def _do_subscribe(
        self,
        channel: int,
        name: str,
        kind: str,
        reliable: bool,
        transient_local: bool,
        depth: int,
        priority: int,
        keep: int,
        besides: bool,
    ) -> None:
        """Subscribe, or again with another quality: the new one first, so that the graph is never without."""
        self._names[channel] = name
        self._sender.set(channel, priority, keep)

        def put(message: bytes) -> None:
            self._stalls.note(channel, _now())
            self._sender.put(Frame(Kind.DATA, channel, message))

        take: Callable[..., object] = put
        if kind in VELOCITIES:
            take = self._taker_of_velocities(channel)
        before = self._subscriptions.pop(channel, None)
        cls, qos = types.load(kind), graph.profile(reliable, transient_local, depth)
        events = self._events(channel)
        try:
            new = self._node.create_subscription(cls, name, take, qos, raw=True, event_callbacks=events)
        except Exception:  # this middleware does not tell of lost messages
            new = self._node.create_subscription(cls, name, take, qos, raw=True)
        self._subscriptions[channel] = new
        if before is not None:
            self._node.destroy_subscription(before)
        if besides and channel not in self._besides:
            kept = graph.profile(True, True, depth)  # who does not acknowledge is told nothing of before
            quiet = SubscriptionEventCallbacks(use_default_callbacks=False)  # others do not fit, as is known
            self._besides[channel] = self._node.create_subscription(
                cls, name, take, kept, raw=True, event_callbacks=quiet
            )

    def _taker_of_velocities(self, channel: int) -> Callable[..., object]:
        """What `rclpy` calls with each."""

        def take(message: bytes, info: Any) -> None:
            sent = info["source_timestamp"]  # in ns; 0 where it is not told
            self._stalls.note(channel, _now())
            if self._stalls.is_old(channel, time.time() - sent / 1e9 if sent else None, _now()):
                self._stale[channel] = self._stale.get(channel, 0) + 1
            else:
                self._sender.put(fresh(channel, 0, _now() + STOOD_S, FOR_ALL, message))

        return take if _TELLS_TIMES else lambda message: take(message, {"source_timestamp": 0})

    def _turn(self) -> None:
        """Thread that sees this process stand still, and who listens."""
        while not self._ended.wait(TURN_S):
            self._stalls.turn(_now())
            for channel, publication in list(self._fresh.items()):
                with contextlib.suppress(Exception):  # it is seen, and told, with what is published next
                    if publication.look():
                        self._sender.put(publication.answer(channel))

    def _hear(self) -> None:
        """Thread that sees it soon when all who listen have acknowledged what was published."""
        while not self._ended.is_set():
            if not self._spoke.wait(TURN_S):
                continue
            self._spoke.clear()
            for _ in range(HEARS):
                if self._ended.wait(HEAR_S):
                    return
                for channel, publication in list(self._fresh.items()):
                    with contextlib.suppress(Exception):
                        if publication.hear():
                            self._sender.put(publication.answer(channel))

    def _do_serve(self, channel: int, name: str, kind: str, priority: int) -> None:
        self._names[channel] = name
        self._sender.set(channel, priority, MAX_ASKED)

        def ask(number: int, body: bytes) -> None:
            self._sender.put(numbered(Kind.REQUEST, channel, number, body))

        service = self._node.create_service(types.load(kind), name, lambda request, _: request)
        self._servers[channel] = _Server(service, ask)

    def _do_client(self, channel: int, name: str, kind: str, priority: int) -> None:
        self._names[channel] = name
        self._sender.set(channel, priority, MAX_ASKED)
        self._clients[channel] = self._node.create_client(types.load(kind), name)

    def _do_close(self, channel: int) -> None:
        self._names.pop(channel, None)
        self._farewells.pop(channel, None)
        self._fresh.pop(channel, None)
        server = self._servers.pop(channel, None)
        for thing, destroy in (
            (self._publishers.pop(channel, None), self._node.destroy_publisher),
            (self._subscriptions.pop(channel, None), self._node.destroy_subscription),
            (self._besides.pop(channel, None), self._node.destroy_subscription),
            (self._clients.pop(channel, None), self._node.destroy_client),
            (server.service if server else None, self._node.destroy_service),
        ):
            if thing is not None:
                destroy(thing)
        self._sender.remove(channel)

    def _do_define(self, kind: str) -> None:
        """Tell a type's definition: from a thread, for reading files must hold no velocity up."""

        def send() -> None:
            text = ""  # of a type that is not here; whoever subscribes says so
            with contextlib.suppress(Exception):
                text = definitions.definition(kind)
            self._send(what="definition", kind=kind, text=text)

        threading.Thread(target=send, daemon=True).start()

    def _do_forget(self, channel: int, number: int) -> None:
        future = self._pending.pop((channel, number), None)
        if future is not None and channel in self._clients:
            self._clients[channel].remove_pending_request(future)

    def _call(self, channel: int, number: int, body: bytes) -> None:
        client = self._clients.get(channel)
        if client is None or not client.service_is_ready():
            name = self._names.get(channel, "this service")
            why = f"{name}: no node of the ROS 2 graph offers this service"
            self._sender.put(numbered(Kind.FAILURE, channel, number, why.encode()))
            return

        def answer(future: Any) -> None:
            self._pending.pop((channel, number), None)
            response = future.result()
            if response is not None:
                self._sender.put(numbered(Kind.RESPONSE, channel, number, bytes(serialize_message(response))))

        future = client.call_async(deserialize_message(body, client.srv_type.Request))
        self._pending[channel, number] = future
        future.add_done_callback(answer)

    # --- of the graph ------------------------------------------------------------------------------------------------

    def _events(self, channel: int) -> SubscriptionEventCallbacks:
        """Count what a subscription loses because we take it too slowly, or not at all for a while."""

        def lost(event: Any) -> None:
            counted = self._stale if self._stalls.explains(channel) else self._lost
            counted[channel] = counted.get(channel, 0) + event.total_count_change

        callbacks = SubscriptionEventCallbacks(use_default_callbacks=False)
        callbacks.message_lost = lost
        return callbacks

    def _watch(self) -> None:
        """Thread that looks at the graph, and tells it when it is another."""
        told = ""
        turn = 0
        while not self._ended.wait(LOOK_S if turn else 0.0):
            try:
                news = self._poll_graph(whole=turn % EVERY == 0)
            except Exception as error:
                if self._ended.is_set() or not rclpy.ok():
                    return
                news = {"what": "trouble", "channel": 0, "why": f"the graph cannot be looked at: {error}"}
            turn += 1
            text = json.dumps(news)
            if text != told:
                told = text
                self._sender.put(control(**news), GRAPH)

    def _poll_graph(self, *, whole: bool) -> dict[str, Any]:
        wanted = {self._node.resolve_topic_name(name): name for name in list(self._names.values())}
        if whole or self._awaits_names():
            served = {self._names.get(channel, "") for channel in list(self._servers)}
            asked = {self._names.get(channel, "") for channel in list(self._clients)}
            self._all = graph.list_endpoints(self._node, None) + graph.list_services(self._node, served, asked)
        else:
            services = [e for e in self._all if e[1] in (graph.SERVER, graph.CLIENT)]
            rest = [e for e in self._all if e not in services and e[2] not in wanted]
            self._all = rest + services + graph.list_endpoints(self._node, sorted(wanted))
        known = self._known(sorted(self._all, key=lambda e: str(e[0])))
        endpoints = [[*e[:2], wanted.get(e[2], e[2]), *e[3:]] for e in known]
        nodes, same = graph.others(self._node)
        # Of a publisher only answers wait here, the newest of which says all.
        dropped = {c: n for c, n in self._sender.dropped().items() if c not in self._publishers}
        missed = {*dropped, *self._lost, *self._stale}
        lost = {c: [dropped.get(c, 0) + self._lost.get(c, 0), self._stale.get(c, 0)] for c in missed}
        news = {"what": "graph", "endpoints": endpoints, "nodes": nodes, "same": same, "lost": lost}
        sim_time = self._node.get_parameter_or("use_sim_time").value is True
        return {**news, "sim_time": sim_time, "log_level": int(self._node.get_logger().get_effective_level())}

    def _awaits_names(self) -> bool:
        """Whether nodes of endpoints are about to be known; those of services only the whole look tells."""
        now = time.monotonic()
        return any(now - since < NAMED_S for since in self._unnamed.values())

    def _known(self, endpoints: list[list[Any]]) -> list[list[Any]]:
        """Those whose nodes are known, or will not be."""
        now = time.monotonic()
        unnamed = {e[0] for e in endpoints if not e[5]}
        self._unnamed = {key: self._unnamed.get(key, now) for key in unnamed}
        return [e for e in endpoints if e[5] or now - self._unnamed[e[0]] >= NAMED_S]


def _now() -> float:
    """Of the clock that the agent has, too [s]."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)


def main(arguments: list[str], on_node: Callable[[], object] = lambda: None) -> int:
    """Be the node of the agent that has the other end of a socket.

    Args:
        arguments: The socket's descriptor.
        on_node: Called when the node is there.
    """
    for ignored in (signal.SIGINT, signal.SIGTERM):  # whoever ends the agent ends this program, by the socket
        signal.signal(ignored, signal.SIG_IGN)
    link = socket.socket(fileno=int(arguments[0]))
    stream = link.makefile("rb", buffering=256 * 1024)
    first = pull_frame(stream)
    if first is None:
        return 0
    try:
        program = Program(link, json.loads(first.body))
        on_node()
    except Exception as error:
        with contextlib.suppress(OSError):
            frame = control(what="refused", why=f"{type(error).__name__}: {error}")
            link.sendall(push_head(frame) + frame.body)
        return 1
    code = program.run(stream)
    sys.stdout.flush()
    os._exit(code)  # threads of the middleware may hang
