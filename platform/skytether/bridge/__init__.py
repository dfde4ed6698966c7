"""UDP endpoints of a session: sockets, the clock, the thread around `skytether.wire`, and the seam to graphs.

Here is what touches the system. Rules of the protocol belong into `skytether.wire`; graphs of ROS into
`skytether.ros`.
"""

from .calls import CallError, CallFailedError, CallTimeoutError
from .endpoint import Bridge, BridgeError
from .interfaces import LocalPath
from .local import GraphPort, LocalGraph
from .port import Port, Publisher
from .relay import Relay, RelayStats
from .relay_table import RelayLimits
from .spec import SessionSpec, topic_from_api, topics_from_api

__all__ = [
    "Bridge",
    "BridgeError",
    "CallError",
    "CallFailedError",
    "CallTimeoutError",
    "GraphPort",
    "LocalGraph",
    "LocalPath",
    "Port",
    "Publisher",
    "Relay",
    "RelayLimits",
    "RelayStats",
    "SessionSpec",
    "topic_from_api",
    "topics_from_api",
]
