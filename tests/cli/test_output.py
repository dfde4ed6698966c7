"""What commands print: nobody else's codes reach a terminal, and nothing is broken in a pipe."""

import io
import logging
import re

import pytest
from rich.progress import Progress, TextColumn
from rich.table import Table

from skytether.cli.output import SafeConsole, log_to_console, print_foreign, print_table


def test_warnings_are_one_line_on_standard_error_however_often_it_is_set_up(capsys):
    log_to_console()
    log_to_console()
    logging.getLogger("skytether.robot").warning("no [answer] yet")
    logging.getLogger("skytether.robot").info("chatter")
    assert capsys.readouterr() == ("", "warning: no [answer] yet\n")


def test_in_a_narrow_terminal_names_and_ids_stay_whole(monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "40")
    rows = [("0123456789abcdef", "walker", "virtual-trail", "failed", "a reason of many words " * 3)]
    print_table(("instance", "robot", "service", "state", "reason"), rows)
    shown = capsys.readouterr().out
    assert "0123456789abcdef" in shown
    assert "\N{HORIZONTAL ELLIPSIS}" not in shown, "what does not fit is folded"


def test_what_goes_to_a_file_has_each_row_on_one_line(monkeypatch, capsys):
    monkeypatch.delenv("COLUMNS", raising=False)
    row = [f"column {number}" for number in range(30)]
    print_table(row, [row])
    table = Table(*row)
    table.add_row(*row)
    SafeConsole(stderr=True).print(table)
    shown = capsys.readouterr()
    assert len(shown.out.splitlines()) == 2
    assert [line.count("column") for line in shown.err.splitlines()] == [0, 30, 0, 30, 0]


@pytest.mark.parametrize(("terminal", "shown"), [(True, "a       \\x1b[2Jb\\r\\x00\n"), (False, "a\tb\r\x00\n")])
def test_a_terminal_gets_no_codes_of_a_service(
    terminal: bool, shown: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.stdout.isatty", lambda: terminal)
    print_foreign("a\t\x1b[2Jb\r\x00\n")
    assert capsys.readouterr().out == shown


def test_a_table_gets_no_codes_and_no_markup_of_who_filled_it(capsys: pytest.CaptureFixture[str]) -> None:
    print_table(("service", "version"), [("toy", "1\x1b]0;title\x07 [red][/x]")])
    assert "1\\x1b]0;title\\x07 [red][/x]" in capsys.readouterr().out


@pytest.mark.parametrize("terminal", [True, False])
def test_whatever_is_shown_to_people_gets_no_codes_of_who_wrote_it(terminal: bool) -> None:
    out = io.StringIO()
    shown = SafeConsole(file=out, force_terminal=terminal, width=60, highlight=False)
    evil = "a\x1b]52;c;ZXZpbA==\x07\x1b]8;;http://x\x1b\\b\x9b2J\u202ec\r"
    shown.print(f"error: {evil}", style="red", markup=False, soft_wrap=True)
    with Progress(TextColumn("{task.description}", markup=False), console=shown) as bar:
        bar.add_task(evil, total=None)
    text = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", out.getvalue().replace("\r\x1b", "\x1b"))  # but for rich's own
    assert not set(text) & set("\x1b\x07\x9b\u202e\r")
    assert "a\\x1b]52;c;ZXZpbA==" in text
