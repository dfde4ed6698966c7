"""Orchestrators over one database know of each other."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing

import pytest

from skytether.orchestrator.store.store import Store
from skytether.orchestrator.telemetry.heartbeat import PERIOD_S, SILENT_S, Heartbeat

pytestmark = [pytest.mark.slow, pytest.mark.postgres]


@pytest.fixture
def served(postgres: str) -> Iterator[Store]:
    with closing(Store(postgres)) as store:
        store.migrate()
        yield store


def test_who_beats_is_known_until_it_ends_or_is_silent(served: Store) -> None:
    now = 1_000.0
    one, two, silent = (
        Heartbeat(served, address, lambda: now) for address in ("http://one:8600", "http://two:8600", None)
    )
    for each in (one, two, silent):
        each.beat()
    assert sorted(silent.addresses()) == ["http://one:8600", "http://two:8600"]
    two.end()
    assert silent.addresses() == ["http://one:8600"]
    now += PERIOD_S / 2
    one.beat()  # too early: nothing is written
    now += SILENT_S - PERIOD_S / 4
    assert silent.addresses() == []
    one.beat()
    assert silent.addresses() == ["http://one:8600"]
    now -= 3_600.0  # the clock was set back
    one.beat()
    assert silent.addresses() == ["http://one:8600"]


def test_one_over_sqlite_is_alone(store: Store) -> None:
    alone = Heartbeat(store, "http://one:8600", lambda: 1_000.0)
    alone.beat()
    assert alone.addresses() == []
    alone.end()
