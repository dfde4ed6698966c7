"""How an endpoint of ours stands in a ROS 2 graph now."""

from __future__ import annotations

from skytether.ros.followed import Followed

from .dialect import Endpoint, Kind
from .qos import describe
from .seam import GraphNode, Handle


def followed(node: GraphNode, name: str, endpoint: Endpoint, handle: Handle | None, refused: str = "") -> Followed:
    """Look at who is on the other side of a publisher or a subscription.

    Args:
        node: Ours.
        name: Of the topic in the bridge.
        endpoint: What we are for it, or would be.
        handle: The same, once it is in the graph.
        refused: Why nothing is carried, if not the graph says so.
    """
    takes = endpoint.kind is Kind.SUBSCRIPTION
    others = node.endpoints(endpoint.name, endpoint.kind.answers)
    return Followed(
        name,
        endpoint.name,
        endpoint.type,
        "from" if takes else "to",
        nodes=tuple(sorted({other.node for other in others if other.node})),
        there=bool(others),
        quality=" / ".join(sorted({describe(other.qos) for other in others})) if takes else describe(endpoint.qos),
        refused=refused or (handle.refused if handle is not None else ""),
        passed=handle.passed if handle is not None else 0,
        dropped=handle.dropped if handle is not None else 0,
    )
