"""What robots tell each other as text: read as it was written, and harmless whatever somebody sends."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skytether_services.navigation.costmap import FREE, LETHAL, Costmap
from skytether_services.navigation.shared_word import (
    MOST_CELLS,
    MOST_ROBOTS,
    MOST_TEXT,
    Said,
    Unheard,
    Word,
    map_id,
    read_said,
    read_word,
    write_word,
)
from skytether_services.planar.geometry import Pose

SQUARE = np.array([[0.3, 0.2], [-0.3, 0.2], [-0.3, -0.2], [0.3, -0.2]])
SHAPE = (100, 200)


def word(cells: list[list[int]], ages: list[float]) -> Word:
    return Word(Pose(1.0, 2.0, 0.5), SQUARE, np.array(cells, dtype=np.intp).reshape(-1, 2), np.array(ages))


def document(**changes: Any) -> str:
    whole: dict[str, Any] = json.loads(write_word("m", word([[3, 4]], [1.5])))
    whole.update(changes)
    return json.dumps(whole)


def test_a_word_is_read_as_it_was_written() -> None:
    read = read_word(write_word("m", word([[3, 4], [5, 199]], [1.5, 0.0])), "m", SHAPE)
    assert isinstance(read, Word)
    assert read.pose == Pose(1.0, 2.0, 0.5)
    assert read.outline == pytest.approx(SQUARE)
    # The newest come first.
    assert read.cells.tolist() == [[5, 199], [3, 4]]
    assert read.ages.tolist() == [0.0, 1.5]


def test_the_longest_word_fits_and_has_the_newest_cells() -> None:
    many = word([[9999, 9999 - n] for n in range(2 * MOST_CELLS)], [600.0 - n / 10 for n in range(2 * MOST_CELLS)])
    text = write_word("0" * 32, many)
    assert len(text) <= MOST_TEXT
    read = read_word(text, "0" * 32, (10_000, 10_000))
    assert isinstance(read, Word)
    assert len(read.cells) == MOST_CELLS
    assert read.ages.max() <= 600.0 - MOST_CELLS / 10


def test_a_word_of_another_map_is_of_no_use() -> None:
    assert read_word(document(), "n", SHAPE) is Unheard.OTHER_MAP


def test_cells_off_the_map_are_left_out() -> None:
    text = document(cells=[[3, 4, 0], [100, 4, 0], [3, 200, 0], [-1, 4, 0], [3, 4, -1]])
    read = read_word(text, "m", SHAPE)
    assert isinstance(read, Word)
    assert read.cells.tolist() == [[3, 4]]


@pytest.mark.parametrize(
    "text",
    [
        "",
        "nonsense",
        "[" * 5000,
        "[]",
        '{"format": 2}',
        document(pose=[1, 2]),
        document(pose=[1, 2, float("nan")]),
        document(pose=[1, 2, 10**400]),
        document(pose=[[1, 2, 3]]),
        document(pose="123"),
        document(outline=[]),
        document(outline=[[0, 1], [1, 0]]),
        document(outline=[[0, 1], [1, 0], [3, 0]]),
        document(outline=[[0, 1], [1, 0], [1]]),
        document(outline=[[0, 1, 1], [1, 0, 1], [1, 1, 1]]),
        document(outline=[[0.1, 0.1]] * 17),
        document(cells=[[1, 2]]),
        document(cells=[[1, 2, True]]),
        document(cells=[[1, 2, [3]]]),
        document(cells=[1, 2, 3]),
        document(cells=[[1, 2, 3]] * (MOST_CELLS + 1)),
        document(cells={"a": 1}),
        document(more="x" * MOST_TEXT),
    ],
)
def test_what_is_no_word_is_unreadable(text: str) -> None:
    assert read_word(text, "m", SHAPE) is Unheard.BROKEN


_JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=5,
)


@given(value=_JSON)
def test_nothing_that_somebody_makes_up_raises(value: Any) -> None:
    for key in ("pose", "outline", "cells"):
        read = read_word(document(**{key: value}), "m", SHAPE)
        assert read is Unheard.BROKEN or isinstance(read, Word)
    read_said(json.dumps([value, {"robot": value, "age_s": value, "text": value}]))


def test_what_the_agent_brings_is_bounded() -> None:
    one = {"robot": "a", "age_s": 1, "text": "t"}
    assert read_said(json.dumps([one, 3, {**one, "age_s": -1}, {**one, "age_s": True}, {"robot": "b"}])) == [
        Said("a", 1.0, "t")
    ]
    assert len(read_said(json.dumps([one] * 100))) == MOST_ROBOTS
    assert read_said("x") == read_said("{}") == read_said(json.dumps([one]) + " " * 3 * MOST_ROBOTS * MOST_TEXT) == []


def test_a_map_is_known_by_what_it_shows() -> None:
    costs = np.full(SHAPE, FREE, dtype=np.uint8)
    other = costs.copy()
    other[5, 5] = LETHAL
    same = map_id(Costmap(costs, 0.05))
    assert same == map_id(Costmap(costs.copy(), float(np.float32(0.05)))), "a message's resolution is a float32"
    assert (
        len({same, map_id(Costmap(other, 0.05)), map_id(Costmap(costs, 0.1)), map_id(Costmap(costs, 0.05, (1, 0)))})
        == 4
    )
