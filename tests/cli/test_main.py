"""The command as a program: what it says, where, and with which exit status."""

import logging
import os
import signal
import subprocess
import sys

import pytest

from skytether.cli import main as entry
from skytether.cli.output import log_to_console


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
    root = logging.getLogger()
    before = list(root.handlers)
    try:
        log_to_console()
        log_to_console()
        logging.getLogger("skytether.robot").warning("no [answer] yet")
        logging.getLogger("skytether.robot").info("chatter")
    finally:
        root.handlers[:] = before
    assert capsys.readouterr() == ("", "warning: no [answer] yet\n")
