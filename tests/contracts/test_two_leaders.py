"""Every runtime of ours keeps the contract with two orchestrators that `skytether.testing` ships."""

from __future__ import annotations

from skytether.testing.runtime_contract import TwoLeadersContract


class TestTwoLeaders(TwoLeadersContract):
    """Over each kit of ``conftest.py``."""
