from __future__ import annotations

from collections.abc import Callable

import pytest

from skytether.messages import Float64, encode
from skytether.service import Input, NoParams, Service, ServiceError
from skytether.service.clock import SystemClock
from skytether.service.loop import Loop
from skytether.service.port import ServicePort
from skytether.testing.service import FakeClock
from skytether.wire.events import Connected, Disconnected, MessageReceived
from skytether.wire.topic import Direction, Topic

VALUE = Topic("value", Float64.TYPE, Direction.IN)


class Bench:
    """A loop around a service that notes its steps and takes as long as it is told to."""

    def __init__(self, *, rate: float | None = None, trigger: str | None = None, idle_exit: float = 1e9) -> None:
        clock = self.clock = FakeClock(0.0)
        steps = self.steps = []
        durations = self.durations = []
        bench = self
        self.during: Callable[[], None] = lambda: None
        step_trigger = trigger

        class Noting(Service[NoParams]):
            rate_hz = rate
            value = Input(Float64)
            trigger = step_trigger

            def step(self, now: float) -> None:
                steps.append((now, self.value.latest.message.data) if self.value.latest else now)
                clock.advance(durations.pop(0) if durations else 0.0)
                bench.during()

        self.service = Noting(NoParams())
        self.port = ServicePort(self.service, clock.wake)
        self.loop = Loop(self.service, self.port, clock, idle_exit)

    def message_at(self, when: float, value: float | bytes) -> None:
        payload = value if isinstance(value, bytes) else encode(Float64(value))
        self.clock.at(when, lambda: self.port.deliver(MessageReceived("value", payload, 0, when, 0.0, when)))

    def run(self, until: float) -> None:
        self.clock.at(until, self.loop.stop)
        self.loop.run()


def test_steps_stay_on_absolute_times() -> None:
    bench = Bench(rate=100)
    bench.durations[:] = [0.003, 0.009, 0.0001] * 40
    bench.run(until=0.9999)
    assert bench.steps == pytest.approx([i / 100 for i in range(100)])
    assert bench.loop.steps == 100
    assert bench.loop.skipped == 0


def test_a_step_a_little_too_long_delays_the_next_and_no_other() -> None:
    bench = Bench(rate=100)
    bench.durations[:] = [0.0, 0.014]
    bench.run(until=0.0499)
    assert bench.steps == pytest.approx([0.0, 0.01, 0.024, 0.03, 0.04])
    assert bench.loop.skipped == 0


def test_missed_steps_are_skipped_counted_and_logged_once(caplog: pytest.LogCaptureFixture) -> None:
    bench = Bench(rate=100)
    bench.durations[:] = [0.0, 0.035, 0.0, 0.025]
    bench.run(until=0.0999)
    # Busy from 10 to 45 ms: 20 and 30 are missed, 40 comes late. Busy from 50 to 75 ms: 60 is missed, 70 comes late.
    assert bench.steps == pytest.approx([0.0, 0.01, 0.045, 0.05, 0.075, 0.08, 0.09])
    assert bench.loop.skipped == 3
    warnings = [r.getMessage() for r in caplog.records]
    assert warnings == [
        "late by 2 steps of 10 ms, skipped them; more of these are counted, not logged",
        "7 steps done, 3 skipped",
    ]


def test_stop_ends_after_the_current_step() -> None:
    bench = Bench(rate=10)
    bench.durations[:] = [0.05]
    bench.run(until=0.02)
    assert bench.steps == [0.0]


def test_triggered_steps_come_with_each_message() -> None:
    bench = Bench(trigger="value")
    bench.port.notify(Connected((VALUE,)))
    for when, value in [(0.1, 1.0), (0.25, 2.0), (0.3, 3.0)]:
        bench.message_at(when, value)
    bench.run(until=1.0)
    assert bench.steps == [(0.1, 1.0), (0.25, 2.0), (0.3, 3.0)]


