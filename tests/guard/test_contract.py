"""The guard imports the standard library and its own files: seen in the code, whatever the package is called."""

import ast
import sys
from pathlib import Path

import skytether.guard

PACKAGE = Path(skytether.guard.__file__).parent


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


def test_what_would_break_it_is_seen():
    code = "import os, numpy.linalg\nfrom pydantic import BaseModel\nfrom ..robot import agent\nfrom . import clock"
    assert imported(ast.parse(code)) - sys.stdlib_module_names == {"numpy", "pydantic", ".."}
