"""What the pages of docs/ tell people to type is there: commands with their options, and YAML that is accepted."""

from __future__ import annotations

import ast
import re
import shlex
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import typer.main
import yaml

from skytether.api.config_file import check_config
from skytether.api.manifest import Manifest
from skytether.bridge.relay_config import RelayConfig
from skytether.cli.app import app
from skytether.cli.commands.bridge.config import BridgeConfig
from skytether.cli.lazy import LazyGroup
from skytether.orchestrator.runtimes.base import Runtime
from skytether.robot.config.gate_config import inherit
from skytether.robot.config.robot_config import RobotConfig
from skytether_services.navigation.status import Code

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
FILES = [*sorted((ROOT / "docs").rglob("*.service")), *sorted((ROOT / "ros1").rglob("*.service"))]
ROBOT = {"robot": "walker", "orchestrator": "https://cloud:8600", "token_file": "t", "service": "s", "ros1": {}}
TOPIC = {"name": "a", "type": "m/msg/M", "direction": "in"}
END = {"role": "robot", "id": "ff" * 8, "key_file": "key", "peer": {"host": "h", "port": 1}, "topics": [TOPIC]}


def commands() -> list[tuple[str, str]]:
    """Every command line of ours: in blocks of code, between backticks, in units of systemd."""
    found = []
    for page in [*PAGES, *FILES]:
        text = page.read_text()
        fenced = re.findall(r"^( *)```(\w*)\n(.*?)^\1```$", text, re.DOTALL | re.MULTILINE)  # each with its own end
        lines = [line for _, language, block in fenced if not language for line in block.splitlines()]
        lines += re.findall(r"`(skytether [^`]+)`", text) + re.findall(r"ExecStart=\S*/(skytether .*)", text)
        found += [(page.name, line.strip()) for line in lines if line.strip().startswith("skytether ")]
    return found


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_no_line_of_prose_is_longer_than_120_characters(page: Path) -> None:
    prose = re.sub(r"^( *)```\w*\n.*?^\1```$", "", page.read_text(), flags=re.DOTALL | re.MULTILINE)
    rows = (line for line in prose.splitlines() if not line.lstrip().startswith(("|", "![")))
    # A name or a link is never broken; only words are counted.
    words = (re.sub(r"`[^`]*`|\]\([^)]*\)", "", line) for line in rows)
    assert [line for line in words if len(line) > 120] == []


@cache
def root() -> Any:
    return typer.main.get_command(app)


@pytest.mark.parametrize(("page", "line"), commands())
def test_a_command_of_the_documentation_is_there(page: str, line: str) -> None:
    words = shlex.split(re.split(r"\\\||[|&>]", line)[0], comments=True)[1:]
    command = root()
    while words and hasattr(command, "commands") and not words[0].startswith("-"):
        name = words.pop(0)
        if name == "...":
            return
        assert name in command.commands, f"{page}: {line}"
        command = command.load(name) if isinstance(command, LazyGroup) else command.commands[name]
    known = {"-", "-h", "--help", "--install-completion"}  # every command has these, the last of them the first only
    options = known | {
        option for parameter in command.params for option in (*parameter.opts, *parameter.secondary_opts)
    }
    for word in words:
        assert not word.startswith("-") or word.partition("=")[0] in {*options, "-h", "--help"}, f"{page}: {line}"


def blocks() -> list[tuple[str, str]]:
    """Blocks of YAML. One that names a key again and again shows what it may be, line by line."""
    found = []
    for page in PAGES:
        for block in re.findall(r"```yaml\n(.*?)```", page.read_text(), re.DOTALL):
            keys = re.findall(r"^(\w+):", block, re.MULTILINE)
            several = len(keys) > len(set(keys))
            parts = re.split(r"^(?=\w)", block, flags=re.MULTILINE) if several else [block]
            found += [(page.name, part) for part in parts if part.strip()]
    return found


@pytest.mark.parametrize(("page", "block"), blocks())
def test_yaml_of_the_documentation_is_accepted(page: str, block: str) -> None:
    for document in yaml.safe_load_all(block):
        accept(document, page)


def accept(document: dict[str, Any], page: str) -> None:
    """Check it as what it is, with what it leaves out added.

    Raises:
        ConfigError: It is refused.
    """
    if "apiVersion" in document:
        Manifest.model_validate(document)
    elif document.keys() <= RelayConfig.model_fields.keys():
        check_config(document, RelayConfig, page)
    elif document.keys() & {"role", "paths", "topics"}:
        check_config({**END, **document}, BridgeConfig, page)
    else:
        graph = {"ros1": None} if "ros2" in document else {}
        check_config(inherit({**ROBOT, **graph, **document}), RobotConfig, page)


