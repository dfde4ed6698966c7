"""A node of a ROS 1 graph: topics and services as bytes, parameters. Needs no ROS.

One thread with an event loop moves all bytes; one speaks to the master (`registry`); others answer XML-RPC. Every
method may be called from any thread, and waits for the network only where it says that it blocks.
"""

from __future__ import annotations

import asyncio
import concurrent.futures
import contextlib
import ipaddress
import os
import socket
import threading
from collections.abc import Callable, Collection, Coroutine, Mapping
from dataclasses import dataclass
from functools import partial
from types import TracebackType
from typing import Any, TypeVar
from urllib.parse import urlsplit

from skytether.messages import definition_of
from skytether.ros.names import bridge_type, resolve

from . import services
from .master import Master
from .publication import QUEUE, Publication, Speaking
from .registry import LOOK_S, Registry
from .services import CallRefusedError, ServiceServer, ServiceType
from .slave import MOST_CONNECTIONS, SlaveServer
from .subscription import Listener, Subscription, tune
from .tcpros import HeaderError, pack_header, read_header

_T = TypeVar("_T")

_SAME_NAME = "new node registered with same name"
"""What a ROS master says to the node that it ends for it."""
_HEADER_S = 10.0
"""For a connection to say what it is for."""
_WORKERS = 16
"""Requests to other nodes, and service calls, at the same time."""
_CONNECTIONS = 1024
"""That a node has from others at a time: each takes a file descriptor."""


class NodeError(Exception):
    """The node cannot be; the text says what to change."""


@dataclass(eq=False)
class _Subscribed:
    subscription: Subscription
    node: Node

    @property
    def name(self) -> str:
        return self.subscription.topic

    def register(self, master: Master) -> None:
        topic = self.subscription.topic
        found = master.register_subscriber(topic, self.subscription.type, self.node.uri)
        self.node.publishers_changed(topic, found)

    def unregister(self, master: Master) -> None:
        master.unregister_subscriber(self.subscription.topic, self.node.uri)

    def is_missed(self, _: Master) -> bool:
        return False


@dataclass(eq=False)
class _Published:
    publication: Publication
    node: Node

    @property
    def name(self) -> str:
        return self.publication.topic

    def register(self, master: Master) -> None:
        master.register_publisher(self.publication.topic, self.publication.type, self.node.uri)

    def unregister(self, master: Master) -> None:
        master.unregister_publisher(self.publication.topic, self.node.uri)

    def is_missed(self, master: Master) -> bool:
        return self.publication.is_missed(partial(master.subscribers, self.publication.topic))


@dataclass(eq=False)
class _Served:
    server: ServiceServer
    node: Node

    @property
    def name(self) -> str:
        return self.server.name

    def register(self, master: Master) -> None:
        master.register_service(self.server.name, self.node.rosrpc, self.node.uri)

    def unregister(self, master: Master) -> None:
        master.unregister_service(self.server.name, self.node.rosrpc)

    def is_missed(self, _: Master) -> bool:
        return False


