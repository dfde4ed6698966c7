"""A small fleet, with every disturbance once."""

from __future__ import annotations

import pytest

from skytether.lab.bench import fleet, fleet_robot
from skytether.lab.bench.fleet import LEAST_ROBOTS, bench_fleet
from skytether.robot.agent.snapshot import report


@pytest.mark.slow
def test_nothing_is_lost_in_accounting():
    row = bench_fleet(LEAST_ROBOTS, 4)
    assert (row.lost_in_accounting, row.miscounted, row.fallen, row.left_over) == (0, 0, 0, 0)
    assert row.messages > 3000  # of four seconds of Table 4: some 600 a robot
    assert row.renewals > LEAST_ROBOTS * fleet.PHASES


@pytest.mark.slow
def test_one_message_that_is_not_told_is_noticed(monkeypatch):
    def forgetful(*args, **options):
        told = report(*args, **options)
        topics = (
            topic.model_copy(update={"delivered": max(0, topic.delivered - 1)}) if topic.topic == "/tf" else topic
            for topic in told.topics
        )
        return told.model_copy(update={"topics": tuple(topics)})

    monkeypatch.setattr(fleet_robot, "report", forgetful)
    row = bench_fleet(LEAST_ROBOTS, 4)
    assert row.lost_in_accounting >= LEAST_ROBOTS
    assert row.miscounted > 0
