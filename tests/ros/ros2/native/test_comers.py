"""Who begins to listen, and may be the wheels' node that was started again."""

import pytest

from skytether.ros.ros2.native.side.comers import MOST, Comers


@pytest.mark.parametrize(
    ("ways", "back"),
    [
        ([{}, {1: "/base"}, {1: "/base", 2: "/echo"}, {1: "/base"}], []),
        ([{1: "/base"}, {}, {2: "/base"}], [2]),
        (
            [
                {1: "/base"},
                {},
                {2: "/echo"},
                {2: "/echo", 3: "/base"},
                {3: "/base"},
                {3: "/base", 4: "/new"},
            ],
            [2, 3, 5],
        ),
        ([{1: "/base"}, {1: "/base", 2: "/base"}, {2: "/base"}], [1]),  # killed, and still shown
        ([{1: "/base"}, {1: "/base", 2: ""}, {1: "/base", 2: "/base"}], [2]),  # it was not known yet who that is
        ([{1: "/base", 2: "/base"}, {2: "/base"}, {2: "/base", 3: "/base"}], [2]),  # a subscription made anew
        ([{1: "/base"}, {2: "/base"}], [1]),  # at once
        ([{1: "/base", 2: "/echo"}, {2: "/echo", 3: ""}, {2: "/echo", 3: "/base"}], [1]),
        (
            [
                {1: "/echo"},
                {1: "/echo", 2: ""},
                {1: "/echo"},
                {1: "/echo", 3: "/base"},
                {1: "/echo", 3: "/base", 4: "/new"},
            ],
            [3],
        ),  # nobody knew
        (
            [{1: "/base", 2: "/echo", 3: ""}, {1: "/base", 3: "/new"}, {1: "/base", 3: "/new", 4: "/other"}],
            [2],
        ),  # one goes, one has a name now
    ],
)
def test_who_may_be_back(ways, back):
    comers = Comers()
    assert [number for number, names in enumerate(ways) if comers.is_anybody_back(names)] == back


def test_whoever_comes_while_it_is_young_may_be_back():
    """It is in the place of one that was killed, and finds the wheels later than a recorder."""
    comers = Comers()
    comers.is_anybody_back({1: "/echo"}, young=True)
    assert not comers.is_anybody_back({1: "/echo"}, young=True)
    assert comers.is_anybody_back({1: "/echo", 2: "/base"}, young=True)
    assert comers.is_anybody_back({1: "/echo", 2: "/base", 3: ""}, young=True)
    assert not comers.doubtful
    assert not comers.is_anybody_back({1: "/echo", 2: "/base", 3: "", 4: "/new"})
    named = Comers(["/base"])
    assert not named.is_anybody_back({1: "/echo"}, young=True)


def test_who_comes_without_a_name_may_be_anybody_until_that_is_known():
    comers = Comers()
    comers.is_anybody_back({1: "/base"})
    assert not comers.is_anybody_back({1: "/base", 2: ""})
    assert comers.doubtful
    assert not comers.is_anybody_back({1: "/base", 2: ""})
    assert comers.doubtful
    assert not comers.changed
    assert not comers.is_anybody_back({1: "/base", 2: "/echo"})
    assert not comers.doubtful
    comers.is_anybody_back({1: "/base", 2: "/echo", 3: ""})
    comers.settle()
    assert not comers.is_anybody_back({1: "/base", 2: "/echo", 3: "/base"}), "he has heard a first word"


def test_who_comes_after_somebody_left_may_be_he_whatever_his_name():
    comers = Comers()
    comers.is_anybody_back({1: "/base", 2: "/echo"})
    comers.is_anybody_back({2: "/echo"})
    assert comers.is_anybody_back({2: "/echo", 3: ""})
    assert not comers.doubtful


@pytest.mark.parametrize(
    ("ways", "back"),
    [
        (
            [
                {1: "/base"},
                {1: "/base", 2: "/echo"},
                {1: "/base"},
                {1: "/base", 3: "/echo"},
                {1: "/base", 4: "/new"},
            ],
            [0],
        ),
        ([{1: "/echo"}, {1: "/echo", 2: "/base"}, {1: "/echo"}, {1: "/echo", 3: "/base"}], [1, 3]),
        ([{1: "/base"}, {1: "/base", 2: "/base"}, {2: "/base"}, {2: "/base", 3: "/base"}], [0, 1, 3]),  # killed
        ([{1: "/echo"}, {1: "/echo", 2: ""}, {1: "/echo", 2: "/base"}], [2]),  # it was not known yet
        ([{1: "/base"}, {2: "/base"}, {3: ""}, {3: "/base"}], [0, 1, 3]),  # a subscription made anew at once
        ([{1: "/base", 2: "/echo"}, {1: "/base", 3: "/echo"}], [0]),
    ],
)
def test_where_one_is_awaited_nobody_else_counts(ways, back):
    comers = Comers(["/base"])
    assert [number for number, names in enumerate(ways) if comers.is_anybody_back(names)] == back


def test_of_those_who_left_some_are_known():
    comers = Comers()
    for number in range(2 * MOST):
        comers.is_anybody_back({number: f"/n{number}"})
    comers.is_anybody_back({})
    assert comers.is_anybody_back({-1: "/other"})
