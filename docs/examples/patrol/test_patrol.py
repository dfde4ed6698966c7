"""Calls in tests: the robot's by `Harness.call`, the service's answered by a function."""

import pytest

from patrol.service import Patrol
from skytether.messages import GetMapResponse, OccupancyGrid, SetBoolRequest
from skytether.service import CallError
from skytether.testing.service import Harness


def test_it_turns_once_it_has_the_map_and_pauses_when_told():
    harness = Harness(Patrol)
    harness.answers("get_map", lambda request: GetMapResponse(OccupancyGrid(data=[0, 100])))
    for _ in range(3):
        harness.step()
    assert harness.newest("cmd_vel").angular.z == 0.5
    assert harness.call("pause", SetBoolRequest(data=True)).success
    harness.step()
    assert harness.newest("cmd_vel").angular.z == 0.0


def test_without_a_map_it_asks_again_and_says_why_it_cannot_pause():
    harness = Harness(Patrol)
    for _ in range(4):
        harness.step()
    assert harness.newest("cmd_vel") is None
    with pytest.raises(CallError, match="not known yet"):
        harness.call("pause", SetBoolRequest(data=True))
