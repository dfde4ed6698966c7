"""The rows as tables: on the console and in Markdown."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from rich.box import SIMPLE_HEAD
from rich.console import Group
from rich.table import Table
from rich.text import Text

from .bridge import Plan
from .figures import draw
from .rows import Row
from .transports import load

COLUMNS = ("condition", "transport", "topic", "sent", "lost %", "p50", "p95", "p99", "max", "overhead %", "CPU %")
"""Of a complete table; delays in milliseconds, processor time in percent of one core: robot's end / service's end."""

_WIDTHS = (20, 4, 6, 5, 5, 6, 6, 7, 9)


def cells(row: Row) -> tuple[str, ...]:
    """One line of a table."""
    return (
        row.condition,
        _named(row),
        row.topic,
        str(row.sent),
        f"{100 * row.lost:.2f}",
        *(_number(v) for v in (row.delay_p50_ms, row.delay_p95_ms, row.delay_p99_ms, row.delay_max_ms)),
        "" if row.overhead is None else f"{100 * row.overhead:.1f}",
        "/".join(f"{100 * s / row.seconds:.1f}" for s in (row.cpu_robot_s, row.cpu_service_s)),
    )


def console_table(rows: Sequence[Row], title: str) -> Group:
    """For people at a terminal of 80 columns: a table for each condition, and what rows have in common above them."""
    tables = []
    for condition in dict.fromkeys(row.condition for row in rows):
        table = Table(title=condition, box=SIMPLE_HEAD, padding=0, title_justify="left")
        for i, header in enumerate((*COLUMNS[2:-2], "extra %", COLUMNS[-1])):
            table.add_column(header, justify="right" if i else "left", no_wrap=bool(i), min_width=_WIDTHS[i])
        transport = None
        for row in rows:
            if row.condition != condition:
                continue
            _, named, topic, *numbers, extra, cpu = cells(row)
            if transport != row.transport:
                transport = row.transport
                table.add_row(named, *[""] * len(numbers), extra, cpu, style="bold")
            table.add_row(f"  {topic}", *numbers, "", "")
        tables.append(table)
    return Group(Text(title, style="bold"), *tables)


def markdown_table(rows: Sequence[Row]) -> str:
    """The same in Markdown."""
    lines = ["| " + " | ".join(COLUMNS) + " |", "|" + " --- |" * 3 + " ---: |" * (len(COLUMNS) - 3)]
    lines += ["| " + " | ".join(cells(row)) + " |" for row in rows]
    return "\n".join(lines) + "\n"


def write_report(plan: Plan, rows: Sequence[Row], failures: Sequence[str], folder: Path) -> None:
    """Write ``report.md``, ``rows.json`` and the pictures.

    Args:
        plan: What was measured.
        rows: What came out.
        failures: What could not be measured, a sentence each.
        folder: Made if it is missing.
    """
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "rows.json").write_text(json.dumps([row.document() for row in rows], indent=1) + "\n")
    late = [row.emulator_late_ms for row in rows if row.emulator_late_ms is not None]
    remarks = [
        *plan.notes,
        *(f"{name}: {load(name).ABOUT}" for name in dict.fromkeys(row.transport for row in rows)),
        *(f"not measured: {sentence}" for sentence in failures),
        "overhead: bytes of IP packets in both directions beyond payload, over payload; "
        "CPU: percent of one core, robot's end / service's end, making and checking the messages included",
        *([f"the emulator was at most {max(late):.1f} ms late with a packet"] if late else []),
        *(f"![{file.stem}]({file.name})" for file in draw(plan.suite, rows, folder)),
    ]
    lines = [f"# {plan.title[0].upper()}{plan.title[1:]}", "", *(f"- {remark}" for remark in remarks), ""]
    (folder / "report.md").write_text("\n".join(lines) + "\n" + markdown_table(rows))


def _named(row: Row) -> str:
    return f"{row.transport} ({row.congestion})" if row.congestion else row.transport


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.1f}"
