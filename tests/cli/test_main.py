"""The command as a program: what it says, where, and with which exit status."""

import logging
import os
import signal
import subprocess
import sys

import pytest
from typer.testing import CliRunner

from skytether.cli import main as entry
from skytether.cli.app import app
from skytether.cli.demo import _told
from skytether.cli.output import log_to_console, print_foreign, print_table
from skytether.robot.arbiter import Reason
from skytether.robot.command import Source
from skytether.robot.driver import Transition


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_at_any_moment_ends_it_without_a_word(monkeypatch, capsys, number):
    previous = {n: signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)}
    monkeypatch.setattr("skytether.cli.app.app", lambda: os.kill(os.getpid(), number))
    try:
        with pytest.raises(SystemExit) as ended:
            entry.main()
    finally:
        for n, handler in previous.items():
            signal.signal(n, handler)
    assert ended.value.code == 130
    assert capsys.readouterr() == ("", "")


def test_the_entry_point_imports_nothing_that_takes_long():
    seen = (
        "import sys, skytether.cli.main; print([m for m in sys.modules if m.startswith(('typer', 'rich', 'pydantic'))])"
    )
    result = subprocess.run([sys.executable, "-c", seen], capture_output=True, text=True, check=True)
    assert result.stdout == "[]\n"


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


@pytest.mark.parametrize(
    ("reason", "sentence"),
    [
        (Reason.NO_COMMAND, "At 3.2 m the walker's own controller drives: no valid command came in time."),
        (Reason.LOSS, "At 3.2 m the walker's own controller drives: more is lost than the service bears."),
    ],
)
def test_a_hand_over_is_told_in_words(reason, sentence):
    assert _told(Transition(0.0, Source.FALLBACK, reason), 3.21) == sentence


def test_a_plot_folder_that_cannot_be_made_is_one_sentence():
    result = CliRunner().invoke(app, ["demo", "--json", "--output", "/proc/none"])
    assert (result.exit_code, result.stdout) == (2, "")
    assert result.stderr == (
        "error: cannot make the folder /proc/none: No such file or directory; give another with --output\n"
    )


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