def promises() -> list[str]:
    """Rows of the table of what the gate guarantees."""
    text = (ROOT / "docs" / "safety.md").read_text()
    part = text.partition("## What is guaranteed\n")[2].partition("\n\n")[0]
    return part.splitlines()[2:]


def test_what_the_page_of_security_says_that_holds_is_held_by_tests() -> None:
    text = (ROOT / "docs" / "security.md").read_text()
    rows = text.partition("## What holds\n")[2].partition("\n## ")[0].strip().splitlines()[4:]
    assert len(rows) > 15
    for row in rows:
        named = re.findall(r"`([\w/]+\.py)::(test_\w+)`", row)
        assert named, f"no test holds: {row}"
        for file, name in named:
            assert f"def {name}(" in (ROOT / "tests" / file).read_text(), f"{file}::{name} of: {row}"


def test_each_promise_of_the_gate_names_tests_that_are_there() -> None:
    assert len(promises()) > 15
    for row in promises():
        cells = [cell.strip() for cell in row.strip("|").split(" | ")]
        assert len(cells) == 3, row
        named = re.findall(r"`(test_\w+\.py)::(test_\w+)`", cells[2])
        assert named, f"no test holds: {row}"
        assert cells[2] == " ".join(f"`{file}::{name}`" for file, name in named)
        for file, name in named:
            found = list((ROOT / "tests").rglob(file))
            assert any(f"def {name}(" in path.read_text() for path in found), f"{file}::{name} of: {row}"


def test_the_page_of_navigation_has_a_row_for_each_code() -> None:
    table = (ROOT / "docs" / "navigation.md").read_text().partition("| `code` | |\n")[2].partition("\n\n")[0]
    told = [code for row in table.splitlines() for code in re.findall(r"`(\w+)`", row.split("|")[1])]
    assert sorted(told) == sorted(code.value for code in Code if code is not Code.OK)


def test_each_rule_of_the_bridge_that_the_code_cites_is_on_its_page() -> None:
    rules = dict(re.findall(r"^### Rule (\d+): (.+)$", (ROOT / "docs" / "bridge.md").read_text(), re.MULTILINE))
    assert list(rules) == [str(number) for number in range(1, len(rules) + 1)], "a rule keeps its number"
    cited = {
        (path.stem, number)
        for package in ("wire", "bridge")
        for path in (ROOT / "platform" / "skytether" / package).rglob("*.py")
        for number in re.findall(r"rule (\d+)", path.read_text())
    }
    assert len(cited) > 20
    assert {number for _, number in cited} <= rules.keys()


INTERNALS = {
    "orchestrator": ("orchestrator", "bridge"),
    "robot": ("robot",),
    "safety": ("robot", "guard"),
    "wire": ("wire", "bridge"),
}
"""Pages of internals, and packages whose files and classes they name."""


@pytest.mark.parametrize(("name", "packages"), INTERNALS.items())
def test_what_a_page_of_internals_names_is_there(name: str, packages: tuple[str, ...]) -> None:
    page = (ROOT / "docs" / "internals" / f"{name}.md").read_text()
    platform = ROOT / "platform" / "skytether"
    homes = [platform, ROOT, *(folder / one for folder in (platform, ROOT / "tests") for one in packages)]
    homes += [ROOT / "tests" / "robot" / "safety", *(ROOT / "tests" / "robot" / "safety").iterdir()]
    files = re.findall(r"`([\w/]+\.py)`", page)
    assert len(files) > 20
    for file in files:
        assert any((home / file).is_file() for home in homes), file
    defined = {
        (type_.name, member)
        for package in packages
        for path in (platform / package).rglob("*.py")
        for type_ in ast.parse(path.read_text()).body
        if isinstance(type_, ast.ClassDef)
        for member in re.findall(r"(?:def |self\.)(\w+)", ast.unparse(type_))
    }
    named = re.findall(r"`([A-Z]\w+)\.(\w+)`", page)
    assert len(named) > 25
    assert set(named) <= defined, set(named) - defined


def test_the_page_of_runtimes_shows_its_example_as_it_is() -> None:
    page = (ROOT / "docs" / "writing-a-runtime.md").read_text()
    example = (ROOT / "docs" / "examples" / "plain_site" / "test_plain_site.py").read_text()
    shown = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    assert len(shown) == 1
    assert shown[0].strip() in example
    told = page.partition("Eight methods must be there:")[2].partition("\n\nThe others")[0]
    must = set(re.findall(r"^\| `(\w+)\(", told, re.MULTILINE))
    assert must == {"__init__", *Runtime.__abstractmethods__}
