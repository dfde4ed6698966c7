from skytether.orchestrator.domain.rate_limit import _BUCKETS, RateLimiter


class Clock:
    """Seconds that pass when told to."""

    def __init__(self, now: float = 0.0) -> None:
        self.now = now

    def __call__(self) -> float:
        return self.now

    def advance(self, seconds: float) -> None:
        self.now += seconds


def test_a_burst_then_the_rate_and_each_caller_alone() -> None:
    clock = Clock()
    limiter = RateLimiter(rate=10, burst=3, clock=clock)
    assert [limiter.wait("a") for _ in range(3)] == [0, 0, 0]
    assert limiter.wait("a") == 0.1
    assert limiter.wait("b") == 0
    clock.advance(0.1)
    assert limiter.wait("a") == 0
    assert limiter.wait("a") > 0
    clock.advance(100)
    assert [limiter.wait("a") > 0 for _ in range(4)] == [False, False, False, True]


def test_a_clock_that_jumps_back_gives_nothing() -> None:
    clock = Clock(100)
    limiter = RateLimiter(rate=10, burst=1, clock=clock)
    assert limiter.wait("a") == 0
    clock.advance(-50)
    assert limiter.wait("a") > 0


def test_a_large_request_counts_as_several_and_looking_takes_nothing() -> None:
    clock = Clock()
    limiter = RateLimiter(rate=10, burst=4, clock=clock)
    assert [limiter.empty("a") for _ in range(9)] == [0.0] * 9
    assert limiter.wait("a") == 0
    limiter.charge("a", 5)  # 3 were left
    assert limiter.empty("a") == limiter.wait("a") == 0.3
    limiter.charge("a", 1000)
    assert limiter.empty("a") == 0.5  # at most a burst late
    clock.advance(0.5)
    assert limiter.empty("a") == limiter.wait("a") == 0
    assert limiter.wait("b") == 0


def test_callers_are_bounded_in_number() -> None:
    clock = Clock()
    limiter = RateLimiter(rate=0.001, burst=1, clock=clock)
    for n in range(_BUCKETS + 10):
        limiter.wait(str(n))
    assert limiter.wait(str(_BUCKETS)) > 0
    assert limiter.wait("0") == 0, "it was quiet for the longest, and begins anew"
