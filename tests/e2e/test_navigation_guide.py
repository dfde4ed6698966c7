"""docs/navigation-guide.md as a reader follows it: its files are written, and its commands run, in an empty folder."""

from __future__ import annotations

import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from skytether_services.navigation.grid_map import load_map
from skytether_services.navigation.status import Code

PAGE = (Path(__file__).parents[2] / "docs" / "navigation-guide.md").read_text()
SKYTETHER = Path(sys.executable).with_name("skytether")
SECONDS = {"guide/map.yaml": 25, "guide/drive.yaml": 180, "guide/patrol.yaml": 75}
"""The corridor is mapped, not the whole building. The drive ends when it is there, later on a busy machine."""


def files() -> dict[str, str]:
    """What the page says to write."""
    found = dict(re.findall(r"`(guide/\w+\.yaml)`:\n```\n(.*?)```", PAGE, re.DOTALL))
    (script,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    return {**found, "guide/zones.py": script}


def commands() -> list[list[str]]:
    """What the page says to type."""
    blocks = re.findall(r"^```(\w*)\n(.*?)^```$", PAGE, re.DOTALL | re.MULTILINE)
    return [
        shlex.split(line) for _, block in blocks for line in block.splitlines() if line.startswith(("sky", "python "))
    ]


def test_every_code_has_a_row() -> None:
    table = PAGE.partition("## What each code asks of you")[2]
    told = set(re.findall(r"`(\w+)`", " ".join(re.findall(r"^\| (`[^|]*) \|", table, re.MULTILINE)))) - {"code"}
    assert told == {code.value for code in Code}


def test_the_page_has_as_many_files_and_commands_as_are_tried() -> None:
    assert set(files()) == {*SECONDS, "guide/zones.py"}
    assert [words[4] if words[0] == "skytether" else words[1] for words in commands()] == [
        "guide/map.yaml", "guide/drive.yaml", "guide/zones.py", "guide/patrol.yaml",
    ]  # fmt: skip


@pytest.mark.slow
def test_an_unknown_building_is_mapped_and_patrolled(tmp_path: Path) -> None:
    (tmp_path / "guide").mkdir()
    for name, text in files().items():
        (tmp_path / name).write_text(text)
    came: dict[str, dict[str, object]] = {}
    for words in commands():
        if words[0] == "python":
            subprocess.run([sys.executable, *words[1:]], cwd=tmp_path, check=True)
            continue
        line = [str(SKYTETHER), *words[1:], "--seconds", str(SECONDS[words[4]]), "--json"]
        done = subprocess.run(line, cwd=tmp_path, env={**os.environ, "COLUMNS": "200"}, capture_output=True, text=True)
        assert done.returncode == 0, done.stdout + done.stderr
        came[words[4]] = json.loads(done.stdout)
    grid = load_map(tmp_path / "guide" / "office.yaml")
    assert grid.at(3.0, 1.0) == 0  # floor of the southern corridor
    assert grid.columns * grid.resolution > 5
    assert came["guide/map.yaml"]["state"] == "mapping"
    first = came["guide/drive.yaml"]
    assert (first["state"], first["code"]) == ("succeeded", "ok")
    patrol = came["guide/patrol.yaml"]
    assert patrol["state"] == "driving"
    assert (patrol["round"], patrol["goal"]) > (1, 1)
    for name in ("way.png", "first/way.png", "patrol/way.png"):
        assert (tmp_path / "guide" / name).stat().st_size > 10_000
