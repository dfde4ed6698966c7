"""The pass over a site: carries out what ``plan`` decides of what is there."""

from __future__ import annotations

import base64
import logging
import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence, Set
from dataclasses import replace

from skytether.api.grant import Grant
from skytether.api.rest import Refusal, Size, State

from ..access.disk_usage import DiskUsage
from ..config.settings import Timing
from ..domain.counter_totals import of_instance, of_run
from ..domain.records import Change, Record
from ..domain.security import SecretFileError, Secrets
from ..domain.transitions import crashed, launched, progressed, running, stopped, unstarted, with_memory
from ..runtimes.base import Launch, Observation, OvertakenError, Phase, RuntimeFailure, SiteSilentError
from ..store.leader import ALONE, Lead
from ..store.store import Store
from ..telemetry.metrics import Metrics
from ..telemetry.service_events import ServiceEvents
from .leases import Leases
from .loops import rest_of
from .placement import UNSTARTED, believable, explain_refusals
from .placer import Placer
from .plan import (
    Action,
    Crash,
    End,
    Expire,
    Place,
    Progress,
    Ready,
    Remove,
    Start,
    Stop,
    after_crash,
    failures_by,
    plan,
)
from .resizing import Resizing
from .site import Site
from .standbys import Standbys
from .successors import Successors

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
_ACTING = 0.5
"""Seconds for which a pass over a site acts, at most: of a crowd some are ready before the last ones are started."""
_BALKS = 5
"""Acts in a row that a site did not answer, after which a pass asks it for nothing more: nor would it answer that."""
PLENTY = Size(cpu=1e9, memory_mb=1_000_000_000)
"""More than any robot may have."""


