"""Who begins to listen, and may be the wheels' node that was started again."""

import pytest

from skytether.ros.ros2.native.side.comers import MOST, Comers


@pytest.mark.parametrize(
    ("ways", "back"),
    [
        ([[], ["/base"], ["/base", "/echo"], ["/base"]], []),
        ([["/base"], [], ["/base"]], [2]),
        ([["/base"], [], ["/echo"], ["/echo", "/base"], ["/base"], ["/base", "/new"]], [2, 3, 5]),
        ([["/base"], ["/base", "/base"], ["/base"]], [1]),  # killed, and still shown
        ([["/base"], ["/base", ""]], [1]),  # it is not known yet who that is
        ([["/base"], ["/base", ""], ["/base", "/echo"]], [1]),  # and now it is
        ([["/base", "/base"], ["/base"], ["/base", "/base"]], [2]),  # a subscription made anew
        ([["/echo"], ["/echo", ""], ["/echo"], ["/echo", "/base"], ["/echo", "/base", "/new"]], [1, 3]),  # nobody knew
        (
            [["/base", "/echo", ""], ["/base", "/new"], ["/base", "/new", "/other"]],
            [0, 2],
        ),  # one goes, one has a name now
        ([["/base"], ["/base", ""], ["/base", "/base"]], [1, 2]),
    ],
)
def test_who_may_be_back(ways, back):
    comers = Comers()
    assert [number for number, names in enumerate(ways) if comers.is_anybody_back(names)] == back


def test_who_comes_without_a_name_where_all_who_were_there_are_is_nobody_of_them():
    comers = Comers()
    assert not comers.is_anybody_back(["/base"])
    assert not comers.is_anybody_back(["/base", ""], all_live=True)
    assert not comers.is_anybody_back([""])
    assert comers.is_anybody_back(["", ""], all_live=True), "but one who left"


@pytest.mark.parametrize(
    ("ways", "back"),
    [
        ([["/base"], ["/base", "/echo"], ["/base"], ["/base", "/echo"], ["/base", "/new"]], [0]),
        ([["/echo"], ["/echo", "/base"], ["/echo"], ["/echo", "/base"]], [1, 3]),
        ([["/base"], ["/base", "/base"], ["/base"], ["/base", "/base"]], [0, 1, 3]),  # killed, and still shown
        ([["/echo"], ["/echo", ""], ["/echo", "/base"]], [1, 2]),  # it is not known yet who that is
    ],
)
def test_where_one_is_awaited_nobody_else_counts(ways, back):
    comers = Comers(["/base"])
    assert [number for number, names in enumerate(ways) if comers.is_anybody_back(names)] == back


def test_who_comes_without_a_name_where_the_one_who_is_awaited_is_alive_is_nobody_new():
    comers = Comers(["/base"])
    assert comers.is_anybody_back([""], all_live=True), "it may be the one"
    assert comers.is_anybody_back(["/base"], all_live=True)
    assert not comers.is_anybody_back(["/base", ""], all_live=True)
    assert comers.is_anybody_back(["/base", "", ""], all_live=False), "one who was killed and is back"


def test_of_those_who_left_some_are_known():
    comers = Comers()
    for number in range(2 * MOST):
        comers.is_anybody_back([f"/n{number}"])
    comers.is_anybody_back([])
    assert comers.is_anybody_back(["/other"])
