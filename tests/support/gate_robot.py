"""What a person does at a robot whose gate has just been started: reset, and let drive."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import pytest

from skytether.guard.estop import lasting_file
from skytether.robot.safety.client import GateError, ask
from skytether.robot.safety.protocol import default_record

PATIENCE_S = 30.0


def forget_stops(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A folder of tests may be called as one of days ago; what that was stopped for is kept outside of it."""
    monkeypatch.setenv("SKYTETHER_GATE_FOLDER", str(folder))
    Path(lasting_file(str(folder), str(default_record()))).unlink(missing_ok=True)


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
