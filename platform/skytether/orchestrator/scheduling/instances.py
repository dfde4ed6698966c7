"""What can be asked of instances: create, look, renew, delete. The reconciler does the rest."""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from typing import Any

from skytether.api.pull_progress import PullProgress
from skytether.api.report_metrics import counts_of
from skytether.api.rest import (
    Instance,
    InstanceCreate,
    Measurement,
    Migrate,
    Placement,
    Refusal,
    Renew,
    Resize,
    Score,
    Session,
    SessionKey,
    Size,
    State,
)

from ..access.access import Principal
from ..access.quotas import Quotas
from ..domain.counter_totals import of_robot
from ..domain.errors import ConflictError, Fault, InvalidError, NoSiteError, NotFoundError, SilentSiteError
from ..domain.records import Record, new_record
from ..domain.security import SecretFileError, Secrets
from ..domain.transitions import claimed, noted, resizing, stopping
from ..domain.validation import check_params
from ..robots.gates import Gates
from ..runtimes.base import LogStream, RuntimeFailure, least_memory_mb
from ..store.store import KeyReusedError, Store
from ..telemetry.metrics import Metrics
from ..telemetry.reports import Reports
from .catalog import Catalog
from .placement import PlacementDecision, explain_refusals
from .placer import Placer
from .site import Site
from .sites import Sites
from .standbys import Standbys
from .successors import Successors


def utc(seconds: float) -> datetime:
    """Seconds since the epoch as REST tells them."""
    return datetime.fromtimestamp(seconds, UTC)


