from skytether.orchestrator.domain.overload import HOLD, LATE, Overload


class Clock:
    now = 100.0

    def __call__(self) -> float:
        return self.now


def test_a_refusal_is_felt_for_a_while_and_leases_are_owed_once() -> None:
    clock = Clock()
    overload = Overload(clock)
    assert not overload.felt()
    assert not overload.owed()
    overload.note()
    assert overload.felt()
    assert not overload.owed()
    clock.now += HOLD
    assert not overload.felt()
    assert [overload.owed(), overload.owed()] == [True, False]


def test_a_renewal_that_waits_and_a_loop_that_does_not_turn_count_too() -> None:
    clock = Clock()
    overload = Overload(clock)
    with overload.renewing():
        clock.now += LATE
        assert not overload.felt()
        clock.now += 0.1
        assert overload.felt()
    clock.now += HOLD
    assert overload.owed()
    with overload.renewing():
        clock.now += LATE + 0.1  # and nobody asked meanwhile
    assert overload.felt()
    clock.now += HOLD
    assert overload.owed()
    overload.beat()
    clock.now += LATE + 0.1
    assert overload.felt()
    overload.beat()
    for _ in range(5):
        clock.now += LATE
        overload.beat()
    assert not overload.felt()
    assert overload.owed()
    clock.now += LATE + 0.1
    overload.beat()  # late, and nobody asked before it came
    assert overload.felt()
    overload.rest()
    clock.now += 10 * HOLD
    assert not overload.felt()
