from skytether.orchestrator.domain.strain import HOLD, LATE, Strain


class Clock:
    now = 100.0

    def __call__(self) -> float:
        return self.now


def test_a_refusal_is_felt_for_a_while_and_leases_are_owed_once() -> None:
    clock = Clock()
    strain = Strain(clock)
    assert not strain.felt()
    assert not strain.owed()
    strain.note()
    assert strain.felt()
    assert not strain.owed()
    clock.now += HOLD
    assert not strain.felt()
    assert [strain.owed(), strain.owed()] == [True, False]


def test_a_renewal_that_waits_and_a_loop_that_does_not_turn_count_too() -> None:
    clock = Clock()
    strain = Strain(clock)
    with strain.renewing():
        clock.now += LATE
        assert not strain.felt()
        clock.now += 0.1
        assert strain.felt()
    clock.now += HOLD
    assert strain.owed()
    with strain.renewing():
        clock.now += LATE + 0.1  # and nobody asked meanwhile
    assert strain.felt()
    clock.now += HOLD
    assert strain.owed()
    strain.beat()
    clock.now += LATE + 0.1
    assert strain.felt()
    strain.beat()
    for _ in range(5):
        clock.now += LATE
        strain.beat()
    assert not strain.felt()
    assert strain.owed()
    clock.now += LATE + 0.1
    strain.beat()  # late, and nobody asked before it came
    assert strain.felt()
    strain.rest()
    clock.now += 10 * HOLD
    assert not strain.felt()
