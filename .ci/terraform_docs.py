"""The page of each module and example of ``terraform/``: what it is for, its variables and outputs. ``make docs``."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import hcl2

TERRAFORM = Path(__file__).resolve().parent.parent / "terraform"


def pages() -> Iterator[tuple[Path, str]]:
    """Each page, and what it holds."""
    for main in sorted(TERRAFORM.glob("*/*/main.tf")):
        yield main.parent / "README.md", page(main.parent)


def page(folder: Path) -> str:
    """The page of one folder; its first words are the comment at the head of ``main.tf``."""
    head = re.match(r"(?:#.*\n)+", (folder / "main.tf").read_text())
    about = " ".join(line.lstrip("# ") for line in (head[0] if head else "").splitlines())
    lines = [f"# {folder.name}", "", about, "", "Made from the `.tf` files (`make docs`).", ""]
    lines += ["## Variables", "| name | type | default | means |", "| --- | --- | --- | --- |"]
    for name, body in blocks(folder / "variables.tf", "variable"):
        default = f"`{shown(body['default'])}`" if "default" in body else "**must be given**"
        lines.append(f"| `{name}` | `{shown(body['type'])}` | {default} | {text(body['description'])} |")
    lines += ["", "## Outputs", "| name | is |", "| --- | --- |"]
    for name, body in blocks(folder / "outputs.tf", "output"):
        lines.append(f"| `{name}` | {text(body['description'])} |")
    return "\n".join(lines) + "\n"


def blocks(file: Path, kind: str) -> Iterator[tuple[str, dict[str, Any]]]:
    """Name and body of each block of a kind."""
    for entry in hcl2.loads(file.read_text()).get(kind, ()):
        for name, body in entry.items():
            yield name.strip('"'), body


def text(value: str) -> str:
    """A string as it is meant, fit for a table."""
    return str(json.loads(value)).replace("|", "\\|")


def shown(value: Any) -> str:
    """A type or a default on one line, as Terraform writes it."""
    if isinstance(value, dict):
        inner = ", ".join(f"{key} = {shown(one)}" for key, one in value.items() if not key.startswith("__"))
        return f"{{ {inner} }}" if inner else "{}"
    if isinstance(value, list):
        return f"[{', '.join(shown(one) for one in value)}]"
    if isinstance(value, bool) or value is None:
        return json.dumps(value)
    line = re.sub(r"\s+", " ", str(value))
    bare = re.fullmatch(r"\$\{(.*)\}", line)
    return re.sub(r"\( \{|\(\{ ", "({ ", bare[1] if bare else line)


if __name__ == "__main__":
    for path, content in pages():
        path.write_text(content)
