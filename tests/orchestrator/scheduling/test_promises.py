"""Sums of what sites have promised: the same as if all were added up anew."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skytether.orchestrator.domain.records import Record, new_record
from skytether.orchestrator.scheduling.promises import NOTHING, Promised, Promises

NewRecord = Callable[..., Record]


def record(number: int, site: str | None, cpu: float = 1.0) -> Record:
    needs = {"cpu": cpu, "memory_mb": 10, "gpu": 1}
    manifest = {
        "apiVersion": "skytether.io/v1",
        "kind": "Service",
        "metadata": {"name": "toy"},
        "spec": {"entrypoint": "m", "topics": [], "needs": needs},
    }
    made = new_record(
        robot="r", service="toy", manifest=manifest, created_at=0.0, updated_at=0.0, lease_s=1.0, lease_expires_at=1.0
    )
    return replace(made, id=f"i{number}", site=site)


def test_each_site_has_what_its_instances_asked_for() -> None:
    promises = Promises([record(1, "a"), record(2, "a", 0.5), record(3, "b"), record(4, None)])
    assert promises.sums() == {"a": Promised(1.5, 20, 2, 2), "b": Promised(1.0, 10, 1, 1)}


def test_without_some_the_sums_themselves_stay_as_they_are() -> None:
    one = record(1, "a")
    promises = Promises([one, record(2, "a")])
    assert promises.sums(without=[one.id, "unknown"])["a"] == Promised(1.0, 10, 1, 1)
    assert promises.sums()["a"].instances == 2


@given(st.lists(st.tuples(st.integers(0, 5), st.sampled_from(["a", "b", None]), st.booleans()), max_size=40))
def test_whatever_comes_and_goes_it_is_as_if_all_were_added_up(changes: list[tuple[int, str | None, bool]]) -> None:
    promises, there = Promises(), dict[int, Record]()
    for number, site, comes in changes:
        if comes:
            there[number] = record(number, site, cpu=0.25 * (number + 1))
            promises.remove(there[number])
            promises.add(there[number])
        else:
            promises.remove(there.pop(number, record(number, "a")))
    anew = Promises(there.values()).sums()
    for site, sum_ in promises.sums().items():
        assert sum_ == pytest.approx(anew.get(site, NOTHING))
