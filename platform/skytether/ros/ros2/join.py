"""How a ROS 2 graph is joined: the node that a configuration asks for."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal, Protocol

from skytether.guard.board import Place

from .dialect import NodeName, RmwZenoh, Ros2Dds
from .seam import GraphNode

Way = Literal["rclpy", "rmw_zenoh", "ros2dds"]
"""As a node of the ROS 2 that is installed; or as a client of a Zenoh router: `RmwZenoh`, `Ros2Dds`."""


class Joining(Protocol):
    """What a configuration says; each key is explained in `skytether.ros.ros2.config.Ros2Graph`."""

    @property
    def dialect(self) -> Way: ...
    @property
    def python(self) -> str | None: ...
    @property
    def ros_args(self) -> Sequence[str]: ...
    @property
    def use_sim_time(self) -> bool: ...
    @property
    def domain(self) -> int | None: ...
    @property
    def router(self) -> str | None: ...
    @property
    def type_hashes(self) -> bool: ...
    @property
    def bridge_namespace(self) -> str: ...


def check_keys(how: Joining, zenoh_config: Path | None) -> None:
    """Refuse keys of another way.

    Raises:
        ValueError: The text names the key.
    """
    zenoh = {"router": how.router is not None, "zenoh_config": zenoh_config is not None}
    zenoh |= {"bridge_namespace": how.bridge_namespace != "/", "type_hashes": not how.type_hashes}
    ours = {"python": how.python is not None, "ros_args": bool(how.ros_args)}
    if how.dialect == "rclpy":
        for key in (key for key, given in zenoh.items() if given):
            raise ValueError(f"{key}: is for a graph with a Zenoh router: add dialect: rmw_zenoh (or ros2dds)")
    else:
        for key in (key for key, given in ours.items() if given):
            raise ValueError(f"{key}: is for dialect: rclpy, and this one is {how.dialect}")


def make_node(how: Joining, name: NodeName, zenoh_config: Path | None, place: Place | None = None) -> GraphNode:
    """The node, not yet started.

    Args:
        how: What the configuration says.
        name: Who we are.
        zenoh_config: Zenoh's own configuration.
        place: Where it is said that a velocity is about to be published, if another program does that.

    Raises:
        Ros2Error: It cannot be what it was told to be.
        ModuleNotFoundError: Of ``zenoh``: the extra ``ros2`` is not installed.
    """
    if how.dialect == "rclpy":
        from .native.node import RclpyNode

        arguments = [*how.ros_args, *(["-p", "use_sim_time:=true"] if how.use_sim_time else [])]
        return RclpyNode(name, python=how.python, domain=how.domain, arguments=arguments, place=place)
    from .node import Ros2Node  # Zenoh is an extra

    dialect = (
        RmwZenoh(how.domain or 0, how.type_hashes) if how.dialect == "rmw_zenoh" else Ros2Dds(how.bridge_namespace)
    )
    return Ros2Node(dialect, router=how.router, config_file=zenoh_config, name=name, sim_time=how.use_sim_time)
