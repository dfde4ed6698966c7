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
        ([{1: "/base"}, {1: "/base", 2: ""}], [1]),  # it is not known yet who that is
        ([{1: "/base"}, {1: "/base", 2: ""}, {1: "/base", 2: "/base"}], [1]),  # and now it is: the same, who has heard
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
            [1, 3],
        ),  # nobody knew
        (
            [{1: "/base", 2: "/echo", 3: ""}, {1: "/base", 3: "/new"}, {1: "/base", 3: "/new", 4: "/other"}],
            [0, 2],
        ),  # one goes, one has a name now
    ],
)
def test_who_may_be_back(ways, back):
    comers = Comers()
    assert [number for number, names in enumerate(ways) if comers.is_anybody_back(names)] == back


def test_who_comes_without_a_name_where_all_who_were_there_are_is_nobody_of_them():
    comers = Comers()
    assert not comers.is_anybody_back({1: "/base"})
    assert not comers.is_anybody_back({1: "/base", 2: ""}, all_live=True)
    assert comers.unnamed
    assert not comers.is_anybody_back({2: ""})
    assert comers.is_anybody_back({2: "", 3: ""}, all_live=True), "but one who left"


def test_who_came_without_a_name_is_known_by_it_later():
    comers = Comers()
    comers.is_anybody_back({1: "/base"})
    assert not comers.is_anybody_back({1: "/base", 2: ""}, all_live=True)
    assert comers.is_anybody_back({1: "/base", 2: "/base"}, all_live=True)
    assert not comers.unnamed
    assert not comers.changed


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
        ([{1: "/echo"}, {1: "/echo", 2: ""}, {1: "/echo", 2: "/base"}], [1]),  # it is not known yet who that is
        ([{1: "/base"}, {2: "/base"}, {3: ""}, {3: "/base"}], [0, 1, 2]),  # a subscription made anew at once
        ([{1: "/base", 2: "/echo"}, {1: "/base", 3: "/echo"}], [0]),
    ],
)
def test_where_one_is_awaited_nobody_else_counts(ways, back):
    comers = Comers(["/base"])
    assert [number for number, names in enumerate(ways) if comers.is_anybody_back(names)] == back


def test_who_comes_without_a_name_where_the_one_who_is_awaited_is_alive_is_nobody_new():
    comers = Comers(["/base"])
    assert comers.is_anybody_back({1: ""}, all_live=True), "it may be the one"
    assert not comers.is_anybody_back({1: "/base"}, all_live=True), "and has heard a first word"
    assert not comers.is_anybody_back({1: "/base", 2: ""}, all_live=True)
    assert comers.is_anybody_back({1: "/base", 2: "", 3: ""}, all_live=False), "one who was killed and is back"


def test_of_those_who_left_some_are_known():
    comers = Comers()
    for number in range(2 * MOST):
        comers.is_anybody_back({number: f"/n{number}"})
    comers.is_anybody_back({})
    assert comers.is_anybody_back({-1: "/other"})
