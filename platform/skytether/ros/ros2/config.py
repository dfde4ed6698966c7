"""How a configuration says where a ROS 2 graph is, and the node that comes of it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, field_validator, model_validator

from skytether.api.config_file import ConfigError
from skytether.api.manifest import Strict
from skytether.ros.names import check_name

from .dialect import NodeName
from .join import Way, check_keys, make_node
from .parameters import Parameters
from .seam import GraphNode, Ros2Error

_EXTRA = "a ROS 2 graph with a Zenoh router needs the extra 'ros2': pip install 'skytether[ros2]'"


class Ros2Link(Strict):
    """How a ROS 2 graph is joined: as one of the ROS 2 on this machine, or by its Zenoh router."""

    dialect: Way = "rclpy"
    """``rclpy``: as a node of the ROS 2 that is installed, with its RMW. Without ROS 2 on this machine, by a Zenoh
    router: of nodes that run rmw_zenoh_cpp (``rmw_zenoh``), or of nodes on DDS behind zenoh-bridge-ros2dds
    (``ros2dds``)."""
    python: str | None = None
    """That has rclpy; null: SKYTETHER_ROS2_PYTHON, or the first of python3 and the system's that has it. Of ``rclpy``,
    as what follows."""
    ros_args: tuple[str, ...] = ()
    """As they follow ``--ros-args`` at any node: ``["-r", "scan:=/front/scan", "--log-level", "debug"]``."""
    router: Annotated[str, Field(pattern=r"^[a-z]+/.+")] | None = None
    """``tcp/HOST:PORT`` or ``tls/HOST:PORT``; null: as ``zenoh_config`` says, or tcp/127.0.0.1:7447. Not of ``rclpy``,
    nor is what follows about Zenoh."""
    zenoh_config: Path | None = None
    """Configuration file of Zenoh's (JSON5), for certificates and the like; relative to this file's folder."""
    domain: Annotated[int, Field(ge=0, le=232)] | None = None
    """ROS_DOMAIN_ID; null: of ``rclpy`` as in the environment, of ``rmw_zenoh`` 0."""
    type_hashes: bool = True
    """False for ROS 2 Humble, whose types have no hash; of ``rmw_zenoh``."""
    bridge_namespace: str = "/"
    """The ``namespace`` that zenoh-bridge-ros2dds is configured with; of ``ros2dds``."""
    use_sim_time: bool = False
    """Stamp what we publish with the time of ``/clock``, as any node with that parameter."""
    node: Annotated[str, Field(pattern=r"^[A-Za-z_][A-Za-z0-9_]*$")] = "skytether"
    """Name of our node in the graph."""

    @field_validator("bridge_namespace")
    @classmethod
    def _a_namespace(cls, name: str) -> str:
        return check_name(name, 2)

    @model_validator(mode="after")
    def _keys_of_one_way(self) -> Self:
        check_keys(self, self.zenoh_config)
        return self


class Ros2Graph(Ros2Link):
    """A ROS 2 graph."""

    parameters: dict[str, dict[str, Any]] = {}
    """Values that nodes of the graph get whenever they show up, by the node's full name and the parameter's."""


class Ros2Velocity(Strict):
    """What the wheels of a ROS 2 graph take."""

    cmd_vel_type: Literal["geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped"] = "geometry_msgs/msg/Twist"
    """nav2 and ros2_control have stamped velocities from Jazzy on."""
    frame: str = "base_link"
    """Coordinate frame of stamped velocities."""


def need_extra() -> None:
    """See that the extra is installed.

    Raises:
        ConfigError: It is not.
    """
    try:
        import zenoh  # noqa: F401 - told apart from an ImportError of our own
    except ModuleNotFoundError as error:
        raise ConfigError(_EXTRA) from error


@contextmanager
def join_graph(settings: Ros2Graph, folder: Path, namespace: str = "/") -> Iterator[GraphNode]:
    """The node that a configuration asks for, for as long as the context lasts; it sets the parameters of others.

    Args:
        settings: Where and how.
        folder: That paths are relative to.
        namespace: Of the node in the graph.

    Raises:
        ConfigError: ROS 2 or the extra is not installed, Zenoh does not take a setting, or a value can be no parameter.
    """
    if settings.dialect != "rclpy":
        need_extra()
    file = None if settings.zenoh_config is None else folder / settings.zenoh_config
    name = NodeName(namespace, settings.node)
    try:
        node = make_node(settings, name, file)
        parameters = Parameters(node, settings.parameters)
    except (Ros2Error, ValueError) as error:
        raise ConfigError(f"ros2: {error}") from error
    node.start()
    try:
        with parameters:
            yield node
    finally:
        node.close()
