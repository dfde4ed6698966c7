"""Costs by hand: distances, exponentials and layers of a few cells."""

import math

import numpy as np
import pytest

from skytether_services.navigation.costmap import (
    FREE,
    INSCRIBED,
    LETHAL,
    UNKNOWN,
    Costmap,
    InflationParams,
    combine,
    cost_of_distance,
    inflate,
    inflation_table,
    shifted,
    static_costs,
    window,
)
from skytether_services.navigation.footprint import Footprint
from skytether_services.navigation.layers import LayeredCostmap, WindowParams
from skytether_services.navigation.zones import Mask, keep_out_costs, speed_limit
from skytether_services.planar.geometry import Pose, advance, wrap


def grid(rows: int, columns: int, value: int = FREE) -> np.ndarray:
    return np.full((rows, columns), value, dtype=np.uint8)


def test_static_costs_are_lethal_free_or_unknown() -> None:
    cells = np.array([[-1, 0, 64, 65, 100]], dtype=np.int8)
    assert static_costs(cells).tolist() == [[UNKNOWN, FREE, FREE, LETHAL, LETHAL]]


def test_combined_layers_cost_the_larger_and_unknown_says_nothing() -> None:
    below = np.array([[UNKNOWN, UNKNOWN, FREE, LETHAL, LETHAL, 7]], dtype=np.uint8)
    above = np.array([[UNKNOWN, FREE, LETHAL, FREE, UNKNOWN, 9]], dtype=np.uint8)
    assert combine(below, above).tolist() == [[UNKNOWN, FREE, LETHAL, LETHAL, LETHAL, 9]]


def test_costs_fall_exponentially_beyond_the_inscribed_radius() -> None:
    # 0.25 m beyond the inscribed radius at 4/m: 252 exp(-1) = 92.7, cut to 92.
    assert cost_of_distance(0.0, 0.25, 4.0) == LETHAL
    assert cost_of_distance(0.25, 0.25, 4.0) == INSCRIBED
    assert cost_of_distance(0.5, 0.25, 4.0) == 92


def test_inflation_goes_by_exact_distances() -> None:
    costs = grid(21, 21)
    costs[10, 10] = LETHAL
    params = InflationParams(radius=0.5, decay=4.0)
    inflated = inflate(costs, inflation_table(0.1, 0.2, params))
    for row in range(21):
        for column in range(21):
            distance = math.hypot(row - 10, column - 10) * 0.1
            expected = cost_of_distance(distance, 0.2, 4.0) if distance <= 0.5 + 1e-9 else FREE
            # 0.2 m are two cells: there the sum of tenths may be a hair above.
            assert inflated[row, column] == (
                INSCRIBED if (row - 10) ** 2 + (column - 10) ** 2 in (1, 2, 4) else expected
            )


def test_inflation_keeps_the_unknown_where_the_centre_may_be() -> None:
    costs = grid(1, 5, UNKNOWN)
    costs[0, 0] = LETHAL
    table = inflation_table(0.1, 0.2, InflationParams(radius=0.5))
    assert inflate(costs, table).tolist() == [[LETHAL, INSCRIBED, INSCRIBED, UNKNOWN, UNKNOWN]]
    assert inflate(grid(2, 2), table).tolist() == [[FREE, FREE], [FREE, FREE]]


def test_a_window_lies_on_the_cells_of_the_map() -> None:
    costs = np.arange(100, dtype=np.uint8).reshape(10, 10)
    part = window(Costmap(costs, 0.5, (-1.0, -2.0)), 0.3, -1.9, 2.0, 1.0)
    # (0.3 + 1) / 0.5 = column 2, less half of four cells: from column 0; row 0, less half of two.
    assert part.origin == (-1.0, -2.5)
    assert part.costs.tolist() == [[UNKNOWN] * 4, [0, 1, 2, 3]]
    assert part.at(-0.9, -1.9) == 0
    assert part.at(math.nan, 0.0) == UNKNOWN
    assert part.cell(5.0, 0.0) is None
    assert part.center(1, 0) == (-0.75, -1.75)


def test_a_shifted_layer_keeps_its_places() -> None:
    costs = np.arange(9, dtype=np.uint8).reshape(3, 3)
    assert shifted(costs, 1, 0).tolist() == [[3, 4, 5], [6, 7, 8], [UNKNOWN] * 3]
    assert shifted(costs, 0, -1).tolist() == [[UNKNOWN, 0, 1], [UNKNOWN, 3, 4], [UNKNOWN, 6, 7]]
    assert (shifted(costs, 3, 0) == UNKNOWN).all()


