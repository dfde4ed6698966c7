"""The page of licences is of the packages that are in the lock file."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]


def script() -> Any:
    spec = importlib.util.spec_from_file_location("licences", ROOT / ".ci" / "licences.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_page_lists_what_is_locked_and_each_says_its_licence() -> None:
    text = (ROOT / "docs" / "licences.md").read_text()
    rows = re.findall(r"^\| ([a-z0-9][a-z0-9._-]*) \| (\S+) \| ([^|]+) \|", text, re.MULTILINE)
    listed = {(name, version): said.strip() for name, version, said in rows if name != "package"}
    assert set(listed) == set(script().pins()), "run `make licences`"
    assert not [pin for pin, said in listed.items() if said in ("", "says none", "not installed here")]
    part = text.partition("## The others")[2]
    assert not script().CLOSER_LOOK.search(part)
