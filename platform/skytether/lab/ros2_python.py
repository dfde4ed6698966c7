"""Where ROS 2's Python is, for what is measured or played beside the platform."""

from __future__ import annotations

import os
from pathlib import Path

PYTHON = "SKYTETHER_ROS2_PYTHON"
"""Names ROS 2's Python."""


def ros2_python() -> str:
    """ROS 2's Python: the one that is named, else that of `make ros2`, else ``python3`` of a sourced ROS 2."""
    made = Path(".venv-ros2/bin/python")
    return os.environ.get(PYTHON) or (str(made.absolute()) if made.exists() else "python3")
