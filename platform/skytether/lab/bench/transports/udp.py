"""Datagrams and nothing else: what the link does to a message that is left alone."""

from __future__ import annotations

import contextlib
import socket
import threading
from typing import ClassVar

from skytether.bridge.datagrams import grow_buffers
from skytether.wire.topic import Role

from .base import Deliver, EndSpec, Transport

_HELLO = b"\xff"
_HELLO_S = 0.02
_LARGEST = 65_536


class UdpTransport(Transport):
    """One datagram for each message, its first byte the flow's index. IP cuts what is larger than the MTU."""

    ABOUT: ClassVar[str] = "one datagram a message, fragmented by IP as it comes"

    def __init__(self, spec: EndSpec, deliver: Deliver) -> None:
        super().__init__(spec, deliver)
        self._peer: tuple[str, int] | None = None
        self._heard = threading.Event()
        self._closing = False
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        grow_buffers(self._socket)
        self._thread = threading.Thread(target=self._run, name="udp", daemon=True)

    def start(self) -> None:
        if self.spec.role is Role.SERVICE:
            self._socket.bind(self.spec.address)
        else:
            self._peer = self.spec.address
            self._socket.connect(self._peer)
            threading.Thread(target=self._greet, name="udp-hello", daemon=True).start()
        self._thread.start()

    def connected(self) -> bool:
        return self._heard.is_set()

    def publish(self, index: int, payload: bytes) -> None:
        with contextlib.suppress(OSError):  # lost, as on the way
            self._send(bytes((index,)) + payload)

    def stop(self) -> None:
        self._closing = True
        self._heard.set()
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)  # wakes the thread, whether connected or not
        self._thread.join()
        self._socket.close()

    def _send(self, data: bytes) -> None:
        if self.spec.role is Role.ROBOT:
            self._socket.send(data)
        elif self._peer is not None:
            self._socket.sendto(data, self._peer)

    def _greet(self) -> None:
        """Tell the service where the robot is, until it answers."""
        while not self._heard.wait(_HELLO_S):
            with contextlib.suppress(OSError):
                self._send(_HELLO)

    def _run(self) -> None:
        buffer = memoryview(bytearray(_LARGEST))
        while not self._closing:
            try:
                size, source = self._socket.recvfrom_into(buffer)
            except OSError:  # an ICMP answer to something sent before, or the end
                continue
            if not size:
                continue
            if buffer[:size] == _HELLO:
                if self.spec.role is Role.SERVICE:
                    self._peer = source
                    self._socket.sendto(_HELLO, source)
                self._heard.set()
            else:
                self.deliver(buffer[0], buffer[1:size])
