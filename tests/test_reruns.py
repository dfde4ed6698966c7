"""A test that fails sometimes is a finding: none is run again but those that are named, with their reason."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest


@pytest.fixture
def conftest(request: pytest.FixtureRequest) -> Any:
    return next(one for one in request.config.pluginmanager.get_plugins() if hasattr(one, "RERUN"))


def test_a_test_that_asks_to_be_run_again_by_itself_is_refused(conftest: Any, request: pytest.FixtureRequest) -> None:
    request.node.add_marker(pytest.mark.flaky(reruns=1))
    with pytest.raises(pytest.UsageError, match=r"test_reruns.py::.* stands in RERUN"):
        conftest.pytest_collection_modifyitems([request.node])


def test_what_may_be_run_again_is_there_and_has_a_reason(conftest: Any, pytestconfig: pytest.Config) -> None:
    assert pytestconfig.getoption("reruns", None) is None
    for name, reason in conftest.RERUN.items():
        assert (Path(__file__).parent / name.partition("::")[0]).is_file()
        assert len(reason.split()) >= 2
