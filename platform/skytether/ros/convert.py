"""Serialised messages of a ROS 1 robot for a ROS 2 graph, and back: for the types that both know."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from skytether.messages import Encoding, transcode, transcodes

Convert = Callable[[bytes | memoryview], bytes]
"""Raises `skytether.messages.DecodeError` for bytes that are no such message."""

_GENERATION = {"cdr": "ROS 2", "ros1": "ROS 1"}


class NoConversionError(ValueError):
    """A type that cannot be turned into the other ROS generation's; the text names it and what to do."""


def converter(typename: str, source: Encoding, target: Encoding) -> Convert | None:
    """What turns serialised messages of a type from one encoding into another; None where both are the same.

    Sequence numbers of ROS 1 headers are zero after a way through ROS 2, which has none.

    Args:
        typename: ``geometry_msgs/msg/Twist``; of services with ``_Request`` or ``_Response``.
        source: How messages are given.
        target: How they are wanted.

    Raises:
        NoConversionError: ROS 1 and ROS 2 do not have the same type of this name, as far as is known here.
    """
    if source == target:
        return None
    if not transcodes(typename):
        raise NoConversionError(
            f"{typename} cannot be turned from {_GENERATION[source]} into {_GENERATION[target]}: the codec knows no"
            " type of this name that both have; use a type of both, or the same ROS at both ends"
        )
    return partial(transcode, typename, source=source, target=target)
