"""One topic that the node takes: connections to its publishers, raw messages, and what became of each publisher."""

from __future__ import annotations

import asyncio
import logging
import socket
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from skytether.ros.names import ros1_type

from . import master
from .tcpros import ANY, HeaderError, pack_header, read_frame, read_header, sums_differ

_log = logging.getLogger(__name__)

_CONNECT_S = 5.0
_BACKOFF_S = (0.1, 3.0)
"""First and longest time between tries to reach a publisher that the master still names."""
_REFUSED_S = 30.0
"""Between tries of a publisher of another type: it may have been exchanged."""
_KEPT_LATCHED = 64
"""Publishers whose latched message is kept for a listener that comes later."""
_MOST_PUBLISHERS = 64
"""Of one topic: whoever reaches the node can name thousands, and to look for each costs the program its time."""


@dataclass(frozen=True, slots=True)
class PublisherInfo:
    """What a publisher says about itself in its header.

    Attributes:
        caller: Its node's name.
        type: As ROS 1 has it.
        md5: Of the type.
        definition: Of the type, with those it needs.
        latched: Whether a newcomer gets its last message.
    """

    caller: str
    type: str
    md5: str
    definition: str
    latched: bool


OnMessage = Callable[[bytes, PublisherInfo], None]
"""Called in the node's thread with each message; must return at once."""
OnPublisher = Callable[[PublisherInfo], None]
"""Called in the node's thread when a publisher is connected, before its first message."""


@dataclass(frozen=True, slots=True)
class Listener:
    """Who gets what a subscription takes."""

    on_message: OnMessage
    on_publisher: OnPublisher = lambda _: None


