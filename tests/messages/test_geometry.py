from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skytether.messages import Duration, Quaternion, Time, quaternion_from_yaw, yaw_of


@given(st.floats(-math.pi, math.pi))
def test_yaw_there_and_back(yaw: float) -> None:
    assert math.isclose(math.cos(yaw_of(quaternion_from_yaw(yaw)) - yaw), 1.0)


def test_quarter_turn_left() -> None:
    # Rotation by 90 degrees about z: (0, 0, sin 45, cos 45).
    assert quaternion_from_yaw(math.pi / 2).z == pytest.approx(math.sqrt(0.5))
    assert yaw_of(Quaternion(0, 0, math.sqrt(0.5), math.sqrt(0.5))) == pytest.approx(math.pi / 2)


def test_yaw_of_the_identity_and_of_any_length() -> None:
    assert yaw_of(Quaternion()) == 0
    assert yaw_of(Quaternion(0, 0, 3, 3)) == pytest.approx(math.pi / 2)


def test_yaw_of_a_tilted_robot() -> None:
    # Yaw 0.5 then roll 0.3: q = q_z(0.5) * q_x(0.3).
    cz, sz, cx, sx = math.cos(0.25), math.sin(0.25), math.cos(0.15), math.sin(0.15)
    assert yaw_of(Quaternion(cz * sx, sz * sx, sz * cx, cz * cx)) == pytest.approx(0.5)


@given(st.integers(-(2**31) + 1, 2**31 - 2), st.integers(0, 999_999_999))
def test_time_and_duration_hold_their_nanoseconds(sec: int, nanosec: int) -> None:
    for cls in (Time, Duration):
        value = cls(sec, nanosec)
        back = cls.from_seconds(value.seconds())
        assert 0 <= back.nanosec < 1_000_000_000
        # A float near 2**31 s has steps of 0.5 us.
        assert abs((back.sec - sec) * 1_000_000_000 + back.nanosec - nanosec) <= 500


def test_negative_duration_counts_up_from_the_second_below() -> None:
    assert Duration.from_seconds(-0.5) == Duration(-1, 500_000_000)
    assert Duration(-1, 500_000_000).seconds() == -0.5
    assert Time.from_seconds(0.9999999999) == Time(1, 0)
