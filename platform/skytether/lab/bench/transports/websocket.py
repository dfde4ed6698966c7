"""As rosbridge and Foxglove do: one WebSocket for all topics, each message in CBOR with its topic's name."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from typing import ClassVar

import cbor2
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect
from websockets.sync.connection import Connection
from websockets.sync.server import Server, serve

from skytether.wire.topic import Role

from .base import Deliver, EndSpec, Transport
from .queue import LatestQueue

_RETRY_S = 0.05
_LARGEST = 32 * 1024 * 1024


class WebsocketTransport(Transport):
    """No compression, TCP_NODELAY; a queue of the topics' depth in front of each, served by importance."""

    TCP = True
    ABOUT: ClassVar[str] = "one WebSocket, CBOR, no compression, TCP_NODELAY, as rosbridge and Foxglove"

    def __init__(self, spec: EndSpec, deliver: Deliver) -> None:
        super().__init__(spec, deliver)
        self._index = {flow.name: i for i, flow in enumerate(spec.flows)}
        self._queue = LatestQueue({i: (spec.flows[i].rank, spec.flows[i].depth) for i in spec.sends})
        self._connection: Connection | None = None
        self._server: Server | None = None
        self._closing = False

    def start(self) -> None:
        if self.spec.role is Role.SERVICE:
            sock = socket.create_server(self.spec.address)
            self._server = serve(self._use, sock=sock, compression=None, max_size=_LARGEST)
            threading.Thread(target=self._server.serve_forever, name="websocket", daemon=True).start()
        else:
            threading.Thread(target=self._connect, name="websocket", daemon=True).start()

    def connected(self) -> bool:
        return self._connection is not None

    def publish(self, index: int, payload: bytes) -> None:
        self._queue.put(index, payload)

    def stop(self) -> None:
        self._closing = True
        self._queue.close()
        if self._connection is not None:
            with contextlib.suppress(OSError):  # at once, whatever still waits in the kernel
                self._connection.socket.shutdown(socket.SHUT_RDWR)
        if self._server is not None:
            self._server.shutdown()

    def _connect(self) -> None:
        host, port = self.spec.address
        while not self._closing:
            with contextlib.suppress(OSError):
                self._use(connect(f"ws://{host}:{port}", compression=None, max_size=_LARGEST))
            time.sleep(_RETRY_S)

    def _use(self, connection: Connection) -> None:
        """Send and receive until the connection ends."""
        connection.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._connection = connection
        threading.Thread(target=self._send, args=(connection,), name="websocket-send", daemon=True).start()
        with contextlib.suppress(ConnectionClosed):
            for frame in connection:
                message = cbor2.loads(frame)  # type: ignore[arg-type]  # no text frame is ever sent
                self.deliver(self._index[message["topic"]], message["msg"])

    def _send(self, connection: Connection) -> None:
        with contextlib.suppress(ConnectionClosed, OSError):
            while (item := self._queue.get()) is not None:
                index, payload = item
                message = {"op": "publish", "topic": self.spec.flows[index].name, "msg": payload}
                connection.send(cbor2.dumps(message))
