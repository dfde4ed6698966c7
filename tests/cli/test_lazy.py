"""Groups whose commands are imported when they are used."""

import importlib.metadata
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import typer
from typer.core import TyperGroup

from skytether.cli.app import app
from skytether.cli.lazy import LazyGroup


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
