"""ROS 2 across the link as users run it through a VPN: unicast discovery, the other end named, no bridge between.

Each end is a node of its own under ROS 2's Python (`skytether.lab.bench.ros2_node`), as ROS 2's is another than ours,
in general.
"""

from __future__ import annotations

from hashlib import sha256
from pathlib import Path
from typing import ClassVar

from skytether.lab.bench.ros2_node import Node, check_python
from skytether.lab.bench.ros2_program.schedule import Order
from skytether.lab.bench.rows import Notes
from skytether.lab.tun import ROBOT
from skytether.wire.topic import Role

from .base import EndSpec, Program, TransportError
from .ros2_settings import HEARTBEAT_MS, MTU, cyclone_settings, fastdds_profile

_DEPTH = 10
"""ROS 2's default; a history that is shorter cannot repeat what is lost on a long way."""
_DOMAINS = 100


class Ros2Program(Program):
    """Common to all. `LIBRARY` and `RELIABLE` and `TUNED` make the difference."""

    TUN = True
    LIBRARY: ClassVar[str] = "rclpy"
    RELIABLE: ClassVar[bool]
    TUNED: ClassVar[bool] = False

    def __init__(self, spec: EndSpec) -> None:
        super().__init__(spec)
        # Whoever else measures on this machine's loopback has other topics.
        self._prefix = "/bench_" + sha256(spec.folder.encode()).hexdigest()[:8]
        self._node: Node | None = None

    @classmethod
    def check(cls) -> None:
        check_python(cls.LIBRARY)

    def start(self) -> None:
        self.check()
        wanted = {
            "kind": self.LIBRARY,
            "domain": self.spec.address[1] % _DOMAINS,
            "reliable": self.RELIABLE,
            "flows": [
                {"size": f.size, "hz": f.hz, "depth": max(f.depth, _DEPTH), "topic": self._topic(i)}
                for i, f in enumerate(self.spec.flows)
            ],
            "sends": self.spec.sends,
            "receives": self.spec.receives,
        }
        self._node = node = Node(wanted, self.spec.folder, str(self.spec.role), self._environment())
        if self.TUNED and "XMLPARSER" in node.log.read_text():
            raise TransportError(f"Fast DDS does not understand the profile, which is for its version 3: {node.said()}")

    def connected(self) -> bool:
        return self._node is not None and self._node.connected()

    def measure(self, order: Order) -> Notes:
        if self._node is None:
            raise TransportError("the end was not started")
        return self._node.measure(order, self.spec.sends)

    def stop(self) -> None:
        if self._node is not None:
            self._node.stop()

    def _topic(self, index: int) -> str:
        return f"{self._prefix}/flow{index}"

    def _environment(self) -> dict[str, str]:
        between = not self.spec.address[0].startswith("127.")
        other = (self.spec.address[0] if self.spec.role is Role.ROBOT else ROBOT) if between else self.spec.address[0]
        told = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET" if between else "LOCALHOST"}
        if between:
            told["ROS_STATIC_PEERS"] = other
            # Both namespaces are on one machine, so messages would pass by the link through shared memory.
            told["FASTDDS_BUILTIN_TRANSPORTS"] = "UDPv4"
        if self.LIBRARY == "cyclonedds":
            told["CYCLONEDDS_URI"] = cyclone_settings(other)
        elif self.TUNED:
            profile = Path(self.spec.folder) / f"{self.spec.role}.xml"
            profile.write_text(fastdds_profile((self._topic(i), f.rank) for i, f in enumerate(self.spec.flows)))
            told |= {"FASTDDS_DEFAULT_PROFILES_FILE": str(profile), "RMW_FASTRTPS_PUBLICATION_MODE": "AUTO"}
        return told


class BestEffort(Ros2Program):
    """Fast DDS as it comes."""

    ABOUT = "ROS 2 over Fast DDS across the link, default settings, best effort"
    RELIABLE = False


class Reliable(Ros2Program):
    """Fast DDS as it comes."""

    ABOUT = "ROS 2 over Fast DDS across the link, default settings, reliable, depth 10"
    RELIABLE = True


_TUNED = (
    f"ROS 2 over Fast DDS across the link, tuned: asynchronous publishing through a flow controller that knows the "
    f"topics' ranks, datagrams of at most {MTU} bytes, large socket buffers"
)


class TunedBestEffort(Ros2Program):
    """As Fast DDS's documentation says for lossy networks."""

    ABOUT = f"{_TUNED}; best effort"
    RELIABLE = False
    TUNED = True


class TunedReliable(Ros2Program):
    """As Fast DDS's documentation says for lossy networks."""

    ABOUT = f"{_TUNED}; reliable, depth 10, heartbeats each {HEARTBEAT_MS} ms"
    RELIABLE = True
    TUNED = True


class CycloneBestEffort(Ros2Program):
    """Cyclone DDS as it comes."""

    ABOUT = "Cyclone DDS across the link with ROS 2's messages, default settings, best effort"
    LIBRARY = "cyclonedds"
    RELIABLE = False


class CycloneReliable(Ros2Program):
    """Cyclone DDS as it comes."""

    ABOUT = "Cyclone DDS across the link with ROS 2's messages, default settings, reliable, depth 10"
    LIBRARY = "cyclonedds"
    RELIABLE = True
