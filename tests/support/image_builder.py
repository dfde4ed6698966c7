"""``images/build.py`` as a module: it is a script, and part of no package; what it imports is beside it."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]


def build_script() -> Any:
    found = importlib.util.spec_from_file_location("images_build", ROOT / "images" / "build.py")
    assert found is not None
    assert found.loader is not None
    build = importlib.util.module_from_spec(found)
    sys.modules["images_build"] = build  # dataclasses look their module up
    try:
        found.loader.exec_module(build)
    finally:
        del sys.modules["images_build"]
    return build
