"""Many instances and many requests, few of each here."""

import pytest

from skytether.lab.bench.api import _spread, bench_api
from skytether.lab.bench.pair import BenchError


@pytest.mark.slow
def test_every_request_is_answered_and_no_instance_is_lost():
    row = bench_api(3, 20, 2)
    assert (row.instances, row.requests, row.failed, row.lost) == (3, 40, 0, 0)
    assert 0 < row.api_p50_ms <= row.api_p99_ms
    assert 0 < row.pass_p50_ms <= row.pass_max_ms
    assert row.memory_mb > 10


def test_the_spread_of_passes_is_that_of_the_ones_in_between():
    before = {0.01: 10.0, 0.1: 20.0, 1.0: 20.0}
    after = {0.01: 13.0, 0.1: 24.0, 1.0: 25.0}  # 3 up to 10 ms, 1 up to 100 ms, 1 up to 1 s
    assert _spread(before, after) == (0.01, 1.0)
    with pytest.raises(BenchError, match="no pass"):
        _spread(after, after)
