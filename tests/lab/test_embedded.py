"""The orchestrator of demonstrations and benchmarks."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

import httpx
import pytest

PROGRAM = """
import sys, time
from pathlib import Path
from skytether.lab.embedded import EmbeddedOrchestrator
with EmbeddedOrchestrator(Path(sys.argv[1])) as orchestrator:
    print(orchestrator.url, flush=True)
    time.sleep(60)
"""


def answers(url: str) -> bool:
    try:
        return httpx.get(f"{url}/healthz", trust_env=False).status_code == 200
    except httpx.TransportError:
        return False


@pytest.mark.slow
def test_it_ends_when_the_program_that_has_it_is_killed(tmp_path: Path) -> None:
    command = [sys.executable, "-c", PROGRAM, str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as program:
        assert program.stdout is not None
        url = program.stdout.readline().strip()
        assert answers(url)
        program.kill()
    deadline = time.monotonic() + 30
    while answers(url):
        assert time.monotonic() < deadline
        time.sleep(0.05)
