"""Shells ask the installed command what could come next."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from skytether.cli import names
from skytether.lab.embedded import EmbeddedOrchestrator

pytestmark = pytest.mark.slow
Ask = Callable[..., str]


@pytest.fixture
def shell(tmp_path: Path) -> Ask:
    """Run a command where the console script ``skytether`` is on the path."""
    script = tmp_path / "bin" / "skytether"
    script.parent.mkdir()
    script.write_text(f"#!{sys.executable}\nfrom skytether.cli.main import main\n\nmain()\n")
    script.chmod(0o755)
    clean = {key: value for key, value in os.environ.items() if not key.startswith("SKYTETHER_")}
    base = {**clean, "PATH": f"{script.parent}:{os.environ['PATH']}", "HOME": str(tmp_path)}

    def ask(*command: str, **variables: str) -> str:
        done = subprocess.run(command, env={**base, **variables}, capture_output=True, text=True, timeout=120)
        assert done.stderr == ""
        return done.stdout

    return ask


def test_bash_completes_verbs_options_and_names(shell: Ask) -> None:
    bash = shutil.which("bash")
    assert bash is not None
    pressed = """
    eval "$(_SKYTETHER_COMPLETE=source_bash skytether)"
    press() { COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); _skytether_completion skytether; echo "${COMPREPLY[*]}"; }
    press skytether inst
    press skytether instance mig
    press skytether service show rec
    SKYTETHER_URL=http://127.0.0.1:1 press skytether service show rec
    """
    with EmbeddedOrchestrator() as orchestrator:
        told = shell(bash, "-c", pressed, SKYTETHER_URL=orchestrator.url, SKYTETHER_TOKEN=orchestrator.operator_token)
    assert told.splitlines() == ["instance", "migrate", "recorder", ""]


@pytest.mark.parametrize("word", ["1\\$(touch x)", "1`x`", "1'; x; '", "1\n2", "1\x1b[2J", "1\u202e"])
def test_no_word_that_others_wrote_reaches_a_shell_that_evaluates_it(
    word: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SKYTETHER_URL", "http://127.0.0.1:1")
    monkeypatch.setenv("SKYTETHER_TOKEN", "token")
    complete = names.completion(lambda _: [("toy", f"version {word}"), (word, "version 1"), ("tool", "version 1.2+3")])
    asked: Any = SimpleNamespace(params={})
    assert complete(asked, "") == [("tool", "version 1.2+3")]


@pytest.mark.parametrize(
    ("shell_name", "variables", "expected"),
    [
        ("zsh", {}, '"migrate":"Move an instance'),
        ("fish", {"_TYPER_COMPLETE_FISH_ACTION": "get-args"}, "migrate\tMove an instance"),
    ],
)
def test_other_shells_get_a_script_and_words_with_their_meaning(
    shell: Ask, shell_name: str, variables: dict[str, str], expected: str
) -> None:
    assert f"complete_{shell_name}" in shell("skytether", _SKYTETHER_COMPLETE=f"source_{shell_name}")
    asked = {"_SKYTETHER_COMPLETE": f"complete_{shell_name}", "_TYPER_COMPLETE_ARGS": "skytether instance mig"}
    assert expected in shell("skytether", **asked, **variables)
