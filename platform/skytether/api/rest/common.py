"""What is the same for all resources: problems, names in paths, what a document that was put did."""

from __future__ import annotations

import re
from enum import StrEnum
from typing import Any

from skytether.api.manifest import Strict


class Change(StrEnum):
    """What a document that was put did, in the header ``Skytether-Change`` of the answer."""

    CREATED = "created"
    CHANGED = "changed"
    UNCHANGED = "unchanged"


CHANGE = "Skytether-Change"
PATH_NAME = re.compile(r"[A-Za-z0-9_-]{1,64}")
"""What can stand for something in a path: names and ids; never a part of a path, a query, or a control character."""


class ScrapeTargets(Strict):
    """One group of Prometheus' HTTP service discovery."""

    targets: tuple[str, ...]
    """``HOST:PORT`` of each."""
    labels: dict[str, str] = {}
    """What all of them get; ``__scheme__`` says how they are asked."""


class Problem(Strict):
    """RFC 9457 problem document."""

    type: str = "about:blank"
    title: str
    status: int
    detail: str = ""
    """One sentence with what to do."""
    instance: str | None = None
    errors: tuple[dict[str, Any], ...] = ()
    """For invalid input: ``{"key": "spec.topics.0.prority", "detail": "unknown key"}``."""
