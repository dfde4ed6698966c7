"""The replay window against a set that remembers everything."""

from hypothesis import given
from hypothesis import strategies as st

from skytether.wire.codec.replay_window import ReplayVerdict, ReplayWindow

SIZE = ReplayWindow.SIZE
steps = st.one_of(
    st.integers(-5, 5), st.integers(-SIZE - 5, -SIZE + 5), st.integers(SIZE - 5, SIZE + 5), st.integers(0, 4 * SIZE)
)


@given(st.lists(steps, max_size=80))
def test_it_accepts_each_number_once_and_never_an_old_one(moves):
    window, accepted, highest = ReplayWindow(), set(), -1
    for move in moves:
        number = max(0, highest + move)
        old = number <= highest - SIZE
        expected = ReplayVerdict.OLD if old else ReplayVerdict.ACCEPTED if number in accepted else ReplayVerdict.NEW
        assert window.check(number) is expected
        assert window.accept(number) is (expected is ReplayVerdict.NEW)
        if expected is ReplayVerdict.NEW:
            accepted.add(number)
            highest = max(highest, number)
        assert window.highest == highest


def test_a_jump_over_the_whole_window_forgets_nothing_that_matters():
    window = ReplayWindow()
    for number in range(100):
        window.accept(number)
    window.accept(99 + SIZE)
    assert window.check(99) is ReplayVerdict.OLD
    assert window.check(100) is ReplayVerdict.NEW  # the ring's slots of 0 to 98 were cleared
