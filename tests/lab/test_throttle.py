"""A program that is stopped whenever it has had its share of the processor."""

import _thread
import os
import subprocess
import sys
import threading
import time

import psutil
import pytest

from skytether.lab.throttle import Budget, Throttle, children_of, cpu_time, native_threads_time


def test_a_budget_flows_in_evenly_and_is_spent_in_bursts() -> None:
    budget = Budget(cores=0.25, period_s=0.1)
    # A period's 25 ms are there at the start; a tick of 10 ms brings 2.5 ms more, of which no more than 25 ms are kept.
    assert budget.spend(0.01, 0.01)
    assert budget.spend(0.01, 0.01)
    assert budget.spend(0.01, 0.0099)
    assert not budget.spend(0.01, 0.01)
    spent, went, went_ticks = 0.0, False, 0
    for _ in range(1000):  # 10 s, in which whoever may go on uses the whole tick
        used = 0.01 if went else 0.0
        spent += used
        went = budget.spend(0.01, used)
        went_ticks += went
    assert spent == pytest.approx(2.5, abs=0.05)
    assert went_ticks == pytest.approx(250, abs=5)


def test_what_is_saved_has_an_end() -> None:
    budget = Budget(cores=0.25, period_s=0.1)
    assert budget.spend(60.0, 0.0)
    assert not budget.spend(0.0, 0.025)


def test_no_share_is_refused() -> None:
    with pytest.raises(ValueError, match="greater than 0"):
        Budget(0.0)


def test_the_time_of_a_process_that_is_gone_is_none() -> None:
    child = subprocess.Popen([sys.executable, "-c", ""])
    child.wait()
    assert cpu_time(child.pid) == 0.0
    assert cpu_time(os.getpid()) > 0.0
    assert children_of(child.pid) == []


@pytest.mark.slow
def test_a_busy_program_gets_its_share_and_goes_on_afterwards() -> None:
    busy = subprocess.Popen([sys.executable, "-c", "while True: pass"])
    try:
        with Throttle(0.1, lambda: [busy.pid]) as throttle:
            time.sleep(0.5)  # what it had saved, and until it was found
            before, began = cpu_time(busy.pid), time.monotonic()
            time.sleep(3.0)
            share = (cpu_time(busy.pid) - before) / (time.monotonic() - began)
        assert share < 0.15
        assert throttle.stopped_s > 0.0
        assert psutil.Process(busy.pid).status() != psutil.STATUS_STOPPED
    finally:
        busy.kill()
        busy.wait()


def test_only_threads_that_are_not_pythons_count_as_native() -> None:
    spun, over = threading.Semaphore(0), threading.Event()

    def spin() -> None:
        end = time.thread_time() + 0.05
        while time.thread_time() < end:
            pass
        spun.release()
        over.wait()

    before = native_threads_time()
    thread = threading.Thread(target=spin)
    thread.start()
    assert spun.acquire(timeout=10)
    between = native_threads_time()
    assert between - before < 0.03
    _thread.start_new_thread(spin, ())  # none that `threading` knows, as a library's is none
    assert spun.acquire(timeout=10)
    assert native_threads_time() - between == pytest.approx(0.05, abs=0.03)
    over.set()
    thread.join()
