"""What is looked at in a thread, now and then."""

from __future__ import annotations

import threading

from skytether.orchestrator.runtimes.now_and_then import NowAndThen

PATIENCE = 30


def test_it_is_not_called_oftener_than_it_is_due_and_never_twice_at_once() -> None:
    now = [0.0]
    began, go_on = threading.Semaphore(0), threading.Semaphore(0)
    ended: list[float] = []

    def poll() -> None:
        began.release()
        assert go_on.acquire(timeout=PATIENCE)
        ended.append(now[0])

    looks = NowAndThen("a test", 10.0, lambda: now[0], poll)

    def of_these() -> list[threading.Thread]:
        return [thread for thread in threading.enumerate() if thread.name == "a test"]

    looks.begin()
    assert began.acquire(timeout=PATIENCE)
    now[0] = 20.0
    looks.begin()  # due, but the first is under way
    assert len(of_these()) == 1
    go_on.release()
    for thread in of_these():
        thread.join(PATIENCE)
    looks.begin()
    assert began.acquire(timeout=PATIENCE)
    go_on.release()
    for thread in of_these():
        thread.join(PATIENCE)
    now[0] = 29.0
    looks.begin()  # not due yet
    assert of_these() == []
    assert ended == [20.0, 20.0]
