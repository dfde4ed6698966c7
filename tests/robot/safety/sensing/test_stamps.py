from math import inf, nan

import pytest

from skytether.robot.safety.sensing.stamps import StampRule, Stamps, date

START = 1_000_000.0
"""The sensor's clock when ours is at zero."""


def stamp(seconds: float) -> tuple[int, int]:
    whole = int(seconds // 1)
    return whole, round((seconds - whole) * 1e9)


class Sensor:
    """Says when it measured; the test says when that came."""

    def __init__(self, rule: StampRule = StampRule.AUTO) -> None:
        self.rule = rule
        self.stamps = Stamps()

    def came(self, now: float, measured: float | None = None, clock: float = START):
        dated = date(self.rule, self.stamps, stamp(clock + (now if measured is None else measured)), now, 0.3)
        self.stamps = dated.stamps
        return dated

    def unstamped(self, now: float):
        dated = date(self.rule, self.stamps, (0, 0), now, 0.3)
        self.stamps = dated.stamps
        return dated


def test_what_comes_later_than_the_quickest_is_that_much_older():
    sensor = Sensor()
    assert sensor.came(10.0).delay == 0
    assert sensor.came(10.1).delay == pytest.approx(0.0, abs=1e-3)
    assert sensor.came(10.35, measured=10.2).delay == pytest.approx(0.15, abs=1e-3)
    assert sensor.came(11.3, measured=10.3).delay == pytest.approx(1.0, abs=1e-3)
    for i in range(600):  # late for a minute: that does not become what is usual
        late = sensor.came(12.0 + i / 10, measured=11.0 + i / 10).delay
    assert late == pytest.approx(1.0, abs=2e-3)
    assert sensor.came(100.0).delay == pytest.approx(0.0, abs=1e-3)


def test_clocks_that_part_as_ntp_lets_them_are_not_late():
    sensor = Sensor()
    for i in range(6000):  # 400 microseconds a second slow, for ten minutes
        late = sensor.came(i / 10, measured=i / 10 * (1 - 4e-4)).delay
    assert late < 0.001


def test_old_scans_that_take_turns_are_not_used():
    sensor = Sensor()
    sensor.came(10.0)
    assert [sensor.came(10.0 + i / 10, measured=9.0 + i % 2 / 10).wrong for i in range(1, 100)] == ["older"] * 99


def test_the_same_scan_again_is_not_used():
    sensor = Sensor()
    sensor.came(10.0)
    assert sensor.came(10.1, measured=10.0).wrong == "repeated"
    assert sensor.came(10.2).wrong == ""


def test_a_clock_that_was_set_back_is_believed_after_a_second_of_even_stamps():
    sensor = Sensor()
    sensor.came(10.0)
    wrongs = [sensor.came(10.0 + i / 10, clock=0.0).wrong for i in range(1, 20)]
    # The first of the even row came at 10.1, and 1 s later, at 11.1, it is believed.
    assert wrongs == ["older"] * 10 + [""] * 9
    assert sensor.came(12.0, clock=0.0).delay == pytest.approx(0.0, abs=1e-3)


def test_old_scans_between_good_ones_are_never_believed():
    sensor = Sensor()
    for i in range(200):
        assert sensor.came(10 + i / 10).wrong == ""
        assert sensor.came(10.05 + i / 10, clock=0.0).wrong == "older"


def test_stamps_that_run_at_another_speed_are_never_believed_again_unless_only_their_order_counts():
    for rule, believed in ((StampRule.AUTO, False), (StampRule.ORDER, True)):
        sensor = Sensor(rule)
        sensor.came(10.0)
        wrongs = {sensor.came(10.0 + i / 2, measured=i * 3.0, clock=0.0).wrong for i in range(1, 40)}
        assert ("" in wrongs) is believed
    sensor = Sensor(StampRule.ORDER)
    assert {sensor.came(i / 10, measured=i / 20).delay for i in range(100)} == {0.0}


def test_one_stamp_far_in_the_future_is_overcome():
    sensor = Sensor()
    sensor.came(10.0)
    sensor.came(10.1, measured=1e6)
    assert sensor.came(10.2).wrong == "older"
    wrongs = [sensor.came(10.2 + i / 10).wrong for i in range(1, 20)]
    assert wrongs[-1] == ""
    assert sensor.came(13.0).delay == pytest.approx(0.0, abs=1e-3)


@pytest.mark.parametrize("bad", [1, 20])
def test_nanoseconds_beyond_a_second_are_overcome(bad):
    """They count as what they are: or stamps in order would have gone back, and good ones come late for ever."""
    sensor = Sensor()
    for i in range(50):
        sensor.came(i / 10)
    for i in range(50, 50 + bad):
        sensor.stamps = date(sensor.rule, sensor.stamps, (int(START + i / 10), 2**32 - 1), i / 10, 0.3).stamps
    begin = 50 + bad
    dated = [sensor.came(i / 10) for i in range(begin, begin + 40)]
    assert all(not one.wrong and one.delay == pytest.approx(0.0, abs=1e-3) for one in dated[12:])


def test_readings_without_stamps():
    sensor = Sensor()
    assert sensor.unstamped(1.0).wrong == ""
    sensor.came(2.0)
    assert sensor.unstamped(3.0).wrong == "unstamped"  # it had one before
    assert Sensor(StampRule.REQUIRED).unstamped(1.0).wrong == "unstamped"


@pytest.mark.parametrize("now", [nan, inf, -inf])
def test_a_clock_of_ours_that_fails_is_overcome(now):
    sensor = Sensor()
    sensor.came(10.0)
    date(sensor.rule, sensor.stamps, stamp(START + 10.1), now, 0.3)
    broken = date(sensor.rule, sensor.stamps, stamp(START + 10.1), now, 0.3)
    sensor.stamps = broken.stamps
    assert not broken.delay <= 0.3
    assert sensor.came(10.2).wrong == ""
    assert sensor.came(10.3).delay == pytest.approx(0.0, abs=1e-2)


def own(before: Stamps, now: float, age: float, wall: float = START):
    return date(StampRule.OWN, before, stamp(wall + now - age), now, 0.3, wall + now)


def test_stamps_of_our_own_clock_tell_the_age_from_the_first():
    stamps = Stamps()
    for i in range(100):  # always late by the same time, and slower than clocks may part
        dated = own(stamps, 10 + i / 10, 0.2 + i * 4e-5)
        stamps = dated.stamps
        assert dated.delay == pytest.approx(0.2 + i * 4e-5, abs=1e-6)
    assert own(stamps, 30.0, -0.01).delay == 0
    assert date(StampRule.AUTO, Stamps(), stamp(START - 0.2), 10.0, 0.3).delay == 0, "of another clock nobody knows"


def test_stamps_of_our_own_clock_that_are_ahead_of_it_or_missing_are_not_used():
    assert own(Stamps(), 10.0, -0.2).wrong == "ahead"
    assert date(StampRule.OWN, Stamps(), (0, 0), 10.0, 0.3, START).wrong == "unstamped"
    assert date(StampRule.OWN, Stamps(), stamp(START), 10.0, 0.3).wrong == "ahead", "our clock is not known"


@pytest.mark.parametrize("by", [3600.0, -3600.0, -0.03])
def test_our_own_clock_that_is_set_is_overcome(by):
    stamps, used = own(Stamps(), 10.0, 0.02).stamps, []
    for i in range(1, 25):
        dated = own(stamps, 10 + i / 10, 0.02, START + by)
        stamps = dated.stamps
        used.append(not dated.wrong and dated.delay == pytest.approx(0.02, abs=1e-3))
    assert all(used) or (by == -3600.0 and not any(used[:9]) and all(used[12:]))