class Node:
    """Joins a graph once started; a context manager.

    Attributes:
        name: Absolute.
        master: For parameters, and for looking around.
        uri: Address of its XML-RPC, once started.
        rosrpc: Address of its services, once started.

    Args:
        name: Absolute, or below the root.
        master_uri: ``http://HOST:PORT``. Nobody need be there yet.
        host: Address of this machine that other nodes reach; found out from the environment and the way to the master
            if not given.
        on_end: Called in a thread of its own if the master or a person wants the node to end. None: it goes on, and
            keeps its name against others that register by it.
        look_s: Between looks at the master.
        connections: That it has from others at a time, and as many again, up to 256, for XML-RPC. If more come, the
            oldest goes that has not said what it is for.
    """

    def __init__(
        self,
        name: str,
        master_uri: str,
        *,
        host: str | None = None,
        on_end: Callable[[str], None] | None = None,
        look_s: float = LOOK_S,
        connections: int = _CONNECTIONS,
    ) -> None:
        self.name = resolve(name, "/")
        self.master_uri = master_uri
        self.master = Master(master_uri, self.name)
        self.uri = self.rosrpc = ""
        self._host = host or own_host(master_uri, os.environ)
        self._port = 0
        self._on_end = on_end
        self._registry = Registry(self.master, self.name, lambda: self.uri, look_s)
        self._lock = threading.Lock()
        self._subscriptions: dict[str, _Subscribed] = {}
        self._publications: dict[str, _Published] = {}
        self._services: dict[str, _Served] = {}
        self._connections: set[asyncio.Task[None]] = set()
        self._silent: dict[asyncio.StreamWriter, None] = {}
        """Of these, in the order in which they came, those that have not said what they are for."""
        self._most_connections = connections
        self._loop = asyncio.new_event_loop()
        self._workers = concurrent.futures.ThreadPoolExecutor(_WORKERS, thread_name_prefix="ros1-ask")
        self._thread: threading.Thread | None = None
        self._server: asyncio.Server | None = None
        self._api: SlaveServer | None = None

    def start(self) -> None:
        """Listen and begin to register.

        Raises:
            NodeError: The host is not this machine.
        """
        bind = _bind_address(self._host)
        try:
            self._server = self._loop.run_until_complete(asyncio.start_server(self._on_connection, bind, 0))
            self._port = self._server.sockets[0].getsockname()[1]
            self._api = SlaveServer(self, bind, most=min(MOST_CONNECTIONS, self._most_connections))
        except OSError as error:
            self._loop.close()
            raise NodeError(f"cannot listen at {self._host}: {error.strerror or error}; set host, or ROS_IP") from error
        self.uri = f"http://{self._host}:{self._api.port}/"
        self.rosrpc = f"rosrpc://{self._host}:{self._port}"
        self._thread = threading.Thread(target=self._loop.run_forever, name="ros1-node", daemon=True)
        self._thread.start()
        self._registry.start()

    def close(self) -> None:
        """Take all registrations back and end all connections. May be called again."""
        if self._thread is None or self._api is None:
            return
        self._registry.close()
        self._api.close()
        asyncio.run_coroutine_threadsafe(self._shut(), self._loop).result()
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._thread = None
        self._workers.shutdown(wait=False, cancel_futures=True)
        self._loop.close()

    @property
    def master_present(self) -> bool | None:
        """Whether the master answered when last asked; None before the first answer."""
        return self._registry.present

    def subscribe(self, topic: str, kind: str, md5: str, listener: Listener) -> Callable[[], None]:
        """Take a topic from whoever publishes it, now or later.

        Args:
            topic: Absolute name.
            kind: Its type; ``*``: any.
            md5: Of the type; empty: that of the first publisher.
            listener: Who gets the messages. Listeners of one topic share its connections, and the first one's type.

        Returns:
            Ends it.
        """
        with self._lock:
            entry = self._subscriptions.get(topic)
            if entry is None:
                subscription = Subscription(self.name, self.uri, topic, kind, md5, self._ask)
                entry = self._subscriptions[topic] = _Subscribed(subscription, self)
                self._registry.want(entry)
        found = entry
        self.soon(lambda: found.subscription.add(listener))

        def remove() -> None:
            if listener in found.subscription.listeners:
                found.subscription.listeners.remove(listener)
            if found.subscription.listeners:
                return
            with self._lock:
                if self._subscriptions.get(topic) is not found:
                    return
                del self._subscriptions[topic]
            self._registry.drop(found)
            found.subscription.close()

        def end() -> None:
            self.soon(remove)

        return end

    def advertise(
        self,
        topic: str,
        kind: str,
        md5: str,
        definition: str = "",
        *,
        latched: bool = False,
        queue: int = QUEUE,
        hold_s: float = 0.0,
        speaking: Speaking = contextlib.nullcontext,
        awaited: Collection[str] = (),
    ) -> Publication:
        """Publish a topic.

        Args:
            topic: Absolute name.
            kind: Its type.
            md5: Of the type.
            definition: Of the type, for recorders; looked up if it is not given.
            latched: Newcomers get the last message.
            queue: Messages that wait for a slow subscriber; the newest win.
            hold_s: How long messages wait for a first subscriber while there is none; as many as in the queue.
            speaking: Entered while the node's thread looks whether a message is still fresh, and sends it.
            awaited: Names of the nodes that it is for, as `Publication.renewed` counts them; empty: any that listens.

        Raises:
            ValueError: This node publishes it already.
        """
        definition = definition or definition_of(bridge_type(kind), "ros1")
        publication = Publication(
            self.name,
            self.soon,
            topic,
            kind,
            md5,
            definition,
            latched=latched,
            queue=queue,
            hold_s=hold_s,
            speaking=speaking,
            awaited=awaited,
        )
        with self._lock:
            if topic in self._publications:
                raise ValueError(f"{topic} is published by this node already")
            entry = self._publications[topic] = _Published(publication, self)
        self._registry.want(entry)
        return publication

    def unadvertise(self, publication: Publication) -> None:
        """Publish it no more."""
        with self._lock:
            entry = self._publications.pop(publication.topic, None)
        if entry is not None:
            self._registry.drop(entry)
            self.soon(publication.close)

    def serve(self, name: str, kind: ServiceType, handler: services.Handler) -> ServiceServer:
        """Offer a service.

        Raises:
            ValueError: This node offers it already.
        """
        server = ServiceServer(self.name, name, kind, handler)
        with self._lock:
            if name in self._services:
                raise ValueError(f"{name} is offered by this node already")
            entry = self._services[name] = _Served(server, self)
        self._registry.want(entry)
        return server

    def unserve(self, server: ServiceServer) -> None:
        """Offer it no more."""
        with self._lock:
            entry = self._services.pop(server.name, None)
        if entry is not None:
            self._registry.drop(entry)

    def find_service(self, name: str) -> tuple[tuple[str, int], ServiceType] | None:
        """Address and type of somebody's service; None if nobody offers it. Blocks.

        Raises:
            MasterError: The master does not answer.
            CallRefusedError: The service does not say what it is.
        """
        address = self.master.lookup_service(name)
        return None if address is None else (address, services.probe(address, self.name, name))

    def call_service(self, name: str, request: bytes, timeout: float, md5: str = "") -> bytes:
        """Call somebody's service, serialised request in, serialised answer out. Blocks.

        Raises:
            MasterError: The master does not answer.
            CallRefusedError: Nobody offers it, or it failed.
        """
        address = self.master.lookup_service(name)
        if address is None:
            raise CallRefusedError(f"nobody offers the service {name}")
        return services.call(address, self.name, name, md5, request, timeout)

    def soon(self, callback: Callable[[], None]) -> bool:
        """Have something done in the node's thread; False if that has ended."""
        try:
            self._loop.call_soon_threadsafe(callback)
        except RuntimeError:
            return False
        return True

    def publishers_by_topic(self) -> Mapping[str, tuple[Mapping[str, Any], Mapping[str, str]]]:
        """By topic that the node takes: publishers that are connected, and refusals; both by address."""
        with self._lock:
            entries = list(self._subscriptions.values())
        return {e.subscription.topic: (dict(e.subscription.connected), dict(e.subscription.refusals)) for e in entries}

    # --- what other nodes ask (`slave.NodeApi`), in threads of the API ---------------------------------------------

    def publishers_changed(self, topic: str, uris: list[str]) -> None:
        with self._lock:
            entry = self._subscriptions.get(topic)
        if entry is not None:
            self.soon(partial(entry.subscription.update, uris))

    def offered(self, topic: str) -> tuple[str, int] | None:
        with self._lock:
            return (self._host, self._port) if topic in self._publications else None

    def publications(self) -> list[list[str]]:
        with self._lock:
            return [[e.publication.topic, e.publication.type] for e in self._publications.values()]

    def subscriptions(self) -> list[list[str]]:
        with self._lock:
            return [[e.subscription.topic, e.subscription.type] for e in self._subscriptions.values()]

    def connections(self) -> list[list[Any]]:
        with self._lock:
            publications = [e.publication for e in self._publications.values()]
        taken = [(topic, uri) for topic, (connected, _) in self.publishers_by_topic().items() for uri in connected]
        given = [(p.topic, caller) for p in publications for caller in p.subscribers]
        rows = [(uri, "i", topic) for topic, uri in taken] + [(caller, "o", topic) for topic, caller in given]
        return [[i, who, way, "TCPROS", topic, True] for i, (who, way, topic) in enumerate(rows)]

    def asked_to_end(self, reason: str) -> None:
        if self._on_end is None:
            return
        if _SAME_NAME in reason:
            self._registry.hold()  # else each would register again, and have the other one ended
            reason = (
                f"another node registered as {self.name}, and a name is one node's alone: start that one or this one "
                "with another name (ros1.node in robot.yaml, __name:= or __ns:= of ROS)"
            )
        threading.Thread(target=self._on_end, args=(reason,), name="ros1-end", daemon=True).start()

    # --- in the node's thread --------------------------------------------------------------------------------------

    def _ask(self, function: Callable[[], _T]) -> asyncio.Future[_T]:
        return self._loop.run_in_executor(self._workers, function)

    def _on_connection(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if len(self._connections) >= self._most_connections:
            oldest = next(iter(self._silent), None)
            if oldest is None:
                writer.close()
                return
            del self._silent[oldest]
            oldest.close()  # what serves it ends by that
        self._silent[writer] = None
        task = self._loop.create_task(self._guarded(self._serve(reader, writer), writer))
        self._connections.add(task)
        task.add_done_callback(self._connections.discard)

    async def _guarded(self, work: Coroutine[Any, Any, None], writer: asyncio.StreamWriter) -> None:
        try:
            await work
        except (OSError, EOFError, HeaderError, TimeoutError):
            pass  # the other side's end or nonsense: its matter
        finally:
            self._silent.pop(writer, None)
            writer.close()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        tune(writer)
        async with asyncio.timeout(_HEADER_S):
            header = await read_header(reader)
        self._silent.pop(writer, None)
        with self._lock:
            service = self._services.get(header.get("service", ""))
            published = self._publications.get(header.get("topic", ""))
        if service is not None:
            await service.server.serve(header, reader, writer, self._ask)
        elif published is not None:
            await published.publication.serve(header, reader, writer)
        else:
            wanted = header.get("service") or header.get("topic") or "it"
            writer.write(pack_header({"error": f"{self.name} does not offer {wanted} (any more)"}))
            await writer.drain()

    async def _shut(self) -> None:
        if self._server is not None:
            self._server.close()
        for entry in self._subscriptions.values():
            entry.subscription.close()
        for published in self._publications.values():
            published.publication.close()
        for task in self._connections:
            task.cancel()
        ends = asyncio.all_tasks() - {asyncio.current_task()}
        for task in ends:
            task.cancel()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(1.0):
                await asyncio.gather(*ends, return_exceptions=True)

    def __enter__(self) -> Node:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def own_host(master_uri: str, environ: Mapping[str, str]) -> str:
    """Address under which others reach this machine: what ROS's variables say, else that of the way to the master."""
    named = environ.get("ROS_HOSTNAME") or environ.get("ROS_IP")
    if named:
        return named
    parts = urlsplit(master_uri)
    with contextlib.suppress(OSError, ValueError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.connect((parts.hostname or "localhost", parts.port or 11311))  # sends nothing
        return str(sock.getsockname()[0])
    return "127.0.0.1"


def _bind_address(host: str) -> str:
    """Loopback stays loopback; for everything else every interface: a name may have several addresses."""
    with contextlib.suppress(ValueError):
        return host if ipaddress.ip_address(host).is_loopback else "0.0.0.0"  # noqa: S104
    return "127.0.0.1" if host == "localhost" else "0.0.0.0"  # noqa: S104
