"""The classes of types by their names; rclpy needs them even for messages that it does not decode."""

from __future__ import annotations

import contextlib
import importlib
import operator
from typing import Any

_PARTS = {
    "_SendGoal": "Impl.SendGoalService",
    "_GetResult": "Impl.GetResultService",
    "_FeedbackMessage": "Impl.FeedbackMessage",
    "_Goal": "Goal",
    "_Result": "Result",
    "_Feedback": "Feedback",
    "_Request": "Request",
    "_Response": "Response",
    "_Event": "Event",
}
"""What actions and services are made of, by the ends of the types' names."""


class NotInstalledError(Exception):
    """A type is not there; the text says what to do."""


def load(name: str) -> Any:
    """The class of ``std_msgs/msg/String``, of a service, an action, or a part of these.

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
        if found is None and kind != "msg" and short.endswith(end):
            with contextlib.suppress(AttributeError):
                found = operator.attrgetter(f"{short[: -len(end)]}.{part}")(module)
    if found is None:
        raise NotInstalledError(f"type {name} is not known to ROS 2 here: its package {package} has another version")
    return found
