"""XML-RPC of ROS 1: what a node asks of the master and of other nodes (wiki.ros.org/ROS/Master_API, Slave_API)."""

from __future__ import annotations

import http.client
import socket
import time
import xmlrpc.client
from typing import Any
from urllib.parse import urlsplit

TIMEOUT_S = 3.0
"""Of a request, to the end of its answer; a master answers within milliseconds."""
LARGEST = 4 << 20
"""Bytes of an answer: the state of a graph of thousands of topics is smaller."""
_SAID = 500
"""Characters of what somebody else says that are told."""


class MasterError(Exception):
    """A master or node does not answer, or not as it should; one sentence."""


class RefusedError(MasterError):
    """It answers, and says no."""


class NonsenseError(MasterError):
    """It answers, and not as ROS does."""


class _Bounded(socket.socket):
    """All that comes is there in time, and not too much: a timeout of `socket` is for each read alone."""

    end = 0.0
    """By when [s]."""
    room = LARGEST
    """Bytes that may still come."""

    def recv_into(self, buffer: Any, nbytes: int = 0, flags: int = 0) -> int:
        left = self.end - time.monotonic()
        if left <= 0:
            raise TimeoutError("the answer does not end")
        self.settimeout(left)
        count = super().recv_into(buffer, nbytes, flags)
        self.room -= count
        if self.room < 0:
            raise OSError(f"the answer has more than {LARGEST} bytes")
        return count


class _Connection(http.client.HTTPConnection):
    def connect(self) -> None:
        end = time.monotonic() + (self.timeout or TIMEOUT_S)
        super().connect()
        bounded = _Bounded(fileno=self.sock.detach())
        bounded.settimeout(self.timeout)
        bounded.end = end
        self.sock = bounded


class _Transport(xmlrpc.client.Transport):
    accept_gzip_encoding = False

    def __init__(self, timeout: float) -> None:
        super().__init__()
        self._timeout = timeout

    def make_connection(self, host: Any) -> http.client.HTTPConnection:
        address, self._extra_headers, _ = self.get_host_info(host)
        made = _Connection(address, timeout=self._timeout)
        self._connection = host, made  # for its own `close`
        return made

    def parse_response(self, response: Any) -> Any:
        if response.getheader("content-encoding", "identity") != "identity":
            raise ValueError("the answer is packed, and nobody knows how large it is")
        return super().parse_response(response)


def call(uri: str, method: str, *arguments: Any, timeout: float = TIMEOUT_S) -> Any:
    """One request, by a connection of its own: from any thread.

    Args:
        uri: Of the master or the node.
        method: Name of the method.
        *arguments: Its arguments.
        timeout: Seconds.

    Raises:
        RefusedError: The answer is no.
        NonsenseError: The answer is none of ROS.
        MasterError: There is no answer, it does not end in time or is too large.
    """
    try:
        with xmlrpc.client.ServerProxy(uri, transport=_Transport(timeout), allow_none=True) as proxy:
            answer = getattr(proxy, method)(*arguments)
        code, status, value = answer
    except (OSError, http.client.HTTPException) as error:
        raise MasterError(f"nobody answers at {uri}: {error}") from error
    except Exception as error:  # bytes of somebody else, and the library raises whatever its parts do
        raise NonsenseError(f"{uri} does not speak as ROS does ({method}): {str(error)[:_SAID]}") from error
    if code != 1:
        raise RefusedError(f"{uri}: {str(status)[:_SAID]}")
    return value


def _is_list(found: Any, of: int | None = None) -> bool:
    return isinstance(found, list) and (of is None or len(found) == of)


class Master:
    """The master, as one node calls it. Methods block for `TIMEOUT_S` at most, and may be called from any thread.

    All raise MasterError; RefusedError where the master answered no.
    """

    def __init__(self, uri: str, node: str) -> None:
        self.uri = uri
        self._node = node

    def _call(self, method: str, *arguments: Any) -> Any:
        return call(self.uri, method, self._node, *arguments)

    def _list(self, method: str, *arguments: Any, of: int = 0) -> list[Any]:
        """An answer that is a list; of lists that are so long, if that is given."""
        found = self._call(method, *arguments)
        if _is_list(found) and (not of or all(_is_list(one, of) for one in found)):
            return found  # type: ignore[no-any-return]
        raise NonsenseError(f"{self.uri} does not speak as ROS does ({method}): it answers no such list")

    def knows(self, node: str) -> str:
        """Address of a node; empty if the master knows no such node."""
        try:
            return str(self._call("lookupNode", node))
        except RefusedError:
            return ""

    def register_subscriber(self, topic: str, kind: str, uri: str) -> list[str]:
        """Take part; gives the publishers' addresses."""
        return [str(found) for found in self._list("registerSubscriber", topic, kind, uri)]

    def register_publisher(self, topic: str, kind: str, uri: str) -> None:
        """Offer a topic."""
        self._call("registerPublisher", topic, kind, uri)

    def register_service(self, service: str, rosrpc: str, uri: str) -> None:
        """Offer a service."""
        self._call("registerService", service, rosrpc, uri)

    def unregister_subscriber(self, topic: str, uri: str) -> None:
        """Take part no more."""
        self._call("unregisterSubscriber", topic, uri)

    def unregister_publisher(self, topic: str, uri: str) -> None:
        """Offer it no more."""
        self._call("unregisterPublisher", topic, uri)

    def unregister_service(self, service: str, rosrpc: str) -> None:
        """Offer it no more."""
        self._call("unregisterService", service, rosrpc)

    def lookup_service(self, service: str) -> tuple[str, int] | None:
        """Host and port of a service; None if nobody offers it."""
        try:
            address = urlsplit(str(self._call("lookupService", service)))
            if address.hostname is None or address.port is None:
                raise MasterError(f"{self.uri}: service {service} has no address")
        except RefusedError:
            return None
        except ValueError as error:
            raise MasterError(f"{self.uri}: service {service} has no address: {error}") from error
        return address.hostname, address.port

    def topic_types(self) -> dict[str, str]:
        """Types by topic, of all that was ever offered or taken."""
        return {str(name): str(kind) for name, kind in self._list("getTopicTypes", of=2)}

    def published(self) -> dict[str, str]:
        """Types by topic, of all that somebody offers now."""
        return {str(name): str(kind) for name, kind in self._list("getPublishedTopics", "", of=2)}

    def publishers(self, topic: str) -> list[str]:
        """Names of the nodes that offer a topic now."""
        return self._nodes_of(topic, 0)

    def subscribers(self, topic: str) -> list[str]:
        """Names of the nodes that take a topic now, as far as they have not taken that back."""
        return self._nodes_of(topic, 1)

    def _nodes_of(self, topic: str, kind: int) -> list[str]:
        rows: Any = next(iter(self._list("getSystemState")[kind:]), None)
        if not _is_list(rows) or not all(_is_list(row, 2) and _is_list(row[1]) for row in rows):
            raise NonsenseError(f"{self.uri} does not speak as ROS does (getSystemState): it answers no such list")
        return [str(node) for name, nodes in rows if name == topic for node in nodes]

    def get_param(self, name: str) -> Any:
        """A parameter, or a namespace of them as a mapping.

        Raises:
            RefusedError: It is not set.
        """
        return self._call("getParam", name)

    def set_param(self, name: str, value: Any) -> None:
        """Set a parameter, or a namespace of them from a mapping."""
        self._call("setParam", name, value)
