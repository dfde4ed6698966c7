"""What every command prints the same way: errors, warnings, JSON, the console for people."""

from __future__ import annotations

import json
import logging
import sys
from typing import Any, NoReturn

import typer
from rich.console import Console
from rich.markup import escape

console = Console(stderr=True, highlight=False)
"""For people: progress, tables, notes. Standard output is kept for what programs read."""


def fail(sentence: str, status: int = 1) -> NoReturn:
    """Say what went wrong and what to do in one sentence on standard error, and end.

    Args:
        sentence: Without "error:" in front.
        status: Exit status; 2 for wrong usage or configuration, 1 for everything else.
    """
    console.print("error: ", style="bold red", end="")
    console.print(sentence, markup=False, soft_wrap=True)
    raise typer.Exit(status)


def print_json(document: Any) -> None:
    """Print one JSON document on standard output, and nothing else."""
    json.dump(document, sys.stdout, allow_nan=False, separators=(",", ":"))
    sys.stdout.write("\n")
    sys.stdout.flush()


def log_to_console() -> None:
    """Show warnings that parts of Skytether log while a command runs, one line each, above any progress bar."""
    root = logging.getLogger()
    if not any(isinstance(handler, _ConsoleHandler) for handler in root.handlers):
        root.addHandler(_ConsoleHandler(logging.WARNING))


class _ConsoleHandler(logging.Handler):
    def emit(self, record: logging.LogRecord) -> None:
        try:
            text = self.format(record)
            console.print(f"[yellow]{record.levelname.lower()}:[/] {escape(text)}", soft_wrap=True)
        except Exception:
            self.handleError(record)