class Subscription:
    """Made by `Node.subscribe`; everything but `close` of the node happens in the node's thread.

    Args:
        node: Own name.
        own_uri: Own address: the node does not listen to itself.
        topic: Absolute name.
        kind: Expected type; ``*``: any.
        md5: Expected sum; empty: that of the first publisher.
        ask: Runs a blocking function elsewhere.
    """

    def __init__(
        self,
        node: str,
        own_uri: str,
        topic: str,
        kind: str,
        md5: str,
        ask: Callable[[Callable[[], object]], asyncio.Future[object]],
    ) -> None:
        self.topic = topic
        self.type = ros1_type(kind)
        self.md5 = md5
        self.listeners: list[Listener] = []
        self.connected: dict[str, PublisherInfo] = {}
        self.refusals: dict[str, str] = {}
        self._node = node
        self._own_uri = own_uri
        self._ask = ask
        self._listed: set[str] = set()
        self._following: dict[str, asyncio.Task[None]] = {}
        self._latched: dict[str, bytes] = {}
        self._said: set[str] = set()

    def add(self, listener: Listener) -> None:
        """One more who listens; gets what was latched before."""
        self.listeners.append(listener)
        for uri, info in self.connected.items():
            listener.on_publisher(info)
            if uri in self._latched:
                listener.on_message(self._latched[uri], info)

    def update(self, uris: list[str]) -> None:
        """The master says who publishes. Connections that work are kept: a restarted master does not know them."""
        named = list(dict.fromkeys(uri for uri in uris if uri != self._own_uri))
        named.sort(key=lambda uri: uri not in self._following)  # whom it follows already it goes on to follow
        if len(named) > _MOST_PUBLISHERS:
            self._log_once(f"topic {self.topic} has more than {_MOST_PUBLISHERS} publishers; the others are left out")
        self._listed = set(named[:_MOST_PUBLISHERS])
        for uri in self._listed - set(self._following):
            self._following[uri] = asyncio.ensure_future(self._follow(uri))
        for uri in set(self._following) - self._listed - set(self.connected):
            self._following.pop(uri).cancel()

    def close(self) -> None:
        """End all connections."""
        self._listed = set()
        self.listeners.clear()
        for task in self._following.values():
            task.cancel()

    async def _follow(self, uri: str) -> None:
        """Stay connected to one publisher while the master names it."""
        pause, longest = _BACKOFF_S
        try:
            while uri in self._listed:
                try:
                    await self._listen(uri)
                    pause = _BACKOFF_S[0]
                except (OSError, EOFError, HeaderError, TimeoutError, master.MasterError) as error:
                    _log.debug("%s from %s: %s", self.topic, uri, error)
                finally:
                    self.connected.pop(uri, None)
                    self._latched.pop(uri, None)
                if uri in self._listed:
                    await asyncio.sleep(_REFUSED_S if uri in self.refusals else pause)
                    pause = min(2 * pause, longest)
        finally:
            self.refusals.pop(uri, None)
            if self._following.get(uri) is asyncio.current_task():
                del self._following[uri]

    async def _listen(self, uri: str) -> None:
        """One connection, to its end."""
        found = await self._ask(partial(master.call, uri, "requestTopic", self._node, self.topic, [["TCPROS"]]))
        if not isinstance(found, list) or len(found) != 3 or not isinstance(found[2], int):
            raise HeaderError(f"{uri} offers {self.topic} by nothing that is known here")
        async with asyncio.timeout(_CONNECT_S):
            reader, writer = await asyncio.open_connection(str(found[1]), found[2], limit=2**20)
        try:
            tune(writer)
            async with asyncio.timeout(_CONNECT_S):
                writer.write(
                    pack_header(
                        {
                            "callerid": self._node,
                            "topic": self.topic,
                            "type": ANY,
                            "md5sum": ANY,
                            "message_definition": "",
                            "tcp_nodelay": "1",
                        }
                    )
                )
                header = await read_header(reader)
            info = self._accept(uri, header)
            if info is not None:
                await self._receive(uri, info, reader)
        finally:
            writer.close()

    def _accept(self, uri: str, header: dict[str, str]) -> PublisherInfo | None:
        """Compare types; None and a refusal if they differ."""
        if "error" in header:
            raise HeaderError(f"{uri} refuses: {header['error']}")
        info = PublisherInfo(
            header.get("callerid", uri),
            header.get("type", ""),
            header.get("md5sum", ""),
            header.get("message_definition", ""),
            header.get("latching") == "1",
        )
        wrong_type = self.type != ANY and info.type not in (ANY, self.type)
        if wrong_type or sums_differ(self.md5, info.md5):
            refusal = (
                f"topic {self.topic}: {info.caller} publishes {info.type} with MD5 {info.md5}, but {self.type} with "
                f"MD5 {self.md5 or 'unknown here'} is wanted; it is left out"
            )
            self.refusals[uri] = refusal
            self._log_once(refusal)
            return None
        self.refusals.pop(uri, None)
        if not self.md5 and info.md5 != ANY:
            self.type, self.md5 = info.type, info.md5
        return info

    async def _receive(self, uri: str, info: PublisherInfo, reader: asyncio.StreamReader) -> None:
        self.connected[uri] = info
        for listener in self.listeners:
            listener.on_publisher(info)
        while True:
            frame = await read_frame(reader)
            if isinstance(frame, int):
                self._log_once(
                    f"topic {self.topic}: a message of {frame} bytes is too large for a session; it is left out"
                )
                continue
            if info.latched and (uri in self._latched or len(self._latched) < _KEPT_LATCHED):
                self._latched[uri] = frame
            for listener in self.listeners:
                listener.on_message(frame, info)

    def _log_once(self, sentence: str) -> None:
        """Each once."""
        if sentence not in self._said and len(self._said) < _KEPT_LATCHED:
            self._said.add(sentence)
            _log.error("%s", sentence)


def tune(writer: asyncio.StreamWriter) -> None:
    """No waiting to fill packets, and an end is noticed although nothing is sent."""
    sock: socket.socket = writer.get_extra_info("socket")
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for option, seconds in (("TCP_KEEPIDLE", 10), ("TCP_KEEPINTVL", 5), ("TCP_KEEPCNT", 3)):
        if hasattr(socket, option):
            sock.setsockopt(socket.IPPROTO_TCP, getattr(socket, option), seconds)
