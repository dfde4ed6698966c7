"""What lifecycle nodes of a ROS 2 graph say of themselves: only an active one publishes."""

from __future__ import annotations

import struct
import time

from skytether.bridge.calls import CallError

from .dialect import Endpoint, Kind
from .seam import Client, GraphNode

SERVICE = "lifecycle_msgs/srv/GetState"
ACTIVE = "active"
MOST = 64
"""Nodes that are asked."""
_ENDING = "/get_state"
_REQUEST = b"\0\1\0\0\0"
_RETRY_S = 0.1
_ONE_CALL_S = 1.0


def states(node: GraphNode, timeout: float) -> dict[str, str]:
    """Label of the state of each lifecycle node (``unconfigured``, ``inactive``, ``active``, ``finalized``), by name.

    Args:
        node: Ours; it knows the graph.
        timeout: Seconds for all together; a node that does not answer in time is left out.
    """
    services = {e.name for e in node.endpoints(kind=Kind.SERVER) if e.type == SERVICE and e.name.endswith(_ENDING)}
    clients = {name: node.client(Endpoint(Kind.CLIENT, name, SERVICE)) for name in sorted(services)[:MOST]}
    deadline = time.monotonic() + timeout
    found: dict[str, str] = {}
    try:
        for name, client in clients.items():
            label = _ask(client, deadline)
            if label:
                found[name.removesuffix(_ENDING)] = label
    finally:
        for client in clients.values():
            client.close()
    return found


def _ask(client: Client, deadline: float) -> str:
    while (left := deadline - time.monotonic()) > 0:
        try:
            return label_of(client.call(_REQUEST, min(left, _ONE_CALL_S)))
        except CallError:  # it takes a moment until a client has found its service
            time.sleep(min(left, _RETRY_S))
    return ""


def label_of(response: bytes) -> str:
    """The label in a response of `SERVICE` in CDR; empty if it is none."""
    order = "<" if response[1:2] == b"\1" else ">"
    try:
        (size,) = struct.unpack_from(f"{order}I", response, 8)  # after encapsulation and the state's number
    except struct.error:
        return ""
    return response[12 : 12 + size].rstrip(b"\0").decode(errors="replace")
