from random import Random

from skytether.robot.offload.backoff import Backoff


def test_backoff_doubles_up_to_its_most_with_jitter_and_starts_anew():
    backoff = Backoff(0.2, 1.0, Random(1))
    for most in [0.2, 0.4, 0.8, 1.0, 1.0]:
        assert most / 2 <= backoff.next() <= most
    backoff.reset()
    assert backoff.next() <= 0.2


def test_backoff_differs_between_robots():
    assert Backoff(1, 1, Random(1)).next() != Backoff(1, 1, Random(2)).next()
