from __future__ import annotations

import itertools
import logging
import threading
import time

import pytest

from skytether.orchestrator.scheduling.loops import Loop

PATIENCE = 5.0


class Steps:
    """Counts passes; each says when the next is due."""

    def __init__(self, delay: float) -> None:
        self.delay = delay
        self.count = 0
        self.passed = threading.Semaphore(0)

    def __call__(self) -> float:
        self.count += 1
        self.passed.release()
        return self.delay


def test_it_runs_at_once_then_when_woken() -> None:
    steps = Steps(delay=1000)
    loop = Loop("test", steps, time.monotonic)
    assert not loop.wait_first(0)
    loop.start()
    assert loop.wait_first(PATIENCE)
    assert steps.passed.acquire(timeout=PATIENCE)
    loop.wake()
    assert steps.passed.acquire(timeout=PATIENCE)
    loop.stop(PATIENCE)
    assert steps.count == 2


def test_a_wake_during_a_pass_is_not_lost() -> None:
    passes = threading.Semaphore(0)
    numbers = itertools.count(1)
    loop: Loop

    def step() -> float:
        passes.release()
        if next(numbers) < 3:
            loop.wake()
        return 1000

    loop = Loop("test", step, time.monotonic)
    loop.start()
    for _ in range(3):
        assert passes.acquire(timeout=PATIENCE)
    loop.stop(PATIENCE)


def test_a_pass_that_raises_is_logged_and_not_the_last(caplog: pytest.LogCaptureFixture) -> None:
    second = threading.Event()
    count = 0

    def step() -> float:
        nonlocal count
        count += 1
        if count == 1:
            raise ZeroDivisionError("oh")
        second.set()
        return 1000

    loop = Loop("test", step, time.monotonic, after_error_s=0.0)
    loop.start()
    assert second.wait(PATIENCE)
    loop.stop(PATIENCE)
    assert "test: pass failed, trying again" in caplog.text
    assert "ZeroDivisionError: oh" in caplog.text


def test_the_last_pass_is_dated_and_timed(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG)
    times = iter([10.0, 20.0, 30.0])
    loop = Loop("test", Steps(1000), lambda: next(times))
    assert loop.last_pass == 10
    loop.start()
    loop.wait_first(PATIENCE)
    assert loop.last_pass == 30
    loop.stop(PATIENCE)
    assert "test: pass of 10000.00 ms" in caplog.text


def test_stopping_one_that_never_ran_is_no_error() -> None:
    Loop("test", Steps(1), time.monotonic).stop(PATIENCE)
