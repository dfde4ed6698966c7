"""CLEAR MOT, by hand: each expected number is counted in a comment."""

from __future__ import annotations

import pytest

from skytether.lab.clear_mot import Score, clear_mot

HERE, THERE, AWAY = (1.0, 0.0), (3.0, 0.0), (9.0, 9.0)


def test_all_found_by_the_same_tracks_is_the_best_score() -> None:
    frames = [{1: HERE, 2: THERE}] * 3
    score = clear_mot([{7: HERE, 8: THERE}] * 3, frames)
    assert score == Score(truths=6, switches=0, misses=0, false_positives=0, motp_m=0.0)
    assert score.mota == 1.0


def test_misses_and_false_positives_are_counted_and_distances_are_of_matches_only() -> None:
    # First: one found 0.3 m off, one not; a track that is nobody's. Second: both found, 0 and 0.1 m off.
    found = [{7: (1.3, 0.0), 9: AWAY}, {7: HERE, 8: (3.1, 0.0)}]
    score = clear_mot(found, [{1: HERE, 2: THERE}] * 2)
    assert (score.truths, score.switches, score.misses, score.false_positives) == (4, 0, 1, 1)
    assert score.motp_m == pytest.approx((0.3 + 0.0 + 0.1) / 3)
    assert score.mota == pytest.approx(1 - 2 / 4)


def test_no_match_beyond_the_bound() -> None:
    score = clear_mot([{7: (1.76, 0.0)}], [{1: HERE}])
    assert (score.misses, score.false_positives, score.motp_m) == (1, 1, None)
    assert clear_mot([{7: (1.76, 0.0)}], [{1: HERE}], match=0.8).misses == 0


def test_a_match_stays_though_another_track_comes_nearer() -> None:
    found = [{7: (1.2, 0.0)}, {7: (1.2, 0.0), 8: HERE}]
    score = clear_mot(found, [{1: HERE}] * 2)
    assert (score.switches, score.false_positives) == (0, 1)


def test_a_person_under_a_new_number_is_a_switch_even_after_a_gap() -> None:
    found = [{7: HERE}, {}, {8: HERE}, {8: HERE}]
    score = clear_mot(found, [{1: HERE}] * 4)
    assert (score.switches, score.misses) == (1, 1)


def test_two_who_change_their_numbers_are_two_switches() -> None:
    score = clear_mot([{7: HERE, 8: THERE}, {8: HERE, 7: THERE}], [{1: HERE, 2: THERE}] * 2)
    assert (score.switches, score.misses, score.false_positives) == (2, 0, 0)


def test_with_nobody_to_find_there_is_no_score() -> None:
    assert clear_mot([{}, {3: HERE}], [{}, {}]).mota is None
    assert clear_mot([], []) == Score(0, 0, 0, 0, None)
    with pytest.raises(ValueError, match="zip"):
        clear_mot([{}], [])
