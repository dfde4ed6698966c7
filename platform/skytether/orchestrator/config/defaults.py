"""Where an orchestrator of this machine is found when nobody says otherwise; cheap to import."""

from __future__ import annotations

import os
from pathlib import Path

DEFAULT_HOST = "127.0.0.1"
DEFAULT_PORT = 8600


def default_state_dir() -> Path:
    """Where a person's orchestrator keeps its state, by the XDG base directory specification."""
    return Path(os.environ.get("XDG_STATE_HOME") or "~/.local/state").expanduser() / "skytether"