class Reconciler:
    """Makes what is at a site what should be, while this orchestrator leads; otherwise it looks only."""

    def __init__(
        self,
        store: Store,
        secrets: Secrets,
        placer: Placer,
        leases: Leases,
        standbys: Standbys,
        successors: Successors,
        metrics: Metrics,
        timing: Timing,
        clock: Callable[[], float],
        wake_placer: Callable[[], None],
        lead: Lead = ALONE,
        steady: Callable[[], float] = time.monotonic,
        disk_usage: DiskUsage | None = None,
        left: Callable[[str], Size] = lambda _: PLENTY,
    ) -> None:
        """``clock`` gives seconds since the epoch, ``steady`` those of a clock that nobody sets.

        What belongs to a robot that has too much by ``disk_usage`` ends. ``left``: what a robot may have beside what it
        has.
        """
        self._resizing = Resizing(store, metrics, successors, placer, left, steady)
        self._service_events = ServiceEvents(store, steady)
        self._store = store
        self._secrets = secrets
        self._placer = placer
        self._leases = leases
        self._standbys = standbys
        self._successors = successors
        self._metrics = metrics
        self._timing = timing
        self._clock = clock
        self._wake_placer = wake_placer
        self._lead = lead
        self._steady = steady
        self._disk_usage = disk_usage

    def site_turn(self, site: Site) -> float:
        """As much of a pass over a site as is due; returns seconds until the next.

        All of it once a second. In between, all that is there is looked at by its period, and what starts or stops more
        often; as long as the runtime finds it as it was, and nobody called, the database is not asked.
        """
        now = self._steady()
        if now < site.rests_until:
            return site.rests_until - now
        due = site.passed_at + rest_of(_WHOLE, site.pass_took) - now
        look = site.watched_at + rest_of(self._timing.observe, site.look_took) - now
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
        delay = self._leases.guarded(lambda: self._site_pass(site, whole))
        self._metrics.reconciled(site.name, time.monotonic() - began)
        return delay

    def _site_pass(self, site: Site, whole: bool) -> float:
        began, times_set = time.thread_time(), self._leases.times_set
        site.awaited = None  # whatever ends this pass early, or is left to do
        if whole:
            site.passed_at = -math.inf
        led = self._lead.epoch if self._leases.leads() else 0
        # Before the look: nothing can be observed that is not in it.
        live = self._store.live_at(site.name, changing=not whole)
        if whole:
            self._note_hosted(site, live)
        due = whole and time.monotonic() - site.tidied_at >= _TIDY
        ids = {record.id for record in live}
        looked = self._observe(site, ids, led, whole=whole, due=due)
        if looked is None:
            return self._timing.place
        self._keep_seen(site, live, looked, whole=whole)
        if not self._leases.leads():
            return self._timing.observe
        now = self._leases.now()
        if times_set != self._leases.times_set:
            return 0.0  # what was read is dated by another clock
        if site.seen_since is None or site.seen_since[0] != times_set:
            site.seen_since = (times_set, now)
        if whole:
            site.ended = self._ended_of(looked.keys() - ids, frozenset() if due else site.ended)
            looked = self._bounded(site, live, looked)
        live = self._service_events.keep(live, looked, now)
        actions = plan(live, looked, site.ended, now, self._timing, site.seen_since[1])
        if whole:
            site.pass_took = time.thread_time() - began
        done = self._act_on(site, actions)
        if whole and not site.balks:
            self._resizing.keep(site, live, looked, now)
        if due:
            self._tidy(site)
        return self._until_next(site, live, actions, done, whole=whole)

    def _until_next(
        self, site: Site, live: Sequence[Record], actions: Sequence[Action], done: Sequence[Action], *, whole: bool
    ) -> float:
        """Seconds until the next pass, and what is looked at until then."""
        if site.balks:
            return self._timing.place  # it is not asked again and again what it does not do
        changing = {record.id for record in live if record.state in (State.STARTING, State.STOPPING)}
        changing -= {action.record.id for action in done if isinstance(action, Ready | End)}
        if len(done) == len(actions):
            site.awaited = changing
            if whole:
                site.passed_at = site.watched_at = self._steady()
        return self._timing.observe_changing if actions or changing else self._timing.observe

    def _note_hosted(self, site: Site, live: Iterable[Record]) -> None:
        before = self._store.robots_at(site.name) if site.hosted is None else site.hosted
        site.hosted = before | {record.robot for record in live}

    def _observe(
        self, site: Site, ids: Set[str], led: int, *, whole: bool, due: bool
    ) -> Mapping[str, Observation] | None:
        """What is at a site: all of it, or these only; None: it does not answer, and is noted as silent.

        ``led``: the epoch that it is to be told first; 0: none.
        """
        try:
            if led and site.led != led:
                site.runtime.lead(led)
                site.led, site.ended, site.seen_since = led, frozenset(), None
                site.fitness.forget()
            if site.capacity is None or due:
                site.capacity = believable(site.runtime.capacity())  # nodes come and go
            if whole:
                site.runtime.expect(len(ids))
            looked = site.runtime.observe() if whole else site.runtime.observe_some(ids)
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
            return None
        return looked

    def _keep_seen(self, site: Site, live: Sequence[Record], looked: Mapping[str, Observation], *, whole: bool) -> None:
        """From now on this is what is known of the site; what runs had used that are over is counted."""
        if self._leases.leads():
            for record, seen in _ended(live, site.observed, looked):
                self._store.count(record, [of_run(record, seen)])
        ids = {record.id for record in live}
        others = {} if whole else {i: seen for i, seen in site.observed.items() if i not in ids}
        site.observed, site.failure, site.looked_at = {**others, **looked}, "", time.monotonic()
        site.leaving = {i: seen.leaving for i, seen in site.observed.items() if seen.leaving}

    @staticmethod
    def _tidy(site: Site) -> None:
        site.tidied_at = time.monotonic()
        try:
            site.runtime.tidy()
        except RuntimeFailure as error:
            log.warning("site %s: %s", site.name, error)

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
            case Progress(record, detail, pull):
                self._store.change(progressed(record, self._clock(), detail, pull), self._clock())
            case Ready(record, host, port):
                return self._ready(site, record, host, port)
            case Crash():
                self._crash(site, action)
            case Expire(record):
                self._leases.expire(record)
            case End(record):
                site.runtime.stop(record.id, force=True)  # what its main process left behind
                if self._store.change(stopped(record), self._clock()):
                    self._placer.release(record)
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
        noted = self._store.change(launched(record, self._clock()), self._clock())
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
            idle_exit_s=_SPARE_IDLE if record.standby else Grant.model_fields["idle_exit_s"].default,
            params=spec.typed(record.params),
            session_id=record.session_id,
            session_key=base64.b64encode(self._secrets.session_key(record.session_id, record.key_id)).decode(),
            topics=spec.topics,
            launch=spec.launch,
            graph=spec.graph or "ros1",
            remap=spec.remap,
            step_times=spec.needs.scaling is not None and spec.needs.scaling.step_ms is not None,
        )
        return Launch(record.attempt, spec, grant)

    def _ready(self, site: Site, record: Record, host: str | None, port: int | None) -> bool:
        now = self._clock()
        if self._store.change(running(record, now, host, port), now) is None:
            return False
        if record.state is State.STARTING:
            site.fitness.started(record)
            self._metrics.phase(record, "starting", now - (record.started_at or now))
            if record.attempt == 1:
                self._metrics.phase(record, "total", now - record.created_at)
        return True

    def _crash(self, site: Site, crash: Crash) -> None:
        now = self._clock()
        change = after_crash(crash, now, self._timing)
        if crash.unstarted and failures_by(crash, now, self._timing) >= _TRIES:
            change = self._elsewhere(site, crash, change)
        larger = self._resizing.larger(site, crash.record) if crash.out_of_memory else None
        if larger is not None and not change.state.final:
            change = with_memory(change, larger)
        after = self._store.change(change, self._clock())
        if after is None:
            return
        if larger is not None and after.has == larger:
            self._metrics.resized(crash.record, crash.record.has, larger, "memory")
            self._placer.hold(after)
        log.warning("%s for %s (%s): %s", after.service, after.robot, after.id, after.reason)
        if after.restarts:
            self._store.count(after, [of_instance(after)])
        self._successors.fail_over(after, after.reason)
        if after.site is None or after.state.final:
            self._placer.release(after)
            if after.state.final and after.standby:
                self._standbys.failed(after)
            self._wake_placer()
            site.runtime.stop(after.id, force=True)  # what its main process left behind

    def _elsewhere(self, site: Site, crash: Crash, change: Change) -> Change:
        """What changes where a run cannot be started: the site is refused, if that leaves another one to try.

        A site that can start nothing at all is not refused so: it says so itself, until it can. The others stay refused
        while another one fits, or until ``start_at``: nobody tells when they were mended.
        """
        record, gives_up = crash.record, change.state is State.FAILED
        refused = list(record.refused)
        if not site.runtime.blocked():
            site.fitness.failed(record, crash.why, self._steady(), self._clock())
            refused.append(Refusal(site=site.name, reason=UNSTARTED, detail=crash.why).model_dump())
        decision = self._placer.weigh(replace(record, refused=refused), self._placer.promised())
        if decision.site is None and (decision.hopeless or record.standby or not gives_up):  # a standby never waits
            if gives_up and len(decision.refused) > 1:
                why = f"no site can start it: {explain_refusals(record, decision.refused)}"
                return crashed(record, change.after.failures, why)
            return change
        self._metrics.refused(record.service, decision.refused)
        reason = f"site {site.name}: the service {crash.why}; trying another site"
        again_at = self._clock() + self._timing.backoff_max
        return unstarted(record, change.after.attempt, again_at, reason, decision.refused)


def _as_it_was(site: Site) -> bool:
    """Whether what starts or stops at a site is as in the last pass."""
    if site.awaited is None:
        return False
    try:
        seen = site.runtime.observe_some(site.awaited) if site.awaited else {}
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
    return seen.attempt, seen.phase, seen.detail, seen.pull, seen.host, seen.port, seen.exceeds, seen.leaving


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
