"""Every runtime of ours keeps the contract that `skytether.testing` ships."""

from __future__ import annotations

from skytether.testing.runtime_contract import RuntimeContract


class TestRuntime(RuntimeContract):
    """Over each kit of ``conftest.py``."""
