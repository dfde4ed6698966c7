"""The file that an instance reads at start: everything it needs, and nobody else may see.

It holds the session key, so it has mode 0600 (process), or is a secret mount (Docker, Kubernetes). Its path,
never its contents, is in the environment variable ``SKYTETHER_GRANT``.
"""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Field, SerializerFunctionWrapHandler, model_serializer

from .manifest import ServiceGraph, Strict, TopicSpec

GRANT_VARIABLE = "SKYTETHER_GRANT"
DEFAULT_GRANT_PATH = "/run/skytether/grant.json"


class Grant(Strict):
    """What the orchestrator grants to one instance."""

    instance: str
    service: str
    robot: str
    params: dict[str, Any] = {}
    session_id: str
    """16 hexadecimal digits."""
    session_key: Annotated[str, Field(repr=False)]
    """32 bytes, base64."""
    topics: tuple[TopicSpec, ...]
    launch: str | None = None
    """Of a service with a ROS graph of its own: its launch file, see the manifest."""
    graph: ServiceGraph = "ros1"
    """Of such a service: the generation."""
    remap: dict[str, str] = {}
    """Of such a service: names in its graph."""
    bind_host: str = "127.0.0.1"
    bind_port: int = 0
    """0: any free port; the one taken is told in ``ready_file``."""
    ready_file: str | None = None
    """Written (atomically) once the bridge listens: ``{"port": 40123, "pid": 4711}``."""
    health_port: Annotated[int, Field(ge=0, le=65_535)] = 0
    """TCP port of ``bind_host`` on which the service answers of its health over HTTP, see `skytether.service`; 0: its
    runtime looks at the files."""
    data_dir: str = "."
    """Where the instance may write what it produces (recordings)."""
    step_times: bool = False
    """Tell with the reports how long steps take."""
    idle_exit_s: float = 120
    """The instance ends by itself when it has heard nothing from its robot for this long."""

    @model_serializer(mode="wrap")
    def _as_earlier_images_take_it(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Services of earlier images refuse a grant that speaks of step times, or says that a graph is of ROS 1."""
        document: dict[str, Any] = handler(self)
        if not self.step_times:
            document.pop("step_times", None)
        if self.graph == "ros1":
            document.pop("graph", None)
        return document
