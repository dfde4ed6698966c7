"""A test that fails sometimes is a finding: it is named, whether it passes another time or not."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from slow_tests import RERUN, arrange

AGAIN = str(Path(__file__).parents[1] / ".ci" / "again.py")
FAILS_FIRST = """
import pathlib
import pytest

RUNS = pathlib.Path("runs")

@pytest.mark.parametrize("number", [0])
def test_it(number):
    runs = int(RUNS.read_text()) if RUNS.exists() else 0
    RUNS.write_text(str(runs + 1))
    assert runs >= {fails}
"""


def test_a_test_that_asks_to_be_run_again_by_itself_is_refused(request: pytest.FixtureRequest) -> None:
    request.node.add_marker(pytest.mark.flaky(reruns=1))
    with pytest.raises(pytest.UsageError, match=r"test_reruns.py::.* stands in RERUN"):
        arrange([request.node])


def test_what_may_be_run_again_is_there_and_has_a_reason(pytestconfig: pytest.Config) -> None:
    assert pytestconfig.getoption("reruns", None) is None
    for name, reason in RERUN.items():
        assert (Path(__file__).parent / name.partition("::")[0]).is_file()
        assert len(reason.split()) >= 2


@pytest.mark.slow
@pytest.mark.parametrize(
    ("statuses", "fails", "ends", "said"),
    [
        ([], 0, 0, ""),
        ([1], 1, 0, "failed beside others, passed alone: test_it.py::test_it[0]"),
        ([1], 2, 1, "It failed alone, too."),
        ([1, 2], 1, 1, "only if all parts ran to their end"),
    ],
)
def test_what_failed_beside_others_is_run_alone_and_named(
    tmp_path: Path, statuses: list[int], fails: int, ends: int, said: str
) -> None:
    (tmp_path / "test_it.py").write_text(FAILS_FIRST.format(fails=fails))
    pytest_here = [sys.executable, "-m", "pytest", "-q"]
    first = subprocess.run(pytest_here, cwd=tmp_path, capture_output=True)
    assert first.returncode == (fails > 0)
    again = subprocess.run([sys.executable, AGAIN, *map(str, statuses)], cwd=tmp_path, capture_output=True, text=True)
    assert again.returncode == ends
    assert said in again.stdout
