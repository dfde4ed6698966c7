"""Arguments that ROS gives a node: as a command takes them, and what becomes of them."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Annotated

import typer

from skytether.ros.ros1.arguments import ArgumentError, parse

from .output import fail

if TYPE_CHECKING:
    from skytether.ros.ros1.arguments import RosArguments

RosWords = Annotated[
    list[str] | None,
    typer.Argument(
        metavar="[FROM:=TO]...",
        help="As roslaunch and our package for ros2 launch give them: remappings, _PARAMETER:=VALUE, __name:=, __ns:=; "
        "of ROS 1 __master:=, __ip:=, too.",
        show_default=False,
    ),
]


def given(words: list[str] | None) -> RosArguments:
    """What they say, and the environment; a word that ROS does not know ends the command."""
    try:
        return parse(words or (), os.environ)
    except ArgumentError as error:
        fail(str(error), 2)
