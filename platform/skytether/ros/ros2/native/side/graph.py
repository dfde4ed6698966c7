"""What rclpy knows of the graph, as lists that JSON can hold."""

from __future__ import annotations

from typing import Any

from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, HistoryPolicy, LivelinessPolicy, QoSProfile, ReliabilityPolicy

PUBLISHER, SUBSCRIPTION, SERVER, CLIENT = "MP", "MS", "SS", "SC"
"""Letters of the kinds of endpoints, as the platform has them."""
_KEPT = 10_000
"""What a history that keeps all is told as."""
_ENDLESS = 1e9
"""Seconds; what is longer is no deadline."""
_OF_SERVICES = (True, False, 10, None, False, None)
"""Quality, of each."""


def profile(reliable: bool, transient_local: bool, depth: int, lifespan_s: float | None = None) -> QoSProfile:
    """A quality of service of ours; with ``lifespan_s``, nothing is sent that is older [s]."""
    more = {} if lifespan_s is None else {"lifespan": Duration(seconds=lifespan_s)}
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if transient_local else DurabilityPolicy.VOLATILE,
        **more,
    )


def list_endpoints(node: Any, names: list[str] | None) -> list[list[Any]]:
    """Endpoints of other nodes, sorted.

    Each is a list: its id, which is another after it was away; kind; name; type; type hash or nothing; node; reliable;
    transient local; depth, 0 if it is not told; deadline in seconds or nothing; liveliness by hand; its lease in
    seconds or nothing; of a service the hashes of request and response.

    Args:
        node: Ours.
        names: Of topics and services, as they are in the graph; None: all.
    """
    ours = (node.get_name(), node.get_namespace())
    if names is None:
        names = [name for name, _ in node.get_topic_names_and_types(no_demangle=False)]
    found = []
    for name in names:
        for kind, infos in (
            (PUBLISHER, node.get_publishers_info_by_topic(name)),
            (SUBSCRIPTION, node.get_subscriptions_info_by_topic(name)),
        ):
            found += [_endpoint(kind, name, i) for i in infos if (i.node_name, i.node_namespace) != ours]
    return sorted(found, key=lambda endpoint: str(endpoint[0]))


def list_services(node: Any, ours: set[str], asked: set[str]) -> list[list[Any]]:
    """Services that other nodes offer, and clients of ours, as `list_endpoints` does endpoints.

    Their nodes and the hashes of their types are there where the middleware tells them.

    Args:
        node: Ours.
        ours: Names of the services that we offer.
        asked: Of those that we are a client of.
    """
    found = []
    own = (node.get_name(), node.get_namespace())
    for name, kinds in node.get_service_names_and_types():
        servers = node.get_subscriptions_info_by_topic(f"rq{name}Request", no_mangle=True)  # of any DDS
        others = [s for s in servers if (s.node_name, s.node_namespace) != own]
        if (servers and not others) or (not servers and name in ours):
            continue
        replies = node.get_publishers_info_by_topic(f"rr{name}Reply", no_mangle=True) if name in asked else []
        responses = {(r.node_name, r.node_namespace): _hash(r) for r in replies}
        seen = [(_gid(s), _node(s), _hash(s), responses.get((s.node_name, s.node_namespace), "")) for s in others] or [
            ("", "", "", "")
        ]
        found += [
            [f"{gid}{name} {kind}", SERVER, name, kind, "", where, *_OF_SERVICES, request, response]
            for kind in kinds
            for gid, where, request, response in seen
        ]
    for name in ours:
        for info in node.get_publishers_info_by_topic(f"rq{name}Request", no_mangle=True):
            kind = info.topic_type.replace("::dds_::", "/").replace("::", "/").removesuffix("_Request_")
            if (info.node_name, info.node_namespace) != own:
                found.append([_gid(info), CLIENT, name, kind, "", _node(info), *_OF_SERVICES, _hash(info), ""])
    return sorted(found, key=lambda endpoint: str(endpoint[0]))


def listeners(node: Any, topic: str) -> dict[str, str]:
    """Who subscribes a topic: by subscription its node, empty where that is not told, or not yet."""
    return {_gid(info): _node(info) for info in node.get_subscriptions_info_by_topic(topic)}


def others(node: Any) -> tuple[int, int]:
    """How many other nodes there are, and how many of them have our name."""
    nodes = node.get_node_names_and_namespaces()
    same = nodes.count((node.get_name(), node.get_namespace()))
    return len(nodes) - same, max(0, same - 1)


def _endpoint(kind: str, name: str, info: Any) -> list[Any]:
    qos = info.qos_profile
    deadline, lease = (
        seconds if 0 < seconds < _ENDLESS else None
        for seconds in map(_seconds, (qos.deadline, qos.liveliness_lease_duration))
    )
    return [
        _gid(info),
        kind,
        name,
        info.topic_type,
        _hash(info),
        _node(info),
        qos.reliability == ReliabilityPolicy.RELIABLE,
        qos.durability == DurabilityPolicy.TRANSIENT_LOCAL,
        _KEPT if qos.history == HistoryPolicy.KEEP_ALL else int(qos.depth),
        deadline,
        qos.liveliness == LivelinessPolicy.MANUAL_BY_TOPIC,
        lease,
        "",
        "",
    ]


def _gid(info: Any) -> str:
    return bytes(info.endpoint_gid).hex()


def _node(info: Any) -> str:
    """Full name of its node; empty where that is not told, or not yet."""
    if "UNKNOWN" in info.node_name:
        return ""
    return f"{info.node_namespace.rstrip('/')}/{info.node_name}"


def _hash(info: Any) -> str:
    """Of the type; ROS 2 Humble has none."""
    text = str(getattr(info, "topic_type_hash", ""))
    return text if text.startswith("RIHS") else ""


def _seconds(duration: Duration) -> float:
    return float(duration.nanoseconds) / 1e9
