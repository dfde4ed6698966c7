"""The part of robot.yaml that the gate reads: a mistake in any other part is not its business, and does not stop it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, model_validator

from skytether.robot.safety.config import SafetyConfig

from .config_file import read_config


class _GateFile(BaseModel):
    model_config = ConfigDict(extra="ignore", frozen=True)
    safety: SafetyConfig

    @model_validator(mode="before")
    @classmethod
    def _limits_of_the_robot(cls, document: Any) -> Any:
        return with_limits(document)


def with_limits(document: Any) -> Any:
    """The file with its own ``limits`` as those of the section ``safety``, where that has none."""
    if isinstance(document, dict) and isinstance(document.get("safety"), dict) and document.get("limits") is not None:
        return document | {"safety": {"limits": document["limits"]} | document["safety"]}
    return document


def load_safety(path: Path) -> SafetyConfig:
    """Read and check the section ``safety``.

    Raises:
        ConfigError: It cannot be read, is no YAML, or a key of the section is wrong or missing.
    """
    return read_config(path, _GateFile).safety
