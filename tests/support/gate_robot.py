"""What a person does at a robot whose gate has just been started: reset, and let drive."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import pytest

from skytether.robot.safety.client import GateError, ask

PATIENCE_S = 30.0


def insist(folder: Path, request: dict[str, Any]) -> dict[str, Any]:
    """Ask until the gate is there and says yes."""
    end = time.monotonic() + PATIENCE_S
    while True:
        try:
            return ask(folder, request, PATIENCE_S)
        except GateError as error:
            if time.monotonic() > end:
                pytest.fail(f"not within {PATIENCE_S:g} s: {request}: {error}")
            time.sleep(0.05)


def release(folder: Path) -> None:
    """End the emergency stop; a machine that was started is stopped."""
    insist(folder, {"do": "reset"})
