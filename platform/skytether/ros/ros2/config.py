"""How a configuration says where a ROS 2 graph is, and the node that comes of it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field, field_validator

from skytether.api.config_file import ConfigError
from skytether.api.manifest import Strict
from skytether.ros.names import check_name

if TYPE_CHECKING:
    from skytether.ros.ros2.node import Ros2Node

_EXTRA = "a ROS 2 graph needs the extra 'ros2': pip install 'skytether[ros2]'"


class Ros2Graph(Strict):
    """A ROS 2 graph, by its Zenoh router."""

    router: Annotated[str, Field(pattern=r"^[a-z]+/.+")] | None = None
    """``tcp/HOST:PORT`` or ``tls/HOST:PORT``; null: as ``zenoh_config`` says, or tcp/127.0.0.1:7447."""
    zenoh_config: Path | None = None
    """Configuration file of Zenoh's (JSON5), for certificates and the like; relative to this file's folder."""
    dialect: Literal["rmw_zenoh", "ros2dds"] = "rmw_zenoh"
    """Nodes that run rmw_zenoh_cpp, or nodes on DDS behind zenoh-bridge-ros2dds."""
    domain: Annotated[int, Field(ge=0, le=232)] = 0
    """ROS_DOMAIN_ID; of ``rmw_zenoh``."""
    type_hashes: bool = True
    """False for ROS 2 Humble, whose types have no hash; of ``rmw_zenoh``."""
    bridge_namespace: str = "/"
    """The ``namespace`` that zenoh-bridge-ros2dds is configured with; of ``ros2dds``."""
    node: Annotated[str, Field(pattern=r"^[A-Za-z_][A-Za-z0-9_]*$")] = "skytether"
    """Name of our node in the graph."""
    parameters: dict[str, dict[str, Any]] = {}
    """Values that nodes of the graph get whenever they show up, by the node's full name and the parameter's."""

    @field_validator("bridge_namespace")
    @classmethod
    def _a_namespace(cls, name: str) -> str:
        return check_name(name, 2)


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
def join_graph(settings: Ros2Graph, folder: Path, namespace: str = "/") -> Iterator[Ros2Node]:
    """The node that a configuration asks for, for as long as the context lasts; it sets the parameters of others.

    Args:
        settings: Where and how.
        folder: That paths are relative to.
        namespace: Of the node in the graph.

    Raises:
        ConfigError: The extra is not installed, Zenoh does not take a setting, or a value can be no parameter.
    """
    need_extra()
    from skytether.ros.ros2.dialect import Dialect, NodeName, RmwZenoh, Ros2Dds
    from skytether.ros.ros2.node import Ros2Error, Ros2Node
    from skytether.ros.ros2.parameters import Parameters

    dialect: Dialect
    if settings.dialect == "rmw_zenoh":
        dialect = RmwZenoh(settings.domain, settings.type_hashes)
    else:
        dialect = Ros2Dds(settings.bridge_namespace)
    file = None if settings.zenoh_config is None else folder / settings.zenoh_config
    name = NodeName(namespace, settings.node)
    try:
        node = Ros2Node(dialect, router=settings.router, config_file=file, name=name)
        parameters = Parameters(node, settings.parameters)
    except (Ros2Error, ValueError) as error:
        raise ConfigError(f"ros2: {error}") from error
    with node, parameters:
        yield node