def test_the_whole_robot_keeps_out_of_a_zone() -> None:
    mask = Mask(np.array([[0, 100], [-1, 50]], dtype=np.int8), 0.2, (0.1, 0.0))
    static = Costmap(grid(4, 6), 0.1)
    zones = keep_out_costs(mask, static)
    assert zones[0].tolist() == [UNKNOWN, UNKNOWN, UNKNOWN, LETHAL, LETHAL, UNKNOWN]
    assert zones[2].tolist() == [UNKNOWN, UNKNOWN, UNKNOWN, 127, 127, UNKNOWN]
    layered = LayeredCostmap(static, Footprint(radius=0.1, padding=0.0), keep_out=mask)
    assert layered.update(Pose(0.0, 0.0, 0.0)).costs[0, 2] == INSCRIBED


def test_a_speed_zone_limits_in_percent() -> None:
    mask = Mask(np.array([[0, 40, -1]], dtype=np.int8), 1.0)
    assert [speed_limit(mask, x, 0.5, 0.5) for x in (0.5, 1.5, 2.5, 9.0)] == [0.5, 0.2, 0.5, 0.5]


def test_a_rolling_window_follows_the_robot_with_its_marks() -> None:
    costs = grid(100, 100)
    costs[:, 60] = LETHAL
    layered = LayeredCostmap(Costmap(costs, 0.1), Footprint(radius=0.2, padding=0.0), rolling=WindowParams(4.0, 4.0))
    first = layered.update(Pose(5.0, 5.0, 0.0))
    assert first.at(6.05, 5.0) == LETHAL
    layered.marks[first.cell(4.05, 5.05)] = LETHAL
    moved = layered.update(Pose(5.5, 4.8, 0.0))
    assert moved.at(4.05, 5.05) == LETHAL
    assert moved.at(6.05, 5.0) == LETHAL
    # Where the robot stands there is nothing else.
    assert layered.update(Pose(4.1, 5.0, 0.0)).at(4.05, 5.05) == FREE
    layered.update(Pose(math.nan, 0.0, 0.0))
    layered.clear()
    assert (layered.marks == UNKNOWN).all()


def test_an_inflation_within_the_footprint_is_refused() -> None:
    with pytest.raises(ValueError, match=r"at least the footprint's circumscribed radius, 0\.520 m"):
        LayeredCostmap(Costmap(grid(2, 2), 0.1), Footprint(radius=0.5), inflation=InflationParams(radius=0.4))


def test_circles_of_a_footprint() -> None:
    box = Footprint(corners=((0.4, 0.3), (-0.4, 0.3), (-0.4, -0.3), (0.4, -0.3)), padding=0.0)
    assert box.inscribed == pytest.approx(0.3)
    assert box.circumscribed == pytest.approx(0.5)
    padded = Footprint(corners=box.corners, padding=0.03)
    assert padded.inscribed == pytest.approx(0.33)
    assert padded.circumscribed == pytest.approx(0.55)
    samples = box.samples(0.05)
    assert abs(samples).max(axis=0).tolist() == pytest.approx([0.4, 0.3])
    assert Footprint(radius=0.3, padding=0.01).circumscribed == pytest.approx(0.31)
    assert len(Footprint().samples(0.05)) == 0


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"radius": 0.0}, "radius must be above 0"),
        ({"padding": -1.0}, "padding must be 0 or above"),
        ({"corners": ((0.0, 1.0), (1.0, 0.0))}, "at least 3"),
        ({"corners": ((1.0, 1.0), (2.0, 1.0), (2.0, 2.0))}, "centre inside"),
        ({"corners": ((1.0, 1.0), (-1.0, 1.0), (0.0, 0.9), (-1.0, -1.0), (1.0, -1.0))}, "convex"),
        ({"corners": ((1.0, math.nan), (-1.0, 1.0), (-1.0, -1.0))}, "not finite"),
    ],
)
def test_what_is_no_footprint_is_refused(fields: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Footprint(**fields)


def test_poses_advance_on_arcs() -> None:
    # A quarter of a circle of 1 m to the left ends at (1, 1).
    assert advance(Pose(0.0, 0.0, 0.0), 1.0, 1.0, math.pi / 2) == pytest.approx((1.0, 1.0, math.pi / 2))
    assert advance(Pose(1.0, 2.0, math.pi / 2), 0.5, 0.0, 2.0) == pytest.approx((1.0, 3.0, math.pi / 2))
    assert wrap(1.5 * math.pi) == pytest.approx(-0.5 * math.pi)
