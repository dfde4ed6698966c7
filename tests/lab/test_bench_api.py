"""Many instances and many requests, few of each here."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from skytether.api.manifest import Manifest
from skytether.api.rest import Renew
from skytether.lab.bench.api import bench_api, passes_in
from skytether.lab.bench.observe import Spread
from skytether.lab.bench.requests import MANIFEST, Held, Mix, report


@pytest.mark.slow
def test_every_request_is_answered_and_no_instance_is_lost():
    row = bench_api(3, 20, 3)
    assert (row.instances, row.requests, row.failed, row.lost) == (3, 60, 0, 0)
    assert 0 < row.client_p50_ms < row.api_p50_ms <= row.api_p99_ms <= row.api_max_ms
    assert {"renew", "show"} <= row.kinds.keys()
    assert 0 < row.pass_p50_ms <= row.pass_max_ms
    assert row.placer_max_ms > 0
    assert 0 < row.cpu_idle < row.cpu
    assert row.memory_mb > 10


def test_passes_are_those_that_the_log_tells_of():
    log = "2026 DEBUG x: site-fleet: pass of 1.50 ms\n2026 INFO other\n2026 DEBUG x: placer: pass of 20.00 ms\n"
    assert passes_in(log + log) == {"site-fleet": [1.5, 1.5], "placer": [20.0, 20.0]}
    assert Spread.of([0.001 * n for n in range(1, 101)]) == Spread(100, 50.0, 99.0, 100.0)


def test_the_mix_lets_go_only_what_was_made():
    mix = Mix([Held("r", "t", "i")], "o", np.random.default_rng(1))
    kinds: Counter[str] = Counter()
    for _ in range(1000):
        request = mix.next()
        kinds[request.kind] += 1
        if request.kind == "create":
            request.then(b'{"id": "made"}')
        assert (request.kind == "delete") == request.path.endswith("/made")
    assert 700 < kinds["renew"] < 900
    assert kinds["scrape"] == 2
    assert 0 < kinds["delete"] <= kinds["create"] < 60


def test_the_reports_topics_are_the_manifests_for_others_are_not_taken():
    told = Renew.model_validate_json(report()).report
    assert told is not None
    rows = Manifest.model_validate(MANIFEST).spec.topics
    assert [(t.topic, t.direction) for t in told.topics] == [(row.name, row.direction) for row in rows]