class Instances:
    """Instances as robots and operators see them."""

    def __init__(
        self,
        store: Store,
        catalog: Catalog,
        sites: Sites,
        placer: Placer,
        standbys: Standbys,
        successors: Successors,
        metrics: Metrics,
        reports: Reports,
        gates: Gates,
        secrets_: Secrets,
        clock: Callable[[], float],
        wake_placer: Callable[[], None],
        quotas: Quotas,
    ) -> None:
        self._quotas = quotas
        self._store = store
        self._catalog = catalog
        self._sites = sites
        self._placer = placer
        self._standbys = standbys
        self._successors = successors
        self._metrics = metrics
        self._reports = reports
        self._gates = gates
        self._secrets = secrets_
        self._clock = clock
        self._wake_placer = wake_placer

    def create(self, principal: Principal, asked: InstanceCreate, key: str | None) -> Record:
        """Take a robot's request. With an idempotency key that came before, the instance made then is given back.

        Raises:
            ForbiddenError: Not for this token.
            NotFoundError: No such service.
            InvalidError: Wrong parameters.
            NoSiteError: No site could ever run it.
            QuotaError: The robot has too much already.
        """
        principal.require(asked.robot, asked.service)
        body = json.dumps(asked.model_dump(mode="json"), sort_keys=True).encode()
        digest = hashlib.sha256(body).hexdigest()
        try:
            earlier = self._store.made_with(principal.owner, key, digest) if key else None
            if earlier is not None:
                return earlier
            self._quotas.check_lease(principal, asked.lease_s)
            record = self._new(asked)
            with self._quotas.admitting(record):
                return self._claim(record, principal.owner, key, digest) or self._store.add(
                    record, principal.owner, key, digest
                )
        except KeyReusedError:
            fault = Fault("Idempotency-Key", "came before with another body: use a new key for a new request")
            raise InvalidError([fault]) from None
        finally:
            self._wake_placer()

    def _new(self, asked: InstanceCreate) -> Record:
        manifest = self._catalog.get(asked.service)
        check_params(asked.params, manifest.spec.params, asked.service)
        now = self._clock()
        record = new_record(
            robot=asked.robot,
            service=asked.service,
            manifest=manifest.model_dump(mode="json", by_alias=True),
            created_at=now,
            updated_at=now,
            lease_s=asked.lease_s,
            lease_expires_at=now + asked.lease_s,
            params=asked.params,
            measurements=self._of_known_sites(asked.measurements),
        )
        decision = self._placer.weigh(record, {})  # whether it could ever run does not depend on what is there
        if decision.hopeless:
            self._sites.refresh()  # one may have been added at another orchestrator a moment ago
            decision = self._placer.weigh(record, {})
        if decision.hopeless:
            raise self._no_site(record, decision)
        return record

    def _of_known_sites(self, measured: Mapping[str, Measurement]) -> dict[str, Any]:
        """As JSON; of sites that are not there nothing is kept, for a robot could make up thousands."""
        return {site: m.model_dump(exclude_none=True) for site, m in measured.items() if self._sites.find(site)}

    def _no_site(self, record: Record, decision: PlacementDecision) -> NoSiteError:
        self._metrics.refused(record.service, decision.refused)
        text = f"no site can run '{record.service}': {explain_refusals(record, decision.refused)}"
        return NoSiteError(text, [refusal.model_dump() for refusal in decision.refused])

    def _claim(self, record: Record, owner: str, key: str | None, digest: str) -> Record | None:
        """A warm instance instead of a new one, if there is one that fits."""
        for standby in self._standbys.fitting(record):
            now = self._clock()
            taken = self._store.claim(claimed(standby, record, now), now, owner, key, digest)
            if taken is not None:
                self._metrics.phase(taken, "total", self._clock() - record.created_at)
                return taken
        return None

    def migrate(self, principal: Principal, instance: str, asked: Migrate) -> Record:
        """Start another instance for the same robot elsewhere; the robot changes to it, and lets this one go.

        One that is being moved already is not moved twice: the instance that is coming is given back.

        Raises:
            NotFoundError: No such instance, or no such site.
            ConflictError: It has ended or ends, is nobody's, has no site yet, or is at that site already.
            NoSiteError: No other site can take it now; nothing was started.
            QuotaError: Its robot has too much already.
        """
        record = self.get(principal, instance)
        if record.state.final or record.state is State.STOPPING:
            raise ConflictError(f"instance '{instance}' is {record.state}: ask for a new one")
        if record.standby:
            raise ConflictError(
                f"instance '{instance}' is a standby, which nobody uses: delete it, and another is made"
            )
        if record.site is None:
            raise ConflictError(f"instance '{instance}' has no site yet ({record.state}): move it once it runs")
        coming = self._store.successor(instance)
        if coming is not None:
            return self.get(principal, coming)
        if asked.site is not None:
            self._sites.get(asked.site)
            if asked.site == record.site:
                raise ConflictError(f"instance '{instance}' is at site '{asked.site}' already")
        successor = self._successors.successor_of(record, asked.site)
        decision = self._placer.weigh(successor)
        if decision.site is None:
            raise self._no_site(successor, decision)
        with self._quotas.admitting(successor):
            added = self._store.add(successor, principal.owner, None, "")
        self._wake_placer()
        return added

    def resize(self, principal: Principal, instance: str, asked: Resize) -> Record:
        """Give a running instance more or less; where its site cannot, another one is started for its robot.

        Raises:
            NotFoundError: No such instance.
            ConflictError: It does not run.
            InvalidError: Less than it uses, or not within what its service's needs say.
            NoSiteError: Neither its own site nor another one can give it that; it has what it had.
            QuotaError: Its robot would have too much.
            SilentSiteError: Its site does not answer.
        """
        while True:
            record = self.get(principal, instance)
            site = self._site_of_running(record)
            has = record.has
            cpu, memory_mb = asked.cpu or has.cpu, asked.memory_mb or has.memory_mb
            wanted = Size(cpu=cpu, memory_mb=memory_mb)
            if wanted == (record.wants or has):
                return record
            self._check_size(record, site, wanted)
            why = site.runtime.keeps_size(record.spec)
            with self._quotas.resizing(record, wanted):
                why = why or self._placer.lacks(record, wanted)
                resize = resizing(record, wanted, "asked", f"{principal.owner} asked for it")
                changed = None if why else self._store.change(resize, self._clock())
            if why:
                return self._move_for_size(principal, record, wanted, why)
            if changed is not None:  # else somebody else changed it meanwhile: look again
                self._placer.hold(changed)
                site.wake()
                return changed

    def _site_of_running(self, record: Record) -> Site:
        if record.state.final or record.state is State.STOPPING:
            raise ConflictError(f"instance '{record.id}' is {record.state}: ask for a new one")
        if record.standby:
            raise ConflictError(
                f"instance '{record.id}' is a standby, which nobody uses: it has what its service needs"
            )
        if record.state is not State.RUNNING:
            raise ConflictError(f"instance '{record.id}' is {record.state}: give it another size once it runs")
        site = self._sites.find_anew(record.site)
        if site is None or site.unreachable:
            why = site.unreachable if site else "it was deleted"
            raise SilentSiteError(f"site '{record.site}' cannot be asked now: {why}")
        return site

    @staticmethod
    def _check_size(record: Record, site: Site, wanted: Size) -> None:
        faults, scaling = [], record.spec.needs.scaling
        for key in ("cpu", "memory_mb"):
            range_, value = getattr(scaling, key, None), getattr(wanted, key)
            if range_ is not None and value != getattr(record.has, key) and not range_.min <= value <= range_.max:
                text = f"is {value:g}, and the service's needs.scaling.{key} goes from {range_.min:g} to {range_.max:g}"
                faults.append(Fault(key, text))
        seen = site.observed.get(record.id)
        used = seen.memory_bytes if seen is not None else None
        if used is not None and wanted.memory_mb < min(record.has.memory_mb, least_memory_mb(used)):
            text = f"is {wanted.memory_mb}, and it uses {used >> 20} MiB now: give it {least_memory_mb(used)} at least"
            faults.append(Fault("memory_mb", text))
        if faults:
            raise InvalidError(faults)

    def _move_for_size(self, principal: Principal, record: Record, wanted: Size, why: str) -> Record:
        """Have another one started where it can have that; gives back the present one."""
        if self._store.successor(record.id) is not None:
            raise ConflictError(f"instance '{record.id}' is being moved: give the one that is coming another size")
        successor = self._successors.successor_of(record, size=wanted)
        decision = self._placer.weigh(successor)
        if decision.site is None:
            self._metrics.refused(record.service, decision.refused)
            others = "; ".join(f"{r.site}: {r.detail}" for r in decision.refused if r.site != record.site)
            text = f"instance '{record.id}' cannot have {wanted}: {record.site}: {why}{f'; {others}' if others else ''}"
            raise NoSiteError(text, [refusal.model_dump() for refusal in decision.refused])
        with self._quotas.admitting(successor):
            self._store.add(successor, principal.owner, None, "")
        text = f"is to have {wanted}, and at site {record.site} {why}: its robot is handed over"
        self._store.change(noted(record, text), self._clock())
        self._wake_placer()
        return self._store.get(record.id) or record

    def get(self, principal: Principal, instance: str) -> Record:
        """One instance.

        Raises:
            NotFoundError: There is none of that id, or it is another robot's (which is told nobody).
        """
        record = self._store.get(instance)
        if record is None or principal.robot not in (None, record.robot):
            raise NotFoundError(f"there is no instance '{instance}': it never was, or it ended long ago")
        return record

    def all(self, principal: Principal) -> list[Record]:
        """Newest first; a robot's own, or all for the operator."""
        return self._store.all(principal.robot)

    def renew(self, principal: Principal, instance: str, renew: Renew) -> Instance:
        """Keep an instance's lease, and take the robot's report. One that has ended, or is ending, stays as it is.

        Raises:
            NotFoundError: As for ``get``.
        """
        measurements = None
        if renew.measurements:
            before = self.get(principal, instance).measurements
            there = {site: seen for site, seen in before.items() if self._sites.find(site)}
            measurements = {**there, **self._of_known_sites(renew.measurements)}
        now = self._clock()
        lease_s = self._quotas.lease(principal, renew.lease_s)
        renewed = self._store.renew(instance, now, lease_s, robot=principal.robot, measurements=measurements)
        if renewed is None:
            return self.show(self.get(principal, instance))
        if renew.report is not None:
            kept = self._metrics.bounded(renewed.record, renew.report)
            report = kept.model_dump(mode="json")
            self._reports.add_report(renewed.record, now, report, of_robot(renew.report), counts_of(kept))
            if renew.report.gate is not None:
                self._gates.keep_report(renewed.record.robot, renew.report.gate)
        return self._shown(renewed.record, self._session(renewed.record), renewed.successor)

    def claim_session(self, principal: Principal, instance: str, claim: str) -> SessionKey:
        """The key of an instance's session: for its robot once, for an operator who may see keys always.

        A key is good for whoever has it, so a token that leaked is not enough to take over what is driven already.

        Raises:
            NotFoundError: As for ``get``.
            ConflictError: Somebody else with the robot's token has it, or the secret key that it is made from is gone.
        """
        record = self.get(principal, instance)
        if principal.robot is not None:
            digest = hashlib.sha256(claim.encode()).hexdigest()
            if not self._store.hand_out(instance, digest):
                raise ConflictError(
                    f"the key of instance '{instance}' was handed out already, and not to you: delete it, and ask for "
                    "another one; if nobody of yours has it, the robot's token leaked"
                )
        try:
            key = self._secrets.session_key(record.session_id, record.key_id)
        except SecretFileError as error:
            raise ConflictError(
                f"{error}: put it back, or delete instance '{instance}' and ask for another one"
            ) from error
        return SessionKey(key=base64.b64encode(key).decode())

    def delete(self, principal: Principal, instance: str) -> None:
        """End an instance; one that has ended, or is ending, stays as it is.

        Raises:
            NotFoundError: As for ``get``.
        """
        self._reports.write()  # what its robot told last is to be counted
        record: Record | None = None
        while record is None:  # the reconciler may be at it too: look again, and it is one step further
            record = self.end(self.get(principal, instance), "")

    def end(self, record: Record, reason: str) -> Record | None:
        """Let an instance end; None if somebody else changed it meanwhile."""
        if record.state.final or record.state is State.STOPPING:
            return record
        now = self._clock()
        ended = self._store.change(stopping(record, now, reason), now)
        if ended is not None:
            site = self._sites.find(ended.site)
            (site.wake if site else self._wake_placer)()
        return ended

    def end_all(self, robot: str) -> None:
        """End everything that a robot holds."""
        for record in self._store.all(robot):
            while self.end(self._store.get(record.id) or record, "the robot's token was revoked") is None:
                pass

    def logs(self, principal: Principal, instance: str, lines: int) -> str:
        """The last lines of an instance's log; empty before it has a site.

        Raises:
            NotFoundError: As for ``get``.
            SilentSiteError: Its site does not answer.
        """
        site = self._sites.find_anew(self.get(principal, instance).site)
        try:
            return site.runtime.logs(instance, lines) if site else ""
        except RuntimeFailure as error:
            raise SilentSiteError(str(error)) from error

    def follow(self, principal: Principal, instance: str, lines: int) -> LogStream | None:
        """The log of an instance's present run, as it is written; None: nothing runs. Raises as ``logs``."""
        site = self._sites.find_anew(self.get(principal, instance).site)
        try:
            return site.runtime.follow(instance, lines) if site else None
        except RuntimeFailure as error:
            raise SilentSiteError(str(error)) from error

    def show(self, record: Record) -> Instance:
        """As REST tells it to whom it concerns."""
        return self._shown(record, self._session(record), self._store.successor(record.id))

    def outline(self, record: Record) -> Instance:
        """Without its session and its successor, for lists."""
        return self._shown(record)

    def _shown(self, record: Record, session: Session | None = None, successor: str | None = None) -> Instance:
        refused = tuple(Refusal.model_validate(refusal) for refusal in record.refused)
        scores = tuple(Score.model_validate(score) for score in record.scores)
        return Instance(
            id=record.id,
            robot=record.robot,
            service=record.service,
            state=record.state,
            reason=record.reason,
            pull=PullProgress.model_validate(record.pull) if record.pull else None,
            params=record.params,
            size=record.has,
            resize=record.wants,
            placement=Placement(site=record.site, refused=refused, scores=scores) if record.site else None,
            session=session,
            replaces=record.replaces,
            successor=successor,
            restarts=record.restarts,
            created_at=utc(record.created_at),
            updated_at=utc(record.updated_at),
            lease_expires_at=utc(record.lease_expires_at),
        )

    def _session(self, record: Record) -> Session:
        spec = record.spec
        return Session(
            id=record.session_id,
            host=record.host,
            port=record.port,
            topics=spec.topics,
            needs=spec.needs,
        )
