"""YAML as people write manifests and configurations: read safely, and with every key once."""

from __future__ import annotations

from collections.abc import Hashable
from pathlib import Path
from typing import Any

import yaml

from .document_checks import oddity

MAX_BYTES = 1 << 20
_MAX_VALUES = 10_000
"""Of a document with its aliases written out, or its length: without aliases each takes a byte at least."""


class YamlError(Exception):
    """It cannot be read, or is no YAML; the text says why and begins with the file."""


class _Loader(yaml.SafeLoader):
    """Refuses a key that comes twice: of two values one would be dropped without a word."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        seen = set()
        for key, _ in node.value:
            if key.tag == "tag:yaml.org,2002:merge":
                continue
            if key.value in seen:
                raise yaml.constructor.ConstructorError(
                    None, None, f"the key '{key.value}' comes twice", key.start_mark
                )
            if isinstance(key, yaml.ScalarNode):
                seen.add(key.value)
        return super().construct_mapping(node, deep)


def read_yaml(path: Path) -> list[Any]:
    """All documents of a file that hold anything, of what can be sent as JSON.

    Raises:
        YamlError: It cannot be read, is too large, is no YAML, or holds what JSON has no word for.
    """
    try:
        text = read_bounded(path)
    except OSError as error:
        raise YamlError(f"{path}: cannot be read: {error.strerror}") from error
    documents = parse_yaml(text, path)
    fault = next(filter(None, map(oddity, documents)), None)
    if fault is not None:
        raise YamlError(f"{path}: {fault}")
    return documents


def read_bounded(path: Path) -> bytes:
    """A file's bytes, no more than `parse_yaml` needs to see that it is too large.

    Raises:
        OSError: It cannot be read.
    """
    with path.open("rb") as file:
        return file.read(MAX_BYTES + 1)


def parse_yaml(text: bytes, path: Path) -> list[Any]:
    """All documents of a text that hold anything.

    Args:
        text: What the file holds.
        path: What to call it in a complaint.

    Raises:
        YamlError: It is too large, or is no YAML.
    """
    if len(text) > MAX_BYTES:
        raise YamlError(f"{path}: is larger than {MAX_BYTES} bytes: that is nothing people write")
    try:
        documents = [document for document in yaml.load_all(text, _Loader) if document is not None]
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        mark = getattr(error, "problem_mark", None)
        where = f" in line {mark.line + 1}" if mark else ""
        raise YamlError(f"{path}: is no YAML{where}: {getattr(error, 'problem', None) or 'it is no text'}") from error
    if any(_is_endless(document, max(_MAX_VALUES, len(text))) for document in documents):
        raise YamlError(f"{path}: an alias stands for what it is part of, or for far too much; write it out")
    return documents


def _is_endless(document: Any, left: int) -> bool:
    """Whether aliases make more of it than anybody could read: whoever walks through it would not come back."""
    waiting = [document]
    while waiting:
        value = waiting.pop()
        inner = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
        left -= len(inner)
        if left < 0:
            return True
        waiting.extend(v for v in inner if isinstance(v, dict | list))
    return False
