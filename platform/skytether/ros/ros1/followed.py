"""How a topic that we take stands in a ROS 1 graph now."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from skytether.ros.followed import Followed


def taken(
    name: str, graph: str, kind: str, seen: Mapping[str, tuple[Mapping[str, Any], Mapping[str, str]]]
) -> Followed:
    """How a topic that we take stands in the graph.

    Args:
        name: In the bridge.
        graph: In the graph.
        kind: Its type.
        seen: What `Node.publishers_by_topic` says.
    """
    connected, refused = seen.get(graph, ({}, {}))
    nodes = tuple(sorted(info.caller for info in connected.values()))
    quality = "latched" if any(info.latched for info in connected.values()) else ""
    why = next(iter(refused.values()), "") if not connected else ""
    return Followed(name, graph, kind, "from", nodes, bool(nodes), quality, refused=why)
