"""Names of topics and types, as ROS 2 writes them and as key expressions can hold them."""

from __future__ import annotations

import re

_TOPIC = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+")
_TYPE = re.compile(r"[A-Za-z][A-Za-z0-9_]*/(msg|srv|action)/[A-Za-z][A-Za-z0-9_]*")
_DDS_TYPE = re.compile(r"([A-Za-z][A-Za-z0-9_]*)::(msg|srv|action)::dds_::([A-Za-z][A-Za-z0-9_]*)_")


def full_name(name: str, namespace: str = "/") -> str:
    """Fully qualified name of a topic, service or action; a name that starts with ``/`` stands for itself.

    Raises:
        ValueError: ROS 2 allows no such name.
    """
    full = name if name.startswith("/") else f"{namespace.rstrip('/')}/{name}"
    if not _TOPIC.fullmatch(full):
        raise ValueError(
            f"'{full}' is not a valid name of ROS 2: parts of letters, digits and '_', no digit first, divided by '/'"
        )
    return full


def check_type(name: str) -> str:
    """Return a type name such as ``std_msgs/msg/String``.

    Raises:
        ValueError: It is none.
    """
    if not _TYPE.fullmatch(name):
        raise ValueError(f"'{name}' is no type of ROS 2; types look like std_msgs/msg/String or std_srvs/srv/Trigger")
    return name


def dds_type(name: str) -> str:
    """``std_msgs/msg/String`` as ``std_msgs::msg::dds_::String_``."""
    package, kind, short = check_type(name).split("/")
    return f"{package}::{kind}::dds_::{short}_"


def ros_type(dds: str) -> str | None:
    """Inverse of `dds_type`; None if it is none."""
    match = _DDS_TYPE.fullmatch(dds)
    return "/".join(match.groups()) if match else None
