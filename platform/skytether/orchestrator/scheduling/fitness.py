"""Which services a site failed to start, and when it is tried again: for every instance, not for the one that failed.

In the memory of the orchestrator that leads, and of the opened site: the next leader, and a site that was opened anew
with other options, learn it again. Pure: time is an argument.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import Any

from ..domain.records import Record

_MOST = 256
"""Services that are remembered of a site, the last ones."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """What is held against a site for one service."""

    service: str
    manifest: Mapping[str, Any]
    """As it was: a changed one is not judged by it."""
    why: str
    """Of the last failure; continues "the service ..."."""
    failures: int
    """In a row; those that were under way together count once."""
    robots: frozenset[str]
    """Whose instances failed: two at most, for of one alone the parameters may be at fault."""
    until: float
    """Steady seconds: not tried before."""
    again_at: float
    """The same as seconds since the epoch, for people."""
    trial: bool = False
    """One instance tries it now; the others wait for what comes of that, until then at most."""

    def holds_for(self, robot: str) -> bool:
        """Whether it holds for a robot's instances; empty: for standbys, which have the parameters of some robot's."""
        return not robot or robot in self.robots or len(self.robots) > 1


class Fitness:
    """Of one site. Safe from any thread."""

    def __init__(self, first_s: float, most_s: float) -> None:
        """``first_s``: seconds without the service after a failure; doubled with each further one up to ``most_s``."""
        self._first_s = first_s
        self._most_s = most_s
        self._lock = threading.Lock()
        self._verdicts: dict[str, Verdict] = {}

    def failed(self, record: Record, why: str, now: float, clock: float) -> None:
        """An instance was not started there, more than once.

        Args:
            record: The instance.
            why: Continues "the service ...".
            now: Steady seconds.
            clock: Seconds since the epoch.
        """
        with self._lock:
            before = self._of(record)
            robots = before.robots if before is not None else frozenset()
            if record.robot and len(robots) < 2:
                robots |= {record.robot}
            if before is not None and now < before.until and not before.trial:
                self._verdicts[record.service] = replace(before, why=why, robots=robots)
                return
            failures = before.failures + 1 if before is not None else 1
            wait = min(self._first_s * 2.0 ** min(failures - 1, 64), self._most_s)
            self._verdicts.pop(record.service, None)
            if len(self._verdicts) >= _MOST:
                del self._verdicts[next(iter(self._verdicts))]
            self._verdicts[record.service] = Verdict(
                record.service, record.manifest, why, failures, robots, now + wait, clock + wait
            )

    def placed(self, record: Record, now: float, clock: float) -> None:
        """An instance is to be started there: if that is due, the only one until its start ends or takes too long."""
        with self._lock:
            verdict = self._of(record)
            if verdict is not None and now >= verdict.until:
                until, again_at = now + self._first_s, clock + self._first_s
                self._verdicts[record.service] = replace(verdict, trial=True, until=until, again_at=again_at)

    def started(self, record: Record) -> None:
        """An instance runs there: the site is fit."""
        with self._lock:
            if self._of(record) is not None:
                del self._verdicts[record.service]

    def forget(self) -> None:
        """Another one led meanwhile, and may know better."""
        with self._lock:
            self._verdicts = {}

    def objection(self, record: Record, now: float) -> str | None:
        """Why an instance is not to be started there now; None: it may be. Its own robot alone learns how it failed."""
        with self._lock:
            verdict = self._of(record)
        if verdict is None or now >= verdict.until or not verdict.holds_for(record.robot):
            return None
        others = record.robot and record.robot not in verdict.robots
        what = "it failed for other robots" if others else f"the service {verdict.why}"
        again = datetime.fromtimestamp(verdict.again_at, UTC)
        return f"cannot start it: {what}; tried again at {again:%H:%M:%S} UTC"

    def verdicts(self, now: float) -> list[Verdict]:
        """Those that hold now, by service."""
        with self._lock:
            held = [verdict for verdict in self._verdicts.values() if now < verdict.until]
        return sorted(held, key=lambda verdict: verdict.service)

    def _of(self, record: Record) -> Verdict | None:
        verdict = self._verdicts.get(record.service)
        return verdict if verdict is not None and verdict.manifest == record.manifest else None
