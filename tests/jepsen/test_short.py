"""A minute of faults, of each kind one; `make jepsen` goes on for longer, with all of them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from .cluster import Cluster
from .run import run

pytestmark = [
    pytest.mark.slow,
    pytest.mark.postgres,
    pytest.mark.docker,
    pytest.mark.filterwarnings("ignore:unclosed <socket:ResourceWarning"),  # docker's, where no engine answers
]

SEED = 13
FAULTS = (
    ("kill-leader",),
    ("end-leadership", "kill-services"),
    ("pause-leader", "remove-containers"),
    ("clock-leader", "database-restart"),
)


def test_nothing_that_was_promised_is_broken(
    clusters: Callable[..., Cluster], faketime: str, docker_images: Any
) -> None:
    result = run(clusters(faketime, docker_images), SEED, lambda _: FAULTS)
    assert not result.violations, result.text()
    assert result.instances > 10
    assert result.moves
    assert result.given
