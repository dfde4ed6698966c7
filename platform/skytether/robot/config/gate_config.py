"""The part of robot.yaml that the gate reads: a mistake in any other part is not its business, and does not stop it."""

from __future__ import annotations

from difflib import get_close_matches
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, field_validator, model_validator

from skytether.api.config_file import read_config
from skytether.robot.graphs.registry import GRAPHS, keys
from skytether.robot.safety.config.safety_config import NO_GATE, WITHOUT_SECTION, SafetyConfig
from skytether.ros.names import namespace_of
from skytether.ros.ros1.arguments import RosArguments

_ALIKE = 0.8
"""From here on a key is taken for a misspelt one."""


class _GateFile(BaseModel):
    model_config = ConfigDict(extra="ignore", frozen=True)
    safety: SafetyConfig

    @field_validator("safety", mode="before")
    @classmethod
    def _is_wanted(cls, section: Any) -> Any:
        if section == NO_GATE:
            raise ValueError("is none: this robot is to have no gate; take the key away for a gate without sensors")
        return section

    @field_validator("safety")
    @classmethod
    def _has_a_graph_for_its_topics(cls, safety: SafetyConfig) -> SafetyConfig:
        if safety.display is not None and safety.graph is None:
            raise ValueError(f"display needs {keys()}; without a graph there is `skytether robot gate-status --json`")
        if safety.enable is not None and safety.enable.topic and safety.graph is None:
            raise ValueError(f"enable.topic needs {keys()}; without a graph give enable.file, chip or socket")
        return safety

    @model_validator(mode="before")
    @classmethod
    def _inherit_from_robot(cls, document: Any) -> Any:
        if isinstance(document, dict) and "safety" not in document:  # a slip must not be a gate without sensors
            meant = [key for key in document if get_close_matches("safety", [str(key).lower()], cutoff=_ALIKE)]
            if meant:
                raise ValueError(f"the key {meant[0]!r} is unknown, did you mean 'safety'?")
        return inherit(document)


def inherit(document: Any) -> Any:
    """The file with what its section ``safety`` takes from its other parts, where it says nothing itself.

    These are ``limits`` with their reasons in ``beyond``, and of the robot's graph, unless the wheels are behind
    ``sockets``, where the graph and its wheels are. A robot that is a graph and has no such section gets
    `WITHOUT_SECTION`.
    """
    if not isinstance(document, dict):
        return document
    if "safety" not in document and any(isinstance(document.get(way), dict) for way in GRAPHS):
        document = document | {"safety": WITHOUT_SECTION}
    if not isinstance(document.get("safety"), dict):
        return document
    safety = dict(document["safety"])
    if isinstance(document.get("limits"), dict) and "limits" not in safety:
        safety["limits"] = document["limits"]
        reasons, own = document.get("beyond"), safety.get("beyond", {})
        if isinstance(reasons, dict) and isinstance(own, dict):
            safety["beyond"] = reasons | own
    for way, kind in GRAPHS.items():
        graph, own = document.get(way), safety.get(way) or {}
        if isinstance(graph, dict) and isinstance(own, dict) and safety.get("sockets") is None:
            robot = {key: graph[key] for key in kind.gate_section.model_fields if graph.get(key) is not None}
            if "namespace" not in robot and isinstance(document.get("robot"), str):
                robot["namespace"] = namespace_of(document["robot"])
            safety[way] = robot | own
    return document | {"safety": safety}


def load_safety(path: Path, ros: RosArguments | None = None) -> SafetyConfig:
    """Read and check the section ``safety``.

    Args:
        path: The file.
        ros: What ROS gave on the command line, which counts more than the file.

    Raises:
        ConfigError: It cannot be read, is no YAML, or a key of the section is wrong or missing.
    """
    safety = read_config(path, _GateFile, (ros or RosArguments()).over).safety
    if safety.graph is None:
        return safety
    kind, way = safety.graph
    return safety.model_copy(update={kind.key: kind.prepared(way, path.parent)})
