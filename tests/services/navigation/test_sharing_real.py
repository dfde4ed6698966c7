"""Two robots, two processes of the service, one orchestrator: all is real but the world."""

from __future__ import annotations

import pytest
from shared_halls import share


@pytest.mark.slow
def test_two_processes_share_by_their_robots_and_one_orchestrator() -> None:
    share()
