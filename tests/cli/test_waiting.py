from __future__ import annotations

from datetime import UTC, datetime

from skytether.api.pull_progress import PullProgress
from skytether.api.rest import InstanceEvent, State
from skytether.cli.waiting import Lines

NOW = datetime(2026, 1, 1, tzinfo=UTC)


def test_without_a_terminal_each_step_is_a_line_and_each_tenth_of_a_pull() -> None:
    def pull(done: int, *, unpacking: bool = False) -> PullProgress:
        return PullProgress(image="x:1", unpacking=unpacking, done_bytes=done * 1_000_000, total_bytes=200_000_000)

    pulls = [PullProgress(image="x:1"), *map(pull, range(0, 200, 5)), pull(0, unpacking=True), pull(1, unpacking=True)]
    told = [
        (State.PENDING, "waiting for a site: edge: it is full"),
        (State.PENDING, "waiting for a site: edge: it is full"),
        *((State.STARTING, one) for one in pulls),
        (State.STARTING, ""),
        (State.RUNNING, ""),
    ]
    lines = Lines()
    events = (
        InstanceEvent(id=i, instance="i1", at=NOW, state=s, reason=str(r), pull=None if isinstance(r, str) else r)
        for i, (s, r) in enumerate(told)
    )
    assert list(filter(None, map(lines.line, events))) == [
        "i1: pending: waiting for a site: edge: it is full",
        "i1: starting: pulling x:1",
        *(f"i1: starting: pulling x:1: {done} of 200 MB" for done in range(0, 200, 20)),
        "i1: starting: unpacking x:1: 0 of 200 MB",
        "i1: starting",
        "i1: running",
    ]
