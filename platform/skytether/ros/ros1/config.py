"""How a configuration says where a ROS 1 graph is."""

from __future__ import annotations

import os

from pydantic import Field, field_validator

from skytether.api.manifest import Strict

DEFAULT_MASTER = "http://localhost:11311"


class Ros1Link(Strict):
    """How a ROS 1 graph is joined."""

    master: str = Field(default_factory=lambda: os.environ.get("ROS_MASTER_URI") or DEFAULT_MASTER)
    """Address of the master; without it ``ROS_MASTER_URI``, or this machine's."""
    host: str | None = None
    """Address of this machine that other nodes can reach; null: ROS_HOSTNAME, ROS_IP, or found out."""

    @field_validator("master")
    @classmethod
    def _an_address(cls, uri: str) -> str:
        if not uri.startswith("http://"):
            raise ValueError(f"must be an address such as {DEFAULT_MASTER}, not '{uri}'")
        return uri