def test_messages_during_a_triggered_step_make_one_more_with_the_newest() -> None:
    bench = Bench(trigger="value")
    bench.port.notify(Connected((VALUE,)))
    bench.durations[:] = [0.5]
    for when, value in [(0.1, 1.0), (0.2, 2.0), (0.3, 3.0)]:
        bench.message_at(when, value)
    bench.run(until=1.0)
    assert bench.steps == [(0.1, 1.0), (0.6, 3.0)]


def test_an_undecodable_message_triggers_nothing() -> None:
    bench = Bench(trigger="value")
    bench.port.notify(Connected((VALUE,)))
    bench.message_at(0.1, 1.0)
    bench.message_at(0.2, b"junk")
    bench.run(until=1.0)
    assert bench.steps == [(0.1, 1.0)]
    assert bench.service.value.undecodable == 1


@pytest.mark.parametrize("kind", [{"rate": 10}, {"trigger": "value"}])
def test_without_a_robot_the_loop_ends_by_itself(kind) -> None:
    bench = Bench(**kind, idle_exit=5.0)
    bench.loop.run()
    assert bench.clock.now() == pytest.approx(5.0, abs=0.1)


@pytest.mark.parametrize("kind", [{"rate": 10}, {"trigger": "value"}])
def test_idle_counts_from_when_the_robot_left(kind) -> None:
    bench = Bench(**kind, idle_exit=5.0)
    bench.clock.at(3.0, lambda: bench.port.notify(Connected((VALUE,))))
    bench.clock.at(20.0, lambda: bench.port.notify(Disconnected("silent")))
    bench.clock.at(24.0, lambda: bench.port.notify(Connected((VALUE,))))
    bench.clock.at(30.0, lambda: bench.port.notify(Disconnected("goodbye")))
    bench.loop.run()
    assert bench.clock.now() == pytest.approx(35.0, abs=0.11)


def test_what_a_step_raises_comes_out() -> None:
    bench = Bench(rate=10)

    def fail() -> None:
        raise ZeroDivisionError

    bench.durations[:] = [0.1]
    bench.clock.at(0.05, fail)
    with pytest.raises(ZeroDivisionError):
        bench.loop.run()


@pytest.mark.parametrize("kind", [{}, {"rate": 10, "trigger": "value"}, {"rate": 0}, {"rate": float("inf")}])
def test_rate_or_trigger_and_a_real_rate(kind) -> None:
    with pytest.raises(ServiceError, match="rate_hz"):
        Bench(**kind).loop.run()


def test_refusals_are_logged_once_each(caplog: pytest.LogCaptureFixture) -> None:
    from skytether.wire.events import Refused

    bench = Bench(rate=10)
    for reason in ("topic a: no", "topic a: no", "topic b: no"):
        bench.port.notify(Refused(reason))
    assert [r.getMessage() for r in caplog.records] == ["robot refused: topic a: no", "robot refused: topic b: no"]


def test_the_real_clock_sleeps_until_its_time_or_a_wake() -> None:
    clock = SystemClock()
    try:
        begin = clock.now()
        clock.sleep_until(begin + 0.02)
        assert clock.now() >= begin + 0.02
        clock.wake()
        clock.wake()
        begin = clock.now()
        clock.sleep_until(begin + 10)
        assert clock.now() < begin + 5
        begin = clock.now()
        clock.sleep_until(begin + 0.01)
        assert clock.now() >= begin + 0.01, "two wakes before one sleep end one sleep"
        clock.sleep_until(begin - 1)
    finally:
        clock.close()


def test_it_tells_how_long_a_step_takes() -> None:
    bench = Bench(rate=10.0)
    assert bench.loop.in_step_for() == 0.0
    told: list[float] = []
    bench.during = lambda: told.append(bench.loop.in_step_for())
    bench.durations.append(0.03)
    bench.run(0.05)
    assert told == [0.03]
    assert bench.loop.in_step_for() == 0.0
