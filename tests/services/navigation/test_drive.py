"""The whole service in the simulated building: its closed loop. Numba compiles for seconds in a fresh clone."""

from pathlib import Path

import pytest

from skytether.lab.world.plan import building
from skytether.testing.drive import Drive
from skytether_services.navigation.service import Navigation

pytestmark = pytest.mark.slow


def test_all_nine_goals_are_reached_without_contact(tmp_path: Path) -> None:
    goals = [{"x": goal.x, "y": goal.y, "yaw": goal.heading} for goal in building().goals]
    drive = Drive(Navigation, tmp_path, {"goals": goals}, building())
    assert drive.until("succeeded", 240.0), drive.status
    assert not drive.world.contacts
    assert drive.robot.distance < 50.0
