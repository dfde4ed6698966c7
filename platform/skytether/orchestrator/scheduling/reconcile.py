"""Carries out what ``plan`` decides: the placer for what has no site yet, and one pass per site for what is there."""

from __future__ import annotations

import base64
import logging
import math
import sys
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence, Set
from dataclasses import replace
from itertools import zip_longest
from typing import Any

from skytether.api.grant import Grant
from skytether.api.rest import Measurement, Refusal, Size, State

from ..access.disk_usage import DiskUsage
from ..config.settings import Limits, Timing, Weights
from ..domain.clock_jump import ClockJump
from ..domain.counter_totals import of_instance, of_run
from ..domain.overload import Overload
from ..domain.records import Change, Record
from ..domain.security import SecretFileError, Secrets
from ..runtimes.base import Capacity, Launch, Observation, OvertakenError, Phase, RuntimeFailure, SiteSilentError
from ..store.engine import GONE
from ..store.leader import ALONE, Lead, LeadLostError, fence, fenced
from ..store.store import Store
from ..telemetry.metrics import Metrics
from ..telemetry.service_events import ServiceEvents
from .moves import Moves, told
from .placement import UNSTARTED, Decision, Prospect, believable, lacks, place
from .plan import Action, Crash, End, Expire, Place, Progress, Ready, Remove, Start, Stop, after_crash, plan
from .promises import NOTHING, Promises, Sums
from .resizing import Resizing
from .sites import Site, Sites

log = logging.getLogger(__name__)

_TRIES = 2
"""Failures in a row, the last of them to start at all, until another site is tried: one may be an accident."""
_TIDY = 1.0
"""Seconds between two calls of a runtime's ``tidy``."""
_WHOLE = 1.0
"""Seconds between two whole passes over a site: within this, leases that ran out are seen, and what other orchestrators
over the same database did."""
_SPARE_IDLE = 86_400.0
"""Seconds that a standby waits for a robot before it ends by itself, should the orchestrator be gone for good."""
_UNSETTLED = 2.0
"""Seconds after the clock was set in which another orchestrator may still date leases by what it was before."""
_PRUNE = 60.0
"""Seconds between two looks for what is too old to keep."""
_ACTING = 0.5
"""Seconds for which a pass over a site acts, at most: of a crowd some are ready before the last ones are started."""
_PLACED_AT_ONCE = 16
"""Instances that get their sites in one transaction: each takes a server's disk, and keeps others from writing."""
_BALKS = 5
"""Acts in a row that a site did not answer, after which a pass asks it for nothing more: nor would it answer that."""
_SHARE = 0.1
"""Of the time, at most, for which each loop looks at all instances again and again: of many thousands, less often."""
_PLENTY = Size(cpu=1e9, memory_mb=1_000_000_000)
_PROMISES_AGE = 3.0
"""Seconds for which sums are good enough for a request at an orchestrator that does not lead."""


def _none_grows(_: Record) -> Sequence[Prospect]:
    return ()


