"""A test that fails sometimes is a finding: none is run again but those that are named, with their reason."""

from __future__ import annotations

from pathlib import Path

import pytest
from slow_tests import RERUN, arrange


def test_a_test_that_asks_to_be_run_again_by_itself_is_refused(request: pytest.FixtureRequest) -> None:
    request.node.add_marker(pytest.mark.flaky(reruns=1))
    with pytest.raises(pytest.UsageError, match=r"test_reruns.py::.* stands in RERUN"):
        arrange([request.node])


def test_what_may_be_run_again_is_there_and_has_a_reason(pytestconfig: pytest.Config) -> None:
    assert pytestconfig.getoption("reruns", None) is None
    for name, reason in RERUN.items():
        assert (Path(__file__).parent / name.partition("::")[0]).is_file()
        assert len(reason.split()) >= 2
