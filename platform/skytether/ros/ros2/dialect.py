"""How endpoints are written as key expressions: by ``rmw_zenoh_cpp``, and by ``zenoh-bridge-ros2dds``.

Sources: ros2/rmw_zenoh docs/design.md and rmw_zenoh_cpp/src/detail/liveliness_utils.cpp;
eclipse-zenoh/zenoh-plugin-ros2dds src/liveliness_mgt.rs and README.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Protocol

from . import qos as quality
from .names import dds_type, ros_type
from .qos import SERVICE, Qos

NO_HASH = "TypeHashNotSupported"
"""What ``rmw_zenoh_cpp`` of ROS 2 Humble writes, where types have no hash."""
ANY_HASH = "*"
_ADMIN = "@ros2_lv"


class Kind(StrEnum):
    """What an endpoint is, in the letters of both kinds of token."""

    PUBLISHER = "MP"
    SUBSCRIPTION = "MS"
    SERVER = "SS"
    CLIENT = "SC"

    @property
    def answers(self) -> Kind:
        """The kind on the other side."""
        return _OTHER[self]


_OTHER = {
    Kind.PUBLISHER: Kind.SUBSCRIPTION,
    Kind.SUBSCRIPTION: Kind.PUBLISHER,
    Kind.SERVER: Kind.CLIENT,
    Kind.CLIENT: Kind.SERVER,
}


@dataclass(frozen=True, slots=True)
class Endpoint:
    """One publisher, subscription, service server or client of a graph.

    Attributes:
        kind: Which of them.
        name: Fully qualified, ``/chatter``.
        type: ``std_msgs/msg/String``; of a service ``std_srvs/srv/Trigger``.
        type_hash: ``RIHS01_...``; empty if not known.
        qos: Quality of service.
        node: Name of its node with namespace; empty where tokens do not tell.
        priority: Of ours: which messages go first where several wait.
        parts: Type hashes of a service's request and response, where these are known and not the service's own (DDS).
    """

    kind: Kind
    name: str
    type: str
    type_hash: str = ""
    qos: Qos = SERVICE
    node: str = ""
    priority: int = 0
    parts: tuple[str, str] = ("", "")


@dataclass(frozen=True, slots=True)
class NodeName:
    """The node that we are on a graph."""

    namespace: str = "/"
    name: str = "skytether"


class Dialect(Protocol):
    """One way of writing a ROS 2 graph in Zenoh. Key expressions of peers may be anything and raise nothing."""

    @property
    def attaches(self) -> bool:
        """Whether messages carry an attachment."""
        ...

    @property
    def watched(self) -> str:
        """Key expression of every endpoint's liveliness token."""
        ...

    def key(self, endpoint: Endpoint) -> str:
        """Key expression of an endpoint's messages, requests or responses."""
        ...

    def node_token(self, session: str, node: NodeName) -> str:
        """Our node's liveliness token.

        Args:
            session: Id of the Zenoh session, in hexadecimal digits.
            node: Who we are.
        """
        ...

    def token(self, session: str, number: int, node: NodeName, endpoint: Endpoint) -> str:
        """Liveliness token of one of our endpoints; ``number`` counts them from 1."""
        ...

    def parse(self, token: str) -> tuple[str, Endpoint] | None:
        """Session and endpoint of a token; None for a node's and for what is no token."""
        ...


