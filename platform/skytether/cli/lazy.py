"""Groups whose commands are imported when they are used, so that ``skytether --help`` imports none (Click's way).

A group's help names each command with one sentence. That stands in the table of the group, and a test compares it with
the command's own.

A command's file imports at its top. In functions are imports that need an extra (help is there without it), and, where
one file has several verbs, those of the client: help and completion are not to wait for it.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from typing import Any, ClassVar, NamedTuple

import typer
from typer.core import TyperCommand, TyperGroup
from typing_extensions import override


class Lazy(NamedTuple):
    """Where a command is.

    Attributes:
        module: Below `skytether.cli.commands`.
        attribute: A function, or a `typer.Typer`.
        help: What the group's help says of it.
    """

    module: str
    attribute: str
    help: str


class LazyCommand(TyperCommand):
    """Stands in the help of its group for a command that is not imported yet."""

    def __init__(self, name: str, lazy: Lazy) -> None:
        super().__init__(name, help=lazy.help)
        self._lazy = lazy

    def load(self) -> Any:
        """Import the command."""
        found = getattr(import_module(f"skytether.cli.commands.{self._lazy.module}"), self._lazy.attribute)
        if not isinstance(found, typer.Typer):
            alone = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
            alone.command(self.name)(found)
            return typer.main.get_command(alone)
        found.info.name = self.name
        return typer.main.get_group(found)


class LazyGroup(TyperGroup):
    """A group with a table of commands."""

    table: ClassVar[Mapping[str, Lazy]] = {}

    def __init__(self, **given: Any) -> None:
        super().__init__(**given)
        self.commands.update({name: LazyCommand(name, lazy) for name, lazy in self.table.items()})

    def load(self, name: str) -> Any:
        """A command, imported; None: there is none of this name."""
        command = self.commands.get(name)
        return command.load() if isinstance(command, LazyCommand) else command

    @override
    def resolve_command(self, ctx: Any, args: list[str]) -> tuple[str | None, Any, list[str]]:
        name, command, rest = super().resolve_command(ctx, args)
        return name, command.load() if isinstance(command, LazyCommand) else command, rest
