import math

import numpy as np
import pytest

from skytether.control.admittance import STANDSTILL, Velocity
from skytether.lab.walker import Arms, Walker, WalkerParams

DT = 0.01
RELAXED = Arms(0.0, 0.0)


def walker(**params: float) -> Walker:
    return Walker(WalkerParams(**params), np.random.default_rng(0))


def test_answers_a_command_with_a_time_constant_of_100_ms() -> None:
    w = walker()
    for _ in range(10):
        w.step(Velocity(0.2, 0.4), RELAXED, DT)
    assert w.velocity == pytest.approx((0.2 * (1 - math.exp(-1)), 0.4 * (1 - math.exp(-1))))


def test_drives_a_circle() -> None:
    w = walker(slip=0.0, time_constant=1e-6)
    for _ in range(round(math.tau / 0.5 / DT)):  # once round at 0.5 rad/s; radius 0.4 m
        w.step(Velocity(0.2, 0.5), RELAXED, DT)
    assert math.hypot(w.pose.x, w.pose.y) < 2e-3
    assert w.pose.heading == pytest.approx(math.tau, abs=5e-3)


def test_encoders_count_whole_steps_and_lose_none() -> None:
    w = walker(time_constant=1e-6)
    for _ in range(1000):
        w.step(Velocity(0.2, 0.1), RELAXED, DT)
        assert w.wheels.left / w.params.encoder_step == pytest.approx(round(w.wheels.left / w.params.encoder_step))
    # 10 s; wheel speeds (0.2 -+ 0.1 * 0.55 / 2) / 0.1
    assert w.wheels.left == pytest.approx(17.25, abs=w.params.encoder_step)
    assert w.wheels.right == pytest.approx(22.75, abs=w.params.encoder_step)


def test_own_odometry_drifts_by_what_the_wheels_slip() -> None:
    def error(slip: float) -> float:
        w = walker(slip=slip)
        for _ in range(4500):
            w.step(Velocity(0.2, 0.0), RELAXED, DT)
        return math.hypot(w.pose.x - w.odometry.x, w.pose.y - w.odometry.y)

    assert error(0.0) < 0.002
    assert 0.005 < error(0.003) < 0.5


def test_gives_way_a_little_to_a_push_while_it_drives_but_not_while_it_stands() -> None:
    driving, standing = walker(), walker()
    for _ in range(200):
        driving.step(Velocity(0.2, 0.0), Arms(5.0, 15.0), DT)  # 20 N forward, 10 N * 0.25 m to the left
        standing.step(STANDSTILL, Arms(40.0, 40.0), DT)
    assert driving.velocity == pytest.approx((0.2 + 20 * 0.0004, 2.5 * 0.03), rel=1e-6)
    assert standing.velocity == STANDSTILL


def test_force_sensors_are_noisy_and_unbiased() -> None:
    w = walker()
    read = np.array([w.measure(Arms(10.0, 20.0)) for _ in range(2000)])
    assert read.mean(axis=0) == pytest.approx([10.0, 20.0], abs=0.1)
    assert read.std(axis=0) == pytest.approx([0.8, 0.8], rel=0.1)
