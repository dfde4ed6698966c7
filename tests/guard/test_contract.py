"""The guard imports the standard library and its own files: seen in the code, whatever the package is called."""

import ast
import re
import subprocess
import sys
from pathlib import Path

import skytether.guard

PACKAGE = Path(skytether.guard.__file__).parent
PAGE = Path(__file__).parents[2] / "docs" / "safety.md"


def imported(tree: ast.AST) -> set[str]:
    """Top names of absolute imports; a relative one that leaves the package is named by its dots."""
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {name.name.split(".")[0] for name in node.names}
        elif isinstance(node, ast.ImportFrom):
            top = "." * node.level if node.level else (node.module or "").split(".")[0]
            found |= {top} if top != "." else set()
    return found


def test_nothing_but_the_standard_library():
    files = sorted(PACKAGE.rglob("*.py"))
    assert len(files) > 3
    for file in files:
        strange = imported(ast.parse(file.read_text())) - sys.stdlib_module_names
        assert not strange, f"{file.name} imports {strange}"


def test_the_page_counts_our_modules_as_they_are():
    """How many of Python's own there are depends on the machine."""
    code = "import sys, skytether.guard.__main__; print(sum(n.split('.')[0] == 'skytether' for n in sys.modules))"
    ours = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True, timeout=60).stdout
    said = re.search(r"The guard is one process without a library: .* (\d+) of them ours", PAGE.read_text())
    assert said is not None
    assert int(said[1]) == int(ours)


def test_what_would_break_it_is_seen():
    code = "import os, numpy.linalg\nfrom pydantic import BaseModel\nfrom ..robot import agent\nfrom . import clock"
    assert imported(ast.parse(code)) - sys.stdlib_module_names == {"numpy", "pydantic", ".."}
