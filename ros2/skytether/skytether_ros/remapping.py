"""What is behind ``--ros-args`` on a node's command line, as far as it is for the node's child, too. Pure.

rclpy takes such arguments for itself and does not tell them, so they are read a second time.
(design.ros2.org/articles/ros_command_line_arguments.html and static_remapping.html.)
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

_TAKE_ONE = ("-p", "--param", "--params-file", "--log-level", "--log-file-name", "-e", "--enclave")
_OWN = ("__node", "__name", "__ns")


def remappings(arguments: Sequence[str], node: str) -> list[str]:
    """The rules ``FROM:=TO`` for names in the graph, without those of other nodes, in their order.

    Args:
        arguments: Of the whole command line.
        node: Name of this one: a rule may be for one node alone, ``NODE:FROM:=TO``.
    """
    found = []
    left, among = list(arguments), False
    while left:
        word = left.pop(0)
        if word == "--ros-args":
            among = True
        elif among and word == "--":
            among = False
        elif among and word in ("-r", "--remap") and left:
            rule = _rule(left.pop(0), node)
            if rule:
                found.append(rule)
        elif among and word in _TAKE_ONE and left:
            left.pop(0)
    return found


def enclave(arguments: Sequence[str]) -> str:
    """The last one that is given; empty: none."""
    names = [after for word, after in pairwise(arguments) if word in ("-e", "--enclave")]
    return names[-1] if names else ""


def _rule(text: str, node: str) -> str:
    old, mark, new = text.partition(":=")
    for_node, colon, name = old.partition(":")
    if colon and "//" not in old:
        if for_node != node:
            return ""
        old = name
    for scheme in ("rostopic://", "rosservice://"):
        old = old.removeprefix(scheme)
    return "" if not mark or old in _OWN else f"{old}:={new}"
