"""`make jepsen MINUTES=30 [SEED=n] [FAULTS=a,b] [PAIRS=1]`: not among the tests, for its name is none of theirs."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any

import pytest

from .cluster import Cluster
from .nemesis import FAULTS, OF_ENGINE
from .run import run, timed


@pytest.mark.filterwarnings("ignore:unclosed <socket:ResourceWarning")  # docker's, where no engine answers
def test_faults_for_as_long_as_asked(
    clusters: Callable[..., Cluster],
    seed: int,
    faketime: str,
    request: pytest.FixtureRequest,
    capsys: pytest.CaptureFixture[str],
) -> None:
    names = [name for name in os.environ.get("FAULTS", "").split(",") if name] or list(FAULTS)
    unknown = sorted(set(names) - set(FAULTS))
    assert not unknown, f"there is no fault {', '.join(unknown)}; there are {', '.join(FAULTS)}"
    images: Any = request.getfixturevalue("docker_images") if OF_ENGINE & {*names} else None
    made = clusters(faketime, images)

    def say(text: str) -> None:
        with capsys.disabled():
            print(text, flush=True)  # noqa: T201

    say(f"seed {seed}, {made.folder}")
    minutes = float(os.environ.get("MINUTES") or 5)
    result = run(made, seed, timed(names, minutes * 60, bool(os.environ.get("PAIRS"))), say=say)
    say(result.text())
    if result.violations:
        pytest.fail(f"{len(result.violations)} violations", pytrace=False)