class Reconciler:
    """Makes what is what should be, while this orchestrator leads; otherwise it looks only.

    ``sites`` and ``moves`` are set before the first pass: each needs the other.
    """

    sites: Sites
    moves: Moves
    prospects: Callable[[Record], Sequence[Prospect]] = staticmethod(_none_grows)
    """What groups of sites could still do for an instance that no site takes."""

    def __init__(
        self,
        store: Store,
        secrets: Secrets,
        metrics: Metrics,
        timing: Timing,
        limits: Limits,
        weights: Weights,
        clock: Callable[[], float],
        wake_placer: Callable[[], None],
        lead: Lead = ALONE,
        steady: Callable[[], float] = time.monotonic,
        overload: Overload | None = None,
        site_instances: int = sys.maxsize,
        disk_usage: DiskUsage | None = None,
        left: Callable[[str], Size] = lambda _: _PLENTY,
    ) -> None:
        """``clock`` gives seconds since the epoch, ``steady`` those of a clock that nobody sets.

        While ``overload`` is felt no lease runs out. A site gets no more than ``site_instances``, and
        nothing more where ``disk_usage`` says that it is full. ``left``: what a robot may have beside what it has.
        """
        self._resizing = Resizing(store, metrics, lambda: self.moves, self._room, left, self.note, steady)
        self._site_instances = site_instances
        self._disk_usage = disk_usage
        self._overload = overload or Overload(steady)
        self._service_events = ServiceEvents(store, steady)
        self._store = store
        self._secrets = secrets
        self._metrics = metrics
        self._timing = timing
        self._limits = limits
        self._weights = weights
        self._clock = clock
        self._wake_placer = wake_placer
        self._lead = lead
        self._steady = steady
        self._clock_lock = threading.Lock()
        self._clock_jump = ClockJump(clock(), steady())
        self._times_set = 0
        """How often the clock was set: what was read before the last time is dated by another one."""
        self._settles_at = -math.inf
        """Steady seconds: leases that others dated until then count anew, and none runs out before."""
        self._place_due = -math.inf
        """Steady seconds: when the placer's next whole pass is due."""
        self._promises = Promises()
        """As of the last whole pass of the placer, and what this orchestrator has changed since."""
        self._promises_until = -math.inf
        """Steady seconds."""
        self._pruned_at = -_PRUNE
        self._database_gone = False
        self._owes_leases = False

    def owe_leases(self) -> None:
        """Before anything is ended for its lease, all count anew: nobody may have led, and nobody could renew."""
        self._owes_leases = True

    def place_turn(self) -> float:
        """As much of a pass of the placer as is due: woken between two whole ones, it places what waits only."""
        due = self._place_due - self._steady()
        if due <= 0:
            return self.place_step()
        return min(due, self.place_step(whole=False))

    def place_step(self, *, whole: bool = True) -> float:
        """One pass of the placer; returns seconds until the next."""
        return self._with_database(lambda: self._place_pass(whole))

    def site_turn(self, site: Site) -> float:
        """As much of a pass over a site as is due; returns seconds until the next.

        All of it once a second. In between, all that is there is looked at by its period, and what starts or stops more
        often; as long as the runtime finds it as it was, and nobody called, the database is not asked.
        """
        now = self._steady()
        if now < site.rests_until:
            return site.rests_until - now
        due = site.passed_at + _rest(_WHOLE, site.pass_took) - now
        look = site.watched_at + _rest(self._timing.observe, site.look_took) - now
        if called := site.called:
            site.called = False  # before the look, and only what was seen: no call is lost
        if due > 0 >= look:
            began = time.thread_time()
            as_it_was = _all_as_it_was(site)
            site.watched_at, site.look_took = now, time.thread_time() - began
        if due <= 0 or (look <= 0 and not as_it_was):
            return self.site_step(site)
        if look <= 0:
            look = self._timing.observe
            called |= bool(site.awaited)  # how long it has been so may matter by now
        if called or not _as_it_was(site):
            return min(due, look, self.site_step(site, whole=False))
        return min(due, look, self._timing.observe_changing) if site.awaited else min(due, look)

    def site_step(self, site: Site, *, whole: bool = True) -> float:
        """One pass over a site, or over what starts or stops there; returns seconds until the next."""
        began = time.monotonic()
        delay = self._with_database(lambda: self._site_pass(site, whole))
        self._metrics.reconciled(site.name, time.monotonic() - began)
        return delay

    def _with_database(self, step: Callable[[], float]) -> float:
        """Wait where the database does not answer; once it does, leases count anew: nobody could renew meanwhile."""
        try:
            with fenced(self._lead.epoch):
                if self._database_gone and self._leads():
                    self._store.extend_leases(self._clock())
                    log.warning("the database answers again")
                delay = step()
            self._database_gone = False
            return delay
        except LeadLostError as error:
            log.warning("%s", error)
            return self._timing.place
        except GONE as error:
            if not self._database_gone:
                log.error(
                    "the database does not answer, trying again: %s",
                    str(getattr(error, "orig", None) or error).splitlines()[0],
                )
            self._database_gone = True
            return self._timing.place

    def _leads(self) -> bool:
        """Whether this pass acts: it may have begun before this orchestrator led, or for an earlier lead of its own."""
        return self._lead.leads and self._lead.epoch == fence()

    def _now(self) -> float:
        """The time. Was the clock set, all leases count anew first: nobody can say how old they are."""
        with self._clock_lock:
            now, steady = self._clock(), self._steady()
            by = self._clock_jump.set_by(now, steady)
            if by:
                if self._leads():
                    self._store.extend_leases(now)
                self.moves.clock_was_set()
                self._times_set += 1
                self._settles_at = steady + _UNSETTLED
                text = "the clock was set %s by %.0f s, or this machine slept: leases and waits count anew"
                log.warning(text, "forward" if by > 0 else "back", abs(by))
            if -math.inf < self._settles_at <= steady:
                self._settles_at = -math.inf
                if self._leads():
                    self._store.extend_leases(now)  # what is about to end has another version then
            if self._owes_leases and self._leads():
                self._owes_leases = False  # first: it may be owed again meanwhile
                self._store.extend_leases(now)
                self._times_set += 1
            if self._overload.owed() and self._leads():
                self._store.extend_leases(now)
                self._times_set += 1
                log.warning("robots could not renew for a while, for want of room or of time: leases count anew")
            self._clock_jump.accept(now, steady)
            return now

    # What has no site yet

    def _place_pass(self, whole: bool) -> float:
        if whole:
            self.sites.refresh()
        if not self._leads():
            self._place_due = -math.inf  # who leads next, or again, begins with a look at all
            return self._timing.place
        began, times_set = time.thread_time(), self._times_set
        live = self._store.live() if whole else self._store.waiting()
        now = self._now()
        if times_set != self._times_set:
            return 0.0  # what was read is dated by another clock
        if whole:
            self._promise_anew(live)
            rest = _rest(self._timing.place, time.thread_time() - began)
            self._give_up_siteless([record for record in live if record.site is not None], now)
        chosen: list[Change] = []
        for action in plan([record for record in live if record.site is None], {}, (), now, self._timing):
            if isinstance(action, Place):
                chosen += self._choose(action.record)
                if len(chosen) >= _PLACED_AT_ONCE:
                    self._place(chosen)
                    chosen = []
            elif isinstance(action, Expire):
                self._expire(action.record)
        self._place(chosen)
        if whole or self.moves.warms:
            self.moves.keep_spares()
        if not whole:
            return self._timing.place
        self.sites.end_drained(
            {name for name, sum_ in self._promises.sums().items() if sum_.instances}, self._metrics.forget_site
        )
        self.moves.watch(live)
        if self._steady() - self._pruned_at >= _PRUNE:
            self._pruned_at = self._steady()
            self._prune(now)
        self._place_due = self._steady() + rest
        return rest

    def _promise_anew(self, live: Iterable[Record]) -> None:
        self._promises = Promises(live)
        self._promises_until = self._steady() + _PROMISES_AGE

    def promised(self, without: Iterable[Record] = ()) -> Sums:
        """What sites have promised, to all but these and what they are about to end.

        As whoever leads knows it, at others some seconds old at most.
        """
        if not self._lead.leads and self._steady() >= self._promises_until:  # only the placer replaces what it adds to
            self._promise_anew(self._store.live())
        return self._promises.sums({record.id for record in without} | self._leaving())

    def note(self, record: Record) -> None:
        """It holds more or less at its site than before; the next whole pass of the placer knows it anyway."""
        self._promises.add(record)

    def _room(self, site: Site) -> Size:
        capacity, promised = site.capacity or Capacity(0.0, 0), self.promised().get(site.name, NOTHING)
        return Size(cpu=capacity.cpu - promised.cpu, memory_mb=capacity.memory_mb - promised.memory_mb)

    def lacks(self, record: Record, size: Size) -> str:
        """Why an instance cannot have this at its site, beside all that is stored; empty: it can."""
        site = self.sites.find(record.site)
        if site is None:
            return f"site '{record.site}' was deleted"
        promised = Promises(self._store.live()).sums(self._leaving() | {record.id})
        used = promised.get(site.name, NOTHING).capacity
        found = lacks(record.sized(size).needs, site.capacity or Capacity(0.0, 0), used)
        return "" if found is None else found[1]

    def _give_up_siteless(self, placed: Sequence[Record], now: float) -> None:
        """End what was placed at a site in the moment when that was deleted: nobody else looks at it ever again."""
        missing = [record for record in placed if self.sites.find(record.site) is None]
        there = {site.name for site in self._store.sites()} if missing else set()  # those here may just be opened anew
        for record in missing:
            if record.site not in there:
                to = State.STOPPED if record.state is State.STOPPING else State.FAILED
                self._store.change(record, now, state=to, reason=f"site '{record.site}' was deleted: ask again")

    def weigh(self, record: Record, promised: Sums | None = None, runs: bool = False) -> Decision:
        """Where it would run now, beside what is promised; looks only. ``runs``: it need not be started any more.

        Without ``promised``, beside all that is stored.
        """
        if promised is None:
            promised = Promises(self._store.live()).sums(self._leaving())
        measured = {site: Measurement.model_validate(m) for site, m in record.measurements.items()}
        allowed = [site for site in self.sites.all() if self._allows(record, site)]
        tried = {refusal["site"]: refusal["detail"] for refusal in record.refused if refusal["reason"] == UNSTARTED}
        now = self._steady()
        sites = [
            site.candidate(
                record.spec,
                promised.get(site.name, NOTHING).capacity,
                tried.get(site.name),
                None if record.pinned else site.fitness.objection(record, now),
            )
            for site in allowed
        ]
        most = self._site_instances
        if self._disk_usage is not None:
            full = self._disk_usage.full()
            sites = [replace(s, full=full[s.name]) if s.name in full else s for s in sites]
        sites = [
            replace(s, full=f"{there} instances are there, and {most} may be (quotas.site_instances)")
            if (there := promised.get(s.name, NOTHING).instances) >= most
            else s
            for s in sites
        ]
        if runs:
            sites = [replace(site, blocked=None, unfit=None) for site in sites]
        spec = record.spec
        decision = place(spec.needs, measured, sites, image=spec.image, weights=self._weights)
        if decision.site is not None or record.pinned is not None or record.spare:
            return decision
        prospects = self.prospects(record)
        return replace(
            decision,
            refused=(*decision.refused, *(prospect.refusal for prospect in prospects)),
            hopeless=decision.hopeless and all(prospect.hopeless for prospect in prospects),
        )

    def _allows(self, record: Record, site: Site) -> bool:
        """One that replaces another does not go where that is.

        Unless it was told to, or that one is ended there, or it is there for being larger or smaller.
        """
        if record.pinned is not None:
            return site.name == record.pinned
        replaced = self._store.get(record.replaces) if record.replaces else None
        if replaced is None or site.name != replaced.site or replaced.id in site.leaving:
            return True
        return record.has != replaced.has

    def _leaving(self) -> set[str]:
        """What sites are about to end: it takes no room of what they have left."""
        return {instance for site in self.sites.all() for instance in site.leaving}

    def _waits(self, record: Record) -> bool:
        """Whether its time to start is still to come; a wait longer than the longest was another clock's."""
        return 0 < record.start_at - self._clock() <= self._timing.backoff_max

    def _choose(self, record: Record) -> list[Change]:
        """How an instance gets a site, which is promised to it from then on; nothing: none takes it now."""
        promised = self.promised()
        decision = self.weigh(record, promised)
        untried = [refusal for refusal in record.refused if refusal["reason"] != UNSTARTED]
        if decision.site is None and len(untried) < len(record.refused) and not self._waits(record):
            decision = self.weigh(replace(record, refused=untried), promised)  # it may have been mended
        smaller, happened = {}, ""
        if decision.site is None and record.size is not None and record.replaces is None:
            as_its_manifest_says = self.weigh(replace(record, size=None), promised)
            if as_its_manifest_says.site is not None:
                has, gets = record.has, replace(record, size=None).has
                smaller, happened = {"size": None}, f"has {gets} instead of {has}: {told(record, decision.refused)}"
                decision = as_its_manifest_says
        refused = [refusal.model_dump() for refusal in decision.refused]
        if refused != record.refused:
            self._metrics.refused(record.service, decision.refused)
        if decision.site is None:
            reason = f"waiting for a site: {told(record, decision.refused)}"
            if reason != record.reason or record.state is not State.PENDING:
                self._store.change(record, self._clock(), state=State.PENDING, reason=reason, refused=refused)
            return []
        changes = {
            "state": State.STARTING,
            "reason": "",
            "site": decision.site,
            "refused": refused,
            "scores": [score.model_dump() for score in decision.scores],
            "start_at": 0.0,
            **smaller,
        }
        self._promises.add(record.after(changes))
        if (site := self.sites.find(decision.site)) is not None:
            site.fitness.placed(record, self._steady(), self._clock())
        return [Change(record, changes, State.PLACING if record.state is State.PENDING else None, happened)]

    def _place(self, chosen: Sequence[Change]) -> None:
        """Give instances the sites that were chosen for them, unless somebody changed them meanwhile."""
        if not chosen:
            return
        now, placed = self._clock(), list[Record | None]()
        try:
            placed = self._store.change_all(chosen, now)
        finally:
            for one, record in zip_longest(chosen, placed):
                if record is None:
                    self._promises.remove(one.record)
        for record in filter(None, placed):
            self._metrics.phase(record, "placing", now - record.created_at)
        for name in {record.site for record in placed if record is not None}:
            if (site := self.sites.find(name)) is not None:
                site.wake()

    def _prune(self, now: float) -> None:
        limits = self._limits
        for instance, name in self._store.prune(now, limits.ended_age, limits.ended_count, limits.events):
            site = self.sites.find(name)
            if site is not None:
                site.ended -= {instance}  # the site's next whole pass finds it as a stranger, and removes it

    # What is at a site

    def _site_pass(self, site: Site, whole: bool) -> float:
        began, times_set = time.thread_time(), self._times_set
        site.awaited = None  # whatever ends this pass early, or is left to do
        if whole:
            site.passed_at = -math.inf
        led = self._lead.epoch if self._leads() else 0
        # Before the look: nothing can be observed that is not in it.
        live = self._store.live_at(site.name, changing=not whole)
        if whole:
            before = self._store.robots_at(site.name) if site.hosted is None else site.hosted
            site.hosted = before | {record.robot for record in live}
        try:
            if led and site.led != led:
                site.runtime.lead(led)
                site.led, site.ended, site.seen_since = led, frozenset(), None
                site.fitness.forget()
            due = whole and time.monotonic() - site.tidied_at >= _TIDY
            if site.capacity is None or due:
                site.capacity = believable(site.runtime.capacity())  # nodes come and go
            ids = {record.id for record in live}
            if whole:
                site.runtime.expect(len(ids))
            looked = site.runtime.observe() if whole else site.runtime.look_at(ids)
            if due:
                site.load = site.runtime.load()
        except RuntimeFailure as error:
            if isinstance(error, OvertakenError) and error.epoch > self._clock():  # of no leader of this time
                self._lead.rise_above(error.epoch)
            if str(error) != site.failure:
                log.warning("site %s: %s", site.name, error)
            site.failure = str(error)
            site.capacity = site.load = None  # it may come back as another machine
            site.seen_since = None
            site.passed_at = -math.inf
            return self._timing.place
        if self._leads():
            for record, seen in _ended(live, site.observed, looked):
                self._store.count(record, [of_run(record, seen)])
        others = {} if whole else {i: seen for i, seen in site.observed.items() if i not in ids}
        site.observed, site.failure, site.looked_at = {**others, **looked}, "", time.monotonic()
        site.leaving = {i: seen.leaving for i, seen in site.observed.items() if seen.leaving}
        if not self._leads():
            return self._timing.observe
        now = self._now()
        if times_set != self._times_set:
            return 0.0  # what was read is dated by another clock
        if site.seen_since is None or site.seen_since[0] != times_set:
            site.seen_since = (times_set, now)
        if whole:
            site.ended = self._ended_of(looked.keys() - ids, frozenset() if due else site.ended)
        looked = self._bounded(site, live, looked) if whole else looked
        live = self._service_events.keep(live, looked, now)
        actions = plan(live, looked, site.ended, now, self._timing, site.seen_since[1])
        if whole:
            site.pass_took = time.thread_time() - began
        done = self._act_on(site, actions)
        if whole and not site.balks:
            self._resizing.keep(site, live, looked, now)
        if due:
            site.tidied_at = time.monotonic()
            try:
                site.runtime.tidy()
            except RuntimeFailure as error:
                log.warning("site %s: %s", site.name, error)
        if site.balks:
            return self._timing.place  # it is not asked again and again what it does not do
        changing = {record.id for record in live if record.state in (State.STARTING, State.STOPPING)}
        changing -= {action.record.id for action in done if isinstance(action, Ready | End)}
        if len(done) == len(actions):
            site.awaited = changing
            if whole:
                site.passed_at = site.watched_at = self._steady()
        return self._timing.observe_changing if actions or changing else self._timing.observe

    def _bounded(
        self, site: Site, live: Sequence[Record], looked: Mapping[str, Observation]
    ) -> Mapping[str, Observation]:
        """What was seen, with those marked that belong to a robot with too much data."""
        if self._disk_usage is None:
            return looked
        too_much = self._disk_usage.too_much(site.name)
        marked = {
            r.id: replace(looked[r.id], exceeds=too_much[r.robot])
            for r in live
            if r.id in looked and r.robot in too_much
        }
        return {**looked, **marked}

    def _ended_of(self, strangers: Set[str], ended: frozenset[str]) -> frozenset[str]:
        """Those that have ended of what is at a site and not expected there; of some that is known already."""
        unknown = strangers - ended
        return frozenset(strangers & ended | (self._store.known(unknown) if unknown else set()))

    def _act_on(self, site: Site, actions: Sequence[Action]) -> list[Action]:
        """Those that were done; of very many the last ones wait for a pass that looks at the first ones again."""
        until, done, in_a_row, balked = self._steady() + _ACTING, [], 0, False
        if site.balks:  # those that it never does do not always come first
            first = _BALKS * site.balks % max(1, len(actions))
            actions = [*actions[first:], *actions[:first]]
        for action in actions:
            if in_a_row >= _BALKS and isinstance(action, Start | Stop | End | Remove):
                continue
            try:
                if self._act(site, action):
                    done.append(action)
                in_a_row = 0
            except RuntimeFailure as error:
                # The next pass sees what is still to be done.
                log.warning("site %s: %s", site.name, error)
                if isinstance(error, SiteSilentError | OvertakenError):
                    balked, in_a_row = True, in_a_row + 1
                    if in_a_row >= _BALKS:
                        site.rests_until = self._steady() + self._timing.place
            if self._steady() >= until:
                break
        site.balks = site.balks + 1 if balked else 0
        return done

    def _act(self, site: Site, action: Action) -> bool:
        """Do it; False: the next pass has to see what comes of it. Raises RuntimeFailure: it has to try again."""
        match action:
            case Start(record):
                self._start(site, record)
            case Progress(record, detail):
                self._store.change(record, self._clock(), reason=detail, started_at=self._clock())
            case Ready(record, host, port):
                return self._ready(site, record, host, port)
            case Crash():
                self._crash(site, action)
            case Expire(record):
                self._expire(record)
            case End(record):
                site.runtime.stop(record.id, force=True)  # what its main process left behind
                if self._store.change(record, self._clock(), state=State.STOPPED):
                    self._promises.remove(record)
                    self._wake_placer()  # there is room for another
                    return True
            case Stop(instance, force):
                site.runtime.stop(instance, force=force)
                return True
            case Remove(instance):
                log.info("site %s: removing %s, which nobody wants there", site.name, instance)
                site.runtime.remove(instance)
                return True
            case Place():
                raise TypeError("what is at a site is placed already")
        return False

    def _start(self, site: Site, record: Record) -> None:
        # Noted first: an orchestrator killed in between finds either nothing, and starts, or its run, and adopts.
        noted = self._store.change(record, self._clock(), started_at=self._clock(), said=0)
        if noted is None:
            return
        try:
            site.runtime.start(self._launch(noted))
        except (SiteSilentError, OvertakenError):
            raise  # no fault of the service: it is started when the site answers again, or by who leads
        except RuntimeFailure as error:
            self._crash(site, Crash(noted, f"could not be started: {error}", unstarted=True))
        except SecretFileError as error:  # nothing of the site's: another one has the same secrets
            self._crash(site, Crash(noted, f"could not be started: {error}"))

    def _launch(self, record: Record) -> Launch:
        spec = record.spec
        grant = Grant(
            instance=record.id,
            service=record.service,
            robot=record.robot or "standby",
            idle_exit_s=_SPARE_IDLE if record.spare else Grant.model_fields["idle_exit_s"].default,
            params=record.params,
            session_id=record.session_id,
            session_key=base64.b64encode(self._secrets.session_key(record.session_id, record.key_id)).decode(),
            topics=spec.topics,
            launch=spec.launch,
            remap=spec.remap,
            step_times=spec.needs.scaling is not None and spec.needs.scaling.step_ms is not None,
        )
        return Launch(record.attempt, spec, grant)

    def _ready(self, site: Site, record: Record, host: str | None, port: int | None) -> bool:
        now = self._clock()
        running_at = record.running_at if record.state is State.RUNNING else now
        changes: dict[str, Any] = {"state": State.RUNNING, "host": host, "port": port, "running_at": running_at}
        if self._store.change(record, now, reason="", **changes) is None:
            return False
        if record.state is State.STARTING:
            site.fitness.started(record)
            self._metrics.phase(record, "starting", now - (record.started_at or now))
            if record.attempt == 1:
                self._metrics.phase(record, "total", now - record.created_at)
        return True

    def _crash(self, site: Site, crash: Crash) -> None:
        changes = after_crash(crash, self._clock(), self._timing)
        if crash.unstarted and changes["failures"] >= _TRIES:
            changes |= self._elsewhere(site, crash, gives_up=changes["state"] is State.FAILED)
        larger = self._resizing.larger(site, crash.record) if crash.out_of_memory else None
        if larger is not None and not changes["state"].final:
            changes |= {"size": larger.model_dump(), "resize": None}
            changes["reason"] += f", with {larger.memory_mb} MiB of memory instead of {crash.record.has.memory_mb}"
        after = self._store.change(crash.record, self._clock(), **changes)
        if after is None:
            return
        if larger is not None and after.has == larger:
            self._metrics.resized(crash.record, crash.record.has, larger, "memory")
            self.note(after)
        log.warning("%s for %s (%s): %s", after.service, after.robot, after.id, after.reason)
        if after.restarts:
            self._store.count(after, [of_instance(after)])
        self.moves.fail_over(after, after.reason)
        if after.site is None or after.state.final:
            self._promises.remove(after)
            if after.state.final and after.spare:
                self.moves.spare_failed(after)
            self._wake_placer()
            site.runtime.stop(after.id, force=True)  # what its main process left behind

    def _elsewhere(self, site: Site, crash: Crash, *, gives_up: bool) -> dict[str, Any]:
        """What else changes where a run cannot be started: the site is refused, if that leaves another one to try.

        A site that can start nothing at all is not refused so: it says so itself, until it can. The others stay refused
        while another one fits, or until ``start_at``: nobody tells when they were mended.
        """
        record, refused = crash.record, list(crash.record.refused)
        if not site.runtime.blocked():
            site.fitness.failed(record, crash.why, self._steady(), self._clock())
            refused.append(Refusal(site=site.name, reason=UNSTARTED, detail=crash.why).model_dump())
        decision = self.weigh(replace(record, refused=refused), self.promised())
        if decision.site is None and (decision.hopeless or record.spare or not gives_up):  # a spare never waits
            several = gives_up and len(decision.refused) > 1
            return {"reason": f"no site can start it: {told(record, decision.refused)}"} if several else {}
        self._metrics.refused(record.service, decision.refused)
        return {
            "state": State.PENDING,
            "site": None,
            "host": None,
            "port": None,
            "reason": f"site {site.name}: the service {crash.why}; trying another site",
            "refused": [refusal.model_dump() for refusal in decision.refused],
            "failures": 0,
            "restarts": 0,
            "start_at": self._clock() + self._timing.backoff_max,
        }

    def _expire(self, record: Record) -> None:
        if self._overload.felt() or self._steady() < self._settles_at:
            return  # its robot may have been refused, or wait for its answer; or it was dated by another clock
        now = self._clock()
        reason = f"the robot did not renew its lease of {record.lease_s:g} s"
        to = State.STOPPED if record.site is None else State.STOPPING
        if self._store.change(record, now, state=to, stopping_at=now, reason=reason):
            log.info("%s for %s (%s): %s", record.service, record.robot, record.id, reason)


