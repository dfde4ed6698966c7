"""What every command prints the same way: errors, warnings, JSON, the console for people."""

from __future__ import annotations

import json
import logging
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, NoReturn

import typer
from rich.console import Console
from rich.markup import escape
from rich.segment import Segment
from typing_extensions import override

from skytether.api.printable import printable

if TYPE_CHECKING:
    from pydantic import BaseModel
    from rich.table import Table
    from rich.text import Text

_WIDE = 10_000
"""Columns of what goes to a pipe or a file: more than any row of a table has."""
_PRIVATE = {"session": {"key"}}


class SafeConsole(Console):
    """A terminal gets no codes but rich's own, wherever the text is from that is among its output.

    What is no terminal gets each line whole: a program that reads lines must not find one row on two of them.
    """

    def __init__(self, **how: Any) -> None:
        super().__init__(**how)
        if "width" not in how and not self.is_terminal:  # whatever COLUMNS says
            self.width = _WIDE

    @override
    def _render_buffer(self, buffer: Iterable[Segment]) -> str:
        return super()._render_buffer(
            segment if segment.control else segment._replace(text=printable(segment.text)) for segment in buffer
        )


console = SafeConsole(stderr=True, highlight=False)
"""For people: progress, tables, notes. Standard output is kept for what programs read."""


@contextmanager
def silenced(logger: str) -> Iterator[None]:
    """Without a log's warnings, where a command brings about what they warn of."""
    log = logging.getLogger(logger)
    before = log.level
    log.setLevel(logging.ERROR)
    try:
        yield
    finally:
        log.setLevel(before)


def fail(sentence: str, status: int = 1) -> NoReturn:
    """Say what went wrong and what to do in one sentence on standard error, and end.

    Args:
        sentence: Without "error:" in front.
        status: Exit status; 2 for wrong usage or configuration, 1 for everything else.
    """
    _complain(sentence)
    raise typer.Exit(status)


def fail_all(sentences: Sequence[str], status: int = 1) -> NoReturn:
    """The same for several things that are wrong at once, a line each."""
    for sentence in sentences[:-1]:
        _complain(sentence)
    fail(sentences[-1], status)


def _complain(sentence: str) -> None:
    console.print("error: ", style="bold red", end="")
    console.print(sentence, markup=False, soft_wrap=True)


def print_foreign(text: str) -> None:
    """What a service wrote, as it wrote it; but a terminal gets no codes of it, which could write all over it."""
    typer.echo(printable(text.expandtabs()) if sys.stdout.isatty() else text, nl=False)


def print_json(document: Any) -> None:
    """Print one JSON document on standard output, and nothing else."""
    json.dump(document, sys.stdout, allow_nan=False, separators=(",", ":"))
    sys.stdout.write("\n")
    sys.stdout.flush()


def plain(model: BaseModel) -> Any:
    """A model as JSON, without session keys: the output of a command ends up in logs and bug reports."""
    return model.model_dump(
        mode="json", by_alias=True, exclude=_PRIVATE if "session" in type(model).model_fields else None
    )


def or_dash(value: Any) -> Any:
    """For a cell of a table; times to the second, in UTC."""
    if isinstance(value, datetime):
        return value.astimezone(UTC).strftime("%Y-%m-%d %H:%M:%SZ")
    return "-" if value is None else value


def cell(value: Any) -> Text:
    """What a table shows of a value, which others may have written: no code for the terminal, and no markup of ours."""
    from rich.text import Text

    return Text(printable(str(value)))


def print_table(head: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    """A table for people, on standard output."""
    from rich.table import Table

    table = Table(box=None, pad_edge=False)
    for i, name in enumerate(head):
        table.add_column(name, no_wrap=i == 0, overflow="fold")  # names and ids stay whole, so that they can be copied
    for row in rows:
        table.add_row(*(cell(value) for value in row))
    print_whole(table)


def print_whole(table: Table) -> None:
    """A table on standard output."""
    SafeConsole(highlight=False).print(table)


def log_to_console() -> None:
    """Show warnings that parts of Skytether log while a command runs, one line each, above any progress bar."""
    root = logging.getLogger()
    if not any(isinstance(handler, _ConsoleHandler) for handler in root.handlers):
        root.addHandler(_ConsoleHandler(logging.WARNING))


class _ConsoleHandler(logging.Handler):
    def emit(self, record: logging.LogRecord) -> None:
        try:
            # Some of it others wrote: a terminal obeys no code of theirs, and no second line looks like one of ours.
            text = printable(self.format(record).replace("\n", "\n    "))
            console.print(f"[yellow]{record.levelname.lower()}:[/] {escape(text)}", soft_wrap=True)
        except Exception:
            self.handleError(record)


def show(model: BaseModel, json: bool) -> None:
    """All of one thing, as YAML or JSON on standard output."""
    import yaml

    if json:
        print_json(plain(model))
    else:
        typer.echo(yaml.safe_dump(plain(model), sort_keys=False), nl=False)
