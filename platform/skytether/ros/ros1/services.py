"""ROS services as bytes: the side that answers, inside the node, and calls of others' services (blocking)."""

from __future__ import annotations

import asyncio
import logging
import socket
import struct
from collections.abc import Callable
from dataclasses import dataclass

from .tcpros import (
    ANY,
    MAX_HEADER,
    MAX_MESSAGE,
    HeaderError,
    pack_answer,
    pack_frame,
    pack_header,
    read_frame,
    sums_differ,
    unpack_header,
)

_log = logging.getLogger(__name__)

Handler = Callable[[bytes], bytes]
"""Serialised request in, serialised answer out; raises to have its text told to the caller. In threads of its own."""
_PROBE_S = 2.0
_COMPLAINTS = 64


class CallRefusedError(Exception):
    """The service did not answer; the text says why."""


@dataclass(frozen=True, slots=True)
class ServiceType:
    """What a service says it is.

    Attributes:
        type: As ROS 1 has it, ``std_srvs/SetBool``.
        md5: Of request and response.
    """

    type: str
    md5: str


class ServiceServer:
    """A service of this node. Its type may become known later; until then each caller's is taken."""

    def __init__(self, node: str, name: str, kind: ServiceType, handler: Handler) -> None:
        self.name = name
        self.kind = kind
        self._node = node
        self._handler = handler
        self._refused: set[tuple[str, str]] = set()

    async def serve(
        self,
        header: dict[str, str],
        reader: asyncio.StreamReader,
        writer: asyncio.StreamWriter,
        work: Callable[[Callable[[], bytes]], asyncio.Future[bytes]],
    ) -> None:
        """In the node's thread: a caller has connected. Returns when it is served."""
        caller, md5 = header.get("callerid", "somebody"), header.get("md5sum", ANY)
        if sums_differ(self.kind.md5, md5):
            refusal = (
                f"service {self.name}: {caller} asks with MD5 {md5}, but {self.kind.type} has MD5 {self.kind.md5}; "
                "both sides need the same version of the service"
            )
            if (caller, md5) not in self._refused and len(self._refused) < _COMPLAINTS:
                self._refused.add((caller, md5))
                _log.error("%s", refusal)
            writer.write(pack_header({"error": refusal}))
            await writer.drain()
            return
        writer.write(pack_header(self._header(md5)))
        if header.get("probe") == "1":
            await writer.drain()
            return
        while True:
            request = await read_frame(reader)
            if isinstance(request, int):
                answer: bytes | str = f"a request of {request} bytes is too large for a session"
            else:
                answer = await self._answer(request, work)
            writer.write(pack_answer(answer))
            await writer.drain()
            if header.get("persistent") != "1":
                return

    async def _answer(
        self, request: bytes, work: Callable[[Callable[[], bytes]], asyncio.Future[bytes]]
    ) -> bytes | str:
        try:
            return await work(lambda: self._handler(request))
        except Exception as error:
            return str(error) or type(error).__name__

    def _header(self, md5: str) -> dict[str, str]:
        kind = self.kind.type
        return {
            "callerid": self._node,
            "service": self.name,
            "type": kind,
            "md5sum": self.kind.md5 or md5,
            "request_type": f"{kind}Request",
            "response_type": f"{kind}Response",
        }


def probe(address: tuple[str, int], node: str, name: str) -> ServiceType:
    """Ask a service for its type.

    Raises:
        CallRefusedError: It does not say.
    """
    try:
        with socket.create_connection(address, _PROBE_S) as sock:
            sock.sendall(pack_header({"callerid": node, "service": name, "md5sum": ANY, "probe": "1"}))
            header = _header_of(sock)
    except (OSError, EOFError, HeaderError) as error:
        raise CallRefusedError(f"service {name} does not say what it is: {error}") from error
    if "md5sum" not in header:
        raise CallRefusedError(f"service {name} does not say what it is: {header.get('error', 'no MD5 sum')}")
    return ServiceType(header.get("type", ""), header["md5sum"])


def call(address: tuple[str, int], node: str, name: str, md5: str, request: bytes, timeout: float) -> bytes:
    """Call a service, and wait.

    Args:
        address: Of the service.
        node: Own name.
        name: Of the service.
        md5: Of its type; empty: whatever it is.
        request: Serialised.
        timeout: Seconds that each step may take.

    Raises:
        CallRefusedError: It failed, and said why; or nothing came.
    """
    fields = {"callerid": node, "service": name, "md5sum": md5 or ANY, "persistent": "0"}
    try:
        with socket.create_connection(address, timeout) as sock:
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            sock.sendall(pack_header(fields))
            header = _header_of(sock)
            if "error" in header:
                raise CallRefusedError(f"service {name} refuses: {header['error']}")
            sock.sendall(pack_frame(request))  # not before: rospy loses what comes right behind a header
            succeeded = _exactly(sock, 1)
            answer = _exactly(sock, _length(sock, MAX_MESSAGE))
    except (OSError, EOFError, HeaderError) as error:
        raise CallRefusedError(f"service {name} did not answer: {error or 'the connection ended'}") from error
    if succeeded != b"\1":
        raise CallRefusedError(f"service {name} failed: {answer.decode(errors='replace')}")
    return answer


def _header_of(sock: socket.socket) -> dict[str, str]:
    return unpack_header(_exactly(sock, _length(sock, MAX_HEADER)))


def _length(sock: socket.socket, limit: int) -> int:
    length: int = struct.unpack("<I", _exactly(sock, 4))[0]
    if length > limit:
        raise HeaderError(f"{length} bytes; {limit} are taken")
    return length


def _exactly(sock: socket.socket, count: int) -> bytes:
    data = bytearray()
    while len(data) < count:
        chunk = sock.recv(min(count - len(data), 2**16))
        if not chunk:
            raise EOFError("the connection ended")
        data += chunk
    return bytes(data)