@dataclass(frozen=True, slots=True)
class RmwZenoh:
    """Nodes that run ``rmw_zenoh_cpp``.

    Attributes:
        domain: ``ROS_DOMAIN_ID``.
        hashes: False for ROS 2 Humble, where types have no hash.
    """

    domain: int = 0
    hashes: bool = True
    attaches = True

    @property
    def watched(self) -> str:
        return f"{_ADMIN}/{self.domain}/**"

    def key(self, endpoint: Endpoint) -> str:
        type_hash = (endpoint.type_hash or ANY_HASH) if self.hashes else NO_HASH
        return f"{self.domain}/{endpoint.name.strip('/')}/{dds_type(endpoint.type)}/{type_hash}"

    def node_token(self, session: str, node: NodeName) -> str:
        return f"{_ADMIN}/{self.domain}/{session}/0/0/NN/{self._place(node)}"

    def token(self, session: str, number: int, node: NodeName, endpoint: Endpoint) -> str:
        type_hash = (endpoint.type_hash or NO_HASH) if self.hashes else NO_HASH
        what = f"{_mangle(endpoint.name)}/{dds_type(endpoint.type)}/{type_hash}/{quality.push_rmw(endpoint.qos)}"
        return f"{_ADMIN}/{self.domain}/{session}/0/{number}/{endpoint.kind}/{self._place(node)}/{what}"

    def parse(self, token: str) -> tuple[str, Endpoint] | None:
        parts = token.split("/")
        if len(parts) != 13 or parts[0] != _ADMIN or parts[1] != str(self.domain) or not _is_kind(parts[5]):
            return None
        namespace, node, name = (part.replace("%", "/") for part in parts[7:10])
        type_name, qos = ros_type(parts[10]), quality.pull_rmw(parts[12])
        if type_name is None or qos is None:
            return None
        # A learned hash becomes part of our keys, so nothing else will do.
        type_hash = parts[11] if parts[11] != NO_HASH and parts[11].isidentifier() and parts[11].isascii() else ""
        where = f"{namespace.rstrip('/')}/{node}"
        return parts[2], Endpoint(Kind(parts[5]), name, type_name, type_hash, qos, where)

    @staticmethod
    def _place(node: NodeName) -> str:
        """Enclave (none), namespace and name."""
        return f"%/{_mangle(node.namespace)}/{node.name}"


@dataclass(frozen=True, slots=True)
class Ros2Dds:
    """Nodes on DDS behind ``zenoh-bridge-ros2dds``: keys are the names, types and qualities are in tokens only.

    Attributes:
        namespace: What the bridge's own ``namespace`` setting puts before every name.
    """

    namespace: str = "/"
    attaches = False

    @property
    def watched(self) -> str:
        return f"@/*/{_ADMIN}/**"

    def key(self, endpoint: Endpoint) -> str:
        return f"{self.namespace.rstrip('/')}{endpoint.name}".strip("/")

    def node_token(self, session: str, node: NodeName) -> str:
        del node  # a bridge has no name
        return f"@/{session}/{_ADMIN}"

    def token(self, session: str, number: int, node: NodeName, endpoint: Endpoint) -> str:
        del number, node
        token = f"@/{session}/{_ADMIN}/{endpoint.kind}/{self.key(endpoint).replace('/', '§')}"
        token += f"/{endpoint.type.replace('/', '§')}"
        if endpoint.kind in (Kind.SERVER, Kind.CLIENT):
            return token
        return f"{token}/{quality.push_dds(endpoint.qos, endpoint.type_hash)}"

    def parse(self, token: str) -> tuple[str, Endpoint] | None:
        parts = token.split("/")
        if len(parts) < 6 or parts[0] != "@" or parts[2] != _ADMIN or not _is_kind(parts[3]):
            return None
        kind = Kind(parts[3])
        key, type_name = parts[4].replace("§", "/"), parts[5].replace("§", "/")
        prefix = self.namespace.strip("/")
        name = "/" + (key.removeprefix(prefix + "/") if prefix else key)
        if kind in (Kind.SERVER, Kind.CLIENT):
            return (parts[1], Endpoint(kind, name, type_name)) if len(parts) == 6 else None
        pulled = quality.pull_dds(parts[6]) if len(parts) == 7 else None
        if pulled is None:
            return None
        return parts[1], Endpoint(kind, name, type_name, pulled[1], pulled[0])


def _mangle(name: str) -> str:
    return name.replace("/", "%")


def _is_kind(text: str) -> bool:
    return text in {kind.value for kind in Kind}
