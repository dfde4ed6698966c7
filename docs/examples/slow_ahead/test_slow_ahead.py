import math

import numpy as np
import pytest

from skytether.control.admittance import Velocity
from skytether.messages import LaserScan
from skytether.robot.control.fallback import Reading
from slow_ahead.fallback import SlowAhead

STILL = Velocity(0.0, 0.0)


def seeing(metres: float) -> dict[str, Reading]:
    scan = LaserScan(
        angle_min=-math.pi / 2, angle_increment=math.pi / 180, ranges=np.full(181, metres, dtype=np.float32)
    )
    return {"scan": Reading(scan, 4.0)}


@pytest.mark.parametrize(("metres", "speed"), [(5.0, 0.1), (0.65, 0.05), (0.6, 0.0), (0.1, 0.0), (math.nan, 0.0)])
def test_it_slows_down_and_stops_before_what_is_ahead(metres, speed):
    wanted, read_at = SlowAhead().step(STILL, seeing(metres), 0.01)
    assert wanted == pytest.approx((speed, 0.0), abs=1e-6)
    assert read_at == 4.0


def test_without_a_laser_it_says_nothing_and_the_robot_stops():
    assert SlowAhead().step(STILL, {}, 0.01) is None


def test_options_that_make_no_sense_are_refused():
    with pytest.raises(ValueError, match="speed must be above 0"):
        SlowAhead(speed=2.0)
