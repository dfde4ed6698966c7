"""The example service, and that what the documentation shows of it is what it is. Its own test lies beside it."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import yaml
from wall_stop.service import WallStop

from skytether.api.manifest import Manifest
from skytether.service import params_schema

DOCS = Path(__file__).parents[2] / "docs"
EXAMPLE = DOCS / "examples" / "wall_stop"


def test_manifest_says_what_the_code_does() -> None:
    manifest = Manifest.model_validate(yaml.safe_load((EXAMPLE / "service.yaml").read_text()))
    assert manifest.spec.entrypoint == EXAMPLE.name
    assert manifest.spec.params == params_schema(WallStop)
    assert [(t.name, t.type, t.direction) for t in manifest.spec.topics] == [
        (d.topic, d.type_name, d.direction.value) for d in WallStop.declared
    ]


def shown(document: Path) -> dict[str, str]:
    """Files that a page shows: "`wall_stop/name`:" with a block of code after it."""
    return dict(re.findall(r"`(\w+/[\w.]+)`:\n```\w+\n(.*?)```\n", document.read_text(), re.DOTALL))


@pytest.mark.parametrize(
    "name",
    [
        *(f"wall_stop/{name}" for name in ("service.py", "__main__.py", "service.yaml", "test_wall_stop.py")),
        "patrol/service.py",
        "errand/service.py",
    ],
)
def test_the_page_shows_the_files_as_they_are(name: str) -> None:
    assert shown(DOCS / "writing-a-service.md")[name] == (EXAMPLE.parent / name).read_text()


def test_the_readme_shows_the_class_as_it_is() -> None:
    assert (EXAMPLE / "service.py").read_text() in (DOCS.parent / "README.md").read_text()
