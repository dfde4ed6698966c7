"""The command as a program: what it says, where, and with which exit status."""

import os
import signal
import subprocess
import sys

import pytest
from typer.testing import CliRunner

from skytether.cli import main as entry
from skytether.cli.app import app
from skytether.cli.commands.demo import _told
from skytether.cli.commands.robot.check import show
from skytether.robot.control.arbiter import Reason
from skytether.robot.control.command import Source
from skytether.robot.control.control_status import Transition
from skytether.robot.graphs.finding import Finding


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


def test_what_others_publish_in_the_graph_is_no_markup(capsys):
    assert show([Finding("ok", "scan", "/scan", "sensor_msgs/[/x]", "[red]")])
    assert "sensor_msgs/[/x]" in capsys.readouterr().out
