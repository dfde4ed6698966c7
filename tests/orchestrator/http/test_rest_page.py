"""The page of REST is the one that is made from the API, and says of each request what it does."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path

ROOT = Path(__file__).parents[3]


def test_the_page_of_rest_is_current() -> None:
    spec = importlib.util.spec_from_file_location("rest_api", ROOT / ".ci" / "rest_api.py")
    assert spec is not None
    assert spec.loader is not None
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    page = script.page()
    assert (ROOT / "docs" / "rest-api.md").read_text() == page, "run `make docs`"
    requests = re.findall(r"^### (?:GET|PUT|POST|PATCH|DELETE) \S+\n\n([A-Z].+)$", page, re.MULTILINE)
    assert len(requests) == len(re.findall(r"^### [A-Z]+ /", page, re.MULTILINE)) > 40
    anchors = {heading.lower() for heading in re.findall(r"^### (\w+)$", page, re.MULTILINE)}
    assert set(re.findall(r"\]\(#(\w+)\)", page)) <= anchors
