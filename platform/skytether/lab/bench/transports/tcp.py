"""What ROS 1 does across a link: a TCP connection for each topic, TCP_NODELAY, a short queue in front of each."""

from __future__ import annotations

import contextlib
import socket
import struct
import threading
import time
from typing import ClassVar

from skytether.wire.topic import Role

from .base import Deliver, EndSpec, Transport
from .queue import LatestQueue

_LENGTH = struct.Struct("<I")
_RETRY_S = 0.05


class TcpTransport(Transport):
    """The robot opens all connections; the first byte of each is the flow's index."""

    TCP = True
    ABOUT: ClassVar[str] = "a connection for each topic, TCP_NODELAY, as ROS 1"

    def __init__(self, spec: EndSpec, deliver: Deliver) -> None:
        super().__init__(spec, deliver)
        self._queues = {i: LatestQueue({i: (1, spec.flows[i].depth)}) for i in spec.sends}
        self._sockets: dict[int, socket.socket] = {}
        self._listener: socket.socket | None = None
        self._closing = False

    def start(self) -> None:
        if self.spec.role is Role.SERVICE:
            self._listener = socket.create_server(self.spec.address)
            threading.Thread(target=self._accept, args=(self._listener,), name="tcp", daemon=True).start()
        else:
            for index in range(len(self.spec.flows)):
                threading.Thread(target=self._connect, args=(index,), name=f"tcp-{index}", daemon=True).start()

    def connected(self) -> bool:
        return len(self._sockets) == len(self.spec.flows)

    def publish(self, index: int, payload: bytes) -> None:
        self._queues[index].put(index, payload)

    def stop(self) -> None:
        self._closing = True
        for queue in self._queues.values():
            queue.close()
        for sock in (*self._sockets.values(), *([self._listener] if self._listener else [])):
            with contextlib.suppress(OSError):
                sock.shutdown(socket.SHUT_RDWR)
            sock.close()

    def _accept(self, listener: socket.socket) -> None:
        while not self._closing:
            with contextlib.suppress(OSError):  # the end
                sock, _ = listener.accept()
                index = sock.recv(1)[0]
                threading.Thread(target=self._serve, args=(index, sock), name=f"tcp-{index}", daemon=True).start()

    def _connect(self, index: int) -> None:
        while not self._closing:
            try:
                sock = socket.create_connection(self.spec.address)
            except OSError:
                time.sleep(_RETRY_S)
                continue
            sock.sendall(bytes((index,)))
            self._serve(index, sock)
            return

    def _serve(self, index: int, sock: socket.socket) -> None:
        """Send or receive one flow until the connection ends."""
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._sockets[index] = sock
        with contextlib.suppress(OSError):  # the end
            if index in self._queues:
                while (item := self._queues[index].get()) is not None:
                    payload = item[1]
                    sock.sendall(_LENGTH.pack(len(payload)) + payload)
            else:
                with sock.makefile("rb", buffering=1 << 16) as stream:
                    while len(head := stream.read(_LENGTH.size)) == _LENGTH.size:
                        self.deliver(index, stream.read(_LENGTH.unpack(head)[0]))
