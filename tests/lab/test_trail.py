import math

import pytest

from skytether.lab.trail import THESIS_TRAIL, Progress, Trail

QUARTER = Trail([{"length": 1.0}, {"radius": 2.0, "angle": math.pi / 2}])  # ends at (3, 2), heading +y


def test_thesis_trail_is_9_m_with_curves_to_both_sides_and_ends_as_it_began() -> None:
    trail = Trail()
    assert trail.length == pytest.approx(9.0)
    assert {math.copysign(1, piece["angle"]) for piece in THESIS_TRAIL if "angle" in piece} == {1, -1}
    assert trail.end.heading == pytest.approx(0.0)
    assert trail.end.y == pytest.approx(0.0, abs=1e-9)  # symmetrical: left 0.75, right 1.5, left 0.75


def test_ends_where_geometry_says() -> None:
    assert QUARTER.length == pytest.approx(1 + math.pi)
    assert QUARTER.end == pytest.approx((3, 2, math.pi / 2), abs=1e-4)
    assert QUARTER.at(0.25) == pytest.approx((0.25, 0, 0))


def test_locates_beside_a_straight_line_and_an_arc() -> None:
    assert QUARTER.locate(0.504, 0.1) == pytest.approx((0.504, 0.1))
    # from the centre (1, 2) at -45 degrees, 2.2 m out: 0.2 m to the right of the arc's middle
    out = 2.2 * math.sqrt(0.5)
    assert QUARTER.locate(1 + out, 2 - out) == pytest.approx((1 + math.pi / 2, -0.2), abs=2e-3)


def test_beyond_an_end_the_distance_is_to_the_end() -> None:
    assert QUARTER.locate(-3.0, 4.0) == pytest.approx((0.0, 5.0))
    assert QUARTER.locate(3.3, 2.4) == pytest.approx((QUARTER.length, -0.5), abs=1e-3)


def test_looks_only_inside_its_window() -> None:
    assert Trail([{"length": 5.0}]).locate(4.0, 0.0, 1.0, 2.0).s == 2.0


def test_progress_never_goes_back_and_never_skips() -> None:
    progress = Progress(Trail([{"length": 5.0}]))
    assert progress.update(0.3, 0.0) == pytest.approx(0.3)
    assert progress.update(0.1, 0.0) == pytest.approx(0.3)
    assert progress.update(4.0, 0.0) < 1.0  # carried over: not passed
    assert progress.update(0.6, 1.5) < 1.0  # too far beside


@pytest.mark.parametrize("segment", [{"radius": 1.0}, {"length": 1.0, "angle": 1.0}, {}])
def test_refuses_what_is_no_segment(segment: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="a segment is"):
        Trail([segment])


@pytest.mark.parametrize(
    "segments",
    [
        [],
        [{"length": 0.0}],
        [{"length": -1.0}],
        [{"length": math.nan}],
        [{"length": math.inf}],
        [{"radius": 1, "angle": 0}],
    ],
)
def test_refuses_what_has_no_length(segments: list[dict[str, float]]) -> None:
    with pytest.raises(ValueError, match=r"trail: (a segment must be longer than 0 m|it needs at least one segment)"):
        Trail(segments)
