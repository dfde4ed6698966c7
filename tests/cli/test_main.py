"""The command as a program: what it says, where, and with which exit status."""

import importlib.metadata
import io
import logging
import os
import re
import signal
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import typer
from rich.progress import Progress, TextColumn
from typer.core import TyperGroup
from typer.testing import CliRunner

from skytether.cli import main as entry
from skytether.cli.app import app
from skytether.cli.commands.demo import _told
from skytether.cli.commands.robot.check import Finding, show
from skytether.cli.lazy import LazyGroup
from skytether.cli.output import SafeConsole, log_to_console, print_foreign, print_table
from skytether.robot.control.arbiter import Reason
from skytether.robot.control.command import Source
from skytether.robot.control.control_loop import Transition


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


def groups(group):
    """All groups of commands, each with its name."""
    yield group
    for name in group.commands:
        command = group.load(name)
        if isinstance(command, TyperGroup):
            yield from groups(command) if isinstance(command, LazyGroup) else [command]


@pytest.mark.slow
def test_help_says_of_each_command_what_the_command_says_of_itself():
    root = typer.main.get_command(app)
    lazy = [group for group in groups(root) if isinstance(group, LazyGroup)]
    assert {group.name for group in lazy} == {"", "lab", "bench", "run", "scenario", "robot", "site"}
    for group in lazy:
        for name in group.table:
            said = group.load(name).help.partition("\n\n")[0]
            assert " ".join(said.split()) == group.commands[name].help
            assert group.load(name).name == name


@pytest.mark.parametrize(
    ("words", "imported"),
    [
        ([], []),
        (["robot"], ["robot", "robot.app"]),
        (["lab", "bench"], ["lab", "lab.app"]),
        (["site"], ["site", "site.app"]),
    ],
)
def test_help_of_a_group_imports_no_command(words, imported):
    code = (
        f"import sys; from skytether.cli.app import app; app([*{words}, '--help'], standalone_mode=False);"
        "print([name.partition('.commands.')[2] for name in sys.modules if '.cli.commands.' in name], file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "Usage" in done.stdout
    assert done.stderr == f"{imported}\n"


@pytest.mark.slow
def test_each_command_has_its_help_where_no_extra_is_installed():
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())["project"]
    needed = {re.split(r"[^\w.-]", line)[0].lower() for line in project["dependencies"]}
    extras = {
        re.split(r"[^\w.-]", line)[0].lower() for lines in project["optional-dependencies"].values() for line in lines
    }
    modules = [
        module
        for module, owners in importlib.metadata.packages_distributions().items()
        if not {owner.lower() for owner in owners} & needed
        and {owner.lower() for owner in owners} & (extras - {"skytether"})
    ]
    assert {"fastapi", "sqlalchemy", "matplotlib", "docker", "kubernetes", "zenoh"} <= set(modules)
    code = """
import pkgutil, sys
import skytether.cli
sys.modules.update(dict.fromkeys(sys.argv[1:]))
for module in pkgutil.walk_packages(skytether.cli.__path__, "skytether.cli."):
    if not module.name.endswith("__main__"):
        __import__(module.name)
"""
    subprocess.run([sys.executable, "-c", code, *modules], check=True)


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


def test_what_others_publish_in_the_graph_is_no_markup(capsys):
    assert show([Finding("ok", "scan", "/scan", "sensor_msgs/[/x]", "[red]")])
    assert "sensor_msgs/[/x]" in capsys.readouterr().out
