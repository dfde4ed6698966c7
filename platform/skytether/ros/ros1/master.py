"""XML-RPC of ROS 1: what a node asks of the master and of other nodes (wiki.ros.org/ROS/Master_API, Slave_API)."""

from __future__ import annotations

import http.client
import xmlrpc.client
from typing import Any
from urllib.parse import urlsplit
from xml.parsers.expat import ExpatError

TIMEOUT_S = 3.0
"""Of a request; a master answers within milliseconds."""


class MasterError(Exception):
    """A master or node does not answer, or not as it should; one sentence."""


class RefusedError(MasterError):
    """It answers, and says no."""


class _Transport(xmlrpc.client.Transport):
    def __init__(self, timeout: float) -> None:
        super().__init__()
        self._timeout = timeout

    def make_connection(self, host: Any) -> http.client.HTTPConnection:
        connection: http.client.HTTPConnection = super().make_connection(host)
        connection.timeout = self._timeout
        return connection


def call(uri: str, method: str, *arguments: Any, timeout: float = TIMEOUT_S) -> Any:
    """One request, by a connection of its own: from any thread.

    Args:
        uri: Of the master or the node.
        method: Name of the method.
        *arguments: Its arguments.
        timeout: Seconds.

    Raises:
        RefusedError: The answer is no.
        MasterError: There is no answer, or it is none of ROS.
    """
    try:
        with xmlrpc.client.ServerProxy(uri, transport=_Transport(timeout), allow_none=True) as proxy:
            answer = getattr(proxy, method)(*arguments)
        code, status, value = answer
    except (OSError, http.client.HTTPException) as error:
        raise MasterError(f"nobody answers at {uri}: {error}") from error
    except (xmlrpc.client.Error, ExpatError, TypeError, ValueError, UnicodeError) as error:
        raise MasterError(f"{uri} does not speak as ROS does ({method}): {error}") from error
    if code != 1:
        raise RefusedError(f"{uri}: {status}")
    return value


class Master:
    """The master, as one node calls it. Methods block for `TIMEOUT_S` at most, and may be called from any thread.

    All raise MasterError; RefusedError where the master answered no.
    """

    def __init__(self, uri: str, node: str) -> None:
        self.uri = uri
        self._node = node

    def _call(self, method: str, *arguments: Any) -> Any:
        return call(self.uri, method, self._node, *arguments)

    def knows(self, node: str) -> str:
        """Address of a node; empty if the master knows no such node."""
        try:
            return str(self._call("lookupNode", node))
        except RefusedError:
            return ""

    def register_subscriber(self, topic: str, kind: str, uri: str) -> list[str]:
        """Take part; gives the publishers' addresses."""
        return [str(found) for found in self._call("registerSubscriber", topic, kind, uri)]

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
        return {str(name): str(kind) for name, kind in self._call("getTopicTypes")}

    def published(self) -> dict[str, str]:
        """Types by topic, of all that somebody offers now."""
        return {str(name): str(kind) for name, kind in self._call("getPublishedTopics", "")}

    def publishers(self, topic: str) -> list[str]:
        """Names of the nodes that offer a topic now."""
        offered, _, _ = self._call("getSystemState")
        return [str(node) for name, nodes in offered if name == topic for node in nodes]

    def get_param(self, name: str) -> Any:
        """A parameter, or a namespace of them as a mapping.

        Raises:
            RefusedError: It is not set.
        """
        return self._call("getParam", name)

    def set_param(self, name: str, value: Any) -> None:
        """Set a parameter, or a namespace of them from a mapping."""
        self._call("setParam", name, value)
