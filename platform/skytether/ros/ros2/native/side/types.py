"""The classes of types by their names; rclpy needs them even for messages that it does not decode."""

from __future__ import annotations

import importlib
from typing import Any

_PARTS = {
    "_SendGoal": "SendGoalService",
    "_GetResult": "GetResultService",
    "_FeedbackMessage": "FeedbackMessage",
}
"""What an action is made of, by the ends of the types' names."""


class NotInstalledError(Exception):
    """A type is not there; the text says what to do."""


def load(name: str) -> Any:
    """The class of ``std_msgs/msg/String``, of a service, or of a part of an action.

    Raises:
        NotInstalledError: ROS 2's Python does not have it.
    """
    package, kind, short = name.split("/")
    try:
        module = importlib.import_module(f"{package}.{kind}")
    except ImportError as error:
        raise NotInstalledError(
            f"type {name} is not known to ROS 2 here ({error}): install package {package}, or source its workspace"
        ) from None
    found = getattr(module, short, None)
    for end, part in _PARTS.items():
        if found is None and kind == "action" and short.endswith(end):
            action = getattr(module, short[: -len(end)], None)
            found = getattr(getattr(action, "Impl", None), part, None)
    if found is None:
        raise NotInstalledError(f"type {name} is not known to ROS 2 here: its package {package} has another version")
    return found