def _as_it_was(site: Site) -> bool:
    """Whether what starts or stops at a site is as in the last pass."""
    if site.awaited is None:
        return False
    try:
        seen = site.runtime.look_at(site.awaited) if site.awaited else {}
    except RuntimeFailure:
        return False  # the pass says so
    return all(_same(seen.get(instance), site.observed.get(instance)) for instance in site.awaited)


def _all_as_it_was(site: Site) -> bool:
    """Whether all at a site is as in the last pass; if so, what it used by now is taken."""
    try:
        seen = site.runtime.observe()
    except RuntimeFailure:
        return False
    if seen.keys() != site.observed.keys() or not all(_same(one, site.observed[i]) for i, one in seen.items()):
        return False
    site.observed, site.looked_at = seen, time.monotonic()
    return True


def _same(one: Observation | None, other: Observation | None) -> bool:
    """Whether there is nothing to be done between the two looks: what was used meanwhile does not matter."""
    if one is other:
        return True
    return one is not None and other is not None and _phase(one) == _phase(other)


def _phase(seen: Observation) -> tuple[object, ...]:
    return seen.attempt, seen.phase, seen.detail, seen.host, seen.port, seen.exceeds, seen.leaving


def _ended(
    records: Iterable[Record], before: Mapping[str, Observation], after: Mapping[str, Observation]
) -> list[tuple[Record, Observation]]:
    """Runs that are seen no more, or not running, as they were when they last were."""
    ended = []
    for record in records:
        was, now = before.get(record.id), after.get(record.id)
        over = now is None or now.phase is Phase.EXITED or (was is not None and now.attempt != was.attempt)
        if was is not None and was.phase is not Phase.EXITED and over:
            ended.append((record, was))
    return ended


def _rest(usual: float, took: float) -> float:
    """Seconds from one look at all until the next, for one that took so many of a processor's."""
    return max(usual, took / _SHARE)
