"""Gives running instances the cores and memory that they are to have, and finds out how much that is by their load.

What an instance is to have is in its record, whoever wanted it (``Record.resize``). Whoever leads has its site do it,
and notes that it has it: a leader that is killed in between leaves the next one to ask again, which changes nothing
more.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field

from skytether.api.rest import Size, State

from ..domain.records import Record
from ..domain.transitions import not_resized, noted, resized, resizing
from ..runtimes.base import Observation, OvertakenError, Phase, RuntimeFailure, SiteSilentError
from ..store.store import Store
from ..telemetry.metrics import Metrics
from .placer import Placer
from .site import Site
from .successors import Successors
from .vertical_scaling import InstanceSample, Proposal, Trend, bounded, decide, more_memory

log = logging.getLogger(__name__)

_ACTING_S = 0.5
"""For which a pass over a site does this, at most: what is left has its turn in the next one."""
_PATIENCE_S = 60.0
"""A site that has not done it by then does not do it."""
_HOLD_S = 5.0
"""Between two looks whether it still has that."""
_AGAIN_S = 60.0
"""After a size that could not be had, none is asked for so long because of an instance's load."""


@dataclass
class _Known:
    """Of one instance, by whoever leads; the next leader learns it anew."""

    site: str
    trend: Trend | None = None
    asked_since: float = math.inf
    """Since when its site is at the present change."""
    not_before: float = -math.inf
    held_at: float = -math.inf
    told: set[str] = field(default_factory=set)
    """Why it gets no more, without the numbers, as it was told since it last had another size."""


class Resizing:
    """Safe from any thread, as long as each site is of one."""

    def __init__(
        self,
        store: Store,
        metrics: Metrics,
        successors: Successors,
        placer: Placer,
        left: Callable[[str], Size],
        steady: Callable[[], float],
    ) -> None:
        """What it needs of others.

        Args:
            store: Where records are.
            metrics: Told of each change.
            successors: Start another one where a site does not give it.
            placer: Knows what a site has beside what it has promised; told of each record that holds more or less.
            left: What a robot may have beside what it has.
            steady: Seconds of a clock that nobody sets.
        """
        self._store = store
        self._metrics = metrics
        self._successors = successors
        self._placer = placer
        self._left = left
        self._steady = steady
        self._known: dict[str, _Known] = {}

    def keep(self, site: Site, live: Iterable[Record], looked: Mapping[str, Observation], now: float) -> None:
        """Have the site give its running instances what they are to have.

        Args:
            site: The site.
            live: What has not ended there.
            looked: What its runtime reports.
            now: Seconds since the epoch.
        """
        until, records = self._steady() + _ACTING_S, list(live)
        there = {record.id for record in records}
        for gone in [i for i, known in list(self._known.items()) if known.site == site.name and i not in there]:
            del self._known[gone]
        try:
            for record in records:
                seen = looked.get(record.id)
                if record.state is State.RUNNING and seen is not None and _is_it(record, seen):
                    self._keep(site, record, seen, now)
                if self._steady() >= until:
                    return
        except (SiteSilentError, OvertakenError) as error:
            log.warning("site %s: %s", site.name, error)  # the next pass, or whoever leads, asks again

    def larger(self, site: Site, record: Record) -> Size | None:
        """What the next run has of one that ran out of memory; None: the same, for there is no more for it."""
        scaling, has = record.spec.needs.scaling, record.has
        if scaling is None or scaling.memory_mb is None:
            return None
        wanted = more_memory(scaling.memory_mb, has)
        wanted = bounded(bounded(wanted, has, self._left(record.robot)), has, self._placer.room(site))
        return wanted if wanted.memory_mb > has.memory_mb else None

    def _keep(self, site: Site, record: Record, seen: Observation, now: float) -> None:
        follows = record.spec.needs.scaling is not None and not record.standby
        if record.resize is None and record.size is None and not follows:
            return  # as almost all
        known = self._known.setdefault(record.id, _Known(site.name))
        if record.resize is not None:
            self._carry_out(site, record, known, now)
            return
        if record.size is not None:
            self._hold(site, record, known)
        if follows:
            self._follow(site, record, seen, known, now)

    def _carry_out(self, site: Site, record: Record, known: _Known, now: float) -> None:
        wants = record.wants
        if wants is None or record.resize is None:
            return
        known.asked_since = min(known.asked_since, self._steady())
        try:
            done = site.runtime.resize(record.id, record.attempt, record.sized(wants))
            if not done and self._steady() - known.asked_since > _PATIENCE_S:
                raise RuntimeFailure(f"it has not done so for {_PATIENCE_S:g} s")
        except (SiteSilentError, OvertakenError):
            raise
        except RuntimeFailure as error:
            self._give_up(site, record, wants, str(error), known, now)
            return
        if not done:
            return
        has = record.has
        text = "" if wants == has else f"has {wants} instead of {has}: {record.resize['why']}"
        after = self._store.change(resized(record, wants, text), now)
        if after is None:
            return
        known.asked_since = math.inf
        known.told.clear()
        self._placer.hold(after)
        if text:
            log.info("%s for %s (%s) %s", record.service, record.robot, record.id, text)
            self._metrics.resized(record, has, wants, record.resize["reason"])

    def _give_up(self, site: Site, record: Record, wants: Size, why: str, known: _Known, now: float) -> None:
        """It is moved to where it can have that; otherwise it keeps what it has."""
        try:
            site.runtime.resize(record.id, record.attempt, record.spec)  # nothing is left half changed
        except (SiteSilentError, OvertakenError):
            raise
        except RuntimeFailure as error:
            log.info("site %s: %s", site.name, error)
        known.asked_since, known.not_before = math.inf, self._steady() + _AGAIN_S
        text, moved = f"site {site.name} does not give it {wants}: {why}", None
        if _is_more(wants, record.has):
            moved, text = self._successors.move_for_size(record, wants, text)
        text = text if moved else f"{text}; it keeps {record.has}"
        after = self._store.change(not_resized(record, text), now)
        self._metrics.not_resized(record)
        if after is not None:
            log.warning("%s for %s (%s): %s", record.service, record.robot, record.id, text)
            self._placer.hold(after)

    def _hold(self, site: Site, record: Record, known: _Known) -> None:
        """Whoever else has changed it, or did so late: it has what it is noted to have."""
        if self._steady() - known.held_at < _HOLD_S or site.runtime.keeps_size(record.spec):
            return
        known.held_at = self._steady()
        try:
            site.runtime.resize(record.id, record.attempt, record.spec)
        except (SiteSilentError, OvertakenError):
            raise
        except RuntimeFailure as error:
            log.warning("site %s: %s does not have %s: %s", site.name, record.id, record.has, error)

    def _follow(self, site: Site, record: Record, seen: Observation, known: _Known, now: float) -> None:
        scaling, has = record.spec.needs.scaling, record.has
        if scaling is None:
            return
        what = InstanceSample(seen.cpu_s, seen.memory_bytes, seen.step_s, record.attempt)
        known.trend, proposed = decide(scaling, has, known.trend, what, self._steady())
        if proposed is None or self._steady() < known.not_before:
            return
        size, keeps = proposed.size, site.runtime.keeps_size(record.spec)
        if _is_more(size, has):
            left = bounded(size, has, self._left(record.robot))
            if not _is_more(left, has):
                self._log_once(record, f"would get {size}, for {proposed.why}: its robot may have no more", known, now)
                return
            size = left if keeps else bounded(left, has, self._placer.room(site))
            if keeps or not _is_more(size, has):
                self._move(site, record, left, proposed, keeps, known, now)
                return
        elif keeps:
            return  # it has more than it needs, and to be moved for that is not worth it
        asked = self._store.change(resizing(record, size, proposed.reason, proposed.why), now)
        if asked is not None:
            self._placer.hold(asked)
            self._carry_out(site, asked, known, now)

    def _move(
        self, site: Site, record: Record, size: Size, proposed: Proposal, keeps: str, known: _Known, now: float
    ) -> None:
        known.not_before = self._steady() + _AGAIN_S
        why = f"is to have {size}, for {proposed.why}, and site {site.name} has no room for that"
        if keeps:
            why = f"is to have {size}, for {proposed.why}, and at site {site.name} {keeps}"
        moved, text = self._successors.move_for_size(record, size, why)
        if moved is None:
            self._metrics.not_resized(record)
        self._log_once(record, text, known, now)

    def _log_once(self, record: Record, text: str, known: _Known, now: float) -> None:
        without_numbers = "".join(c for c in text if not c.isdigit())
        if without_numbers not in known.told and self._store.change(noted(record, text), now) is not None:
            known.told.add(without_numbers)
            log.warning("%s for %s (%s) %s", record.service, record.robot, record.id, text)


def _is_it(record: Record, seen: Observation) -> bool:
    return seen.phase is Phase.RUNNING and seen.attempt == record.attempt


def _is_more(size: Size, than: Size) -> bool:
    return size.cpu > than.cpu or size.memory_mb > than.memory_mb
