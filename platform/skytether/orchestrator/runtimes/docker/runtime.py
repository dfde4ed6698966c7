"""A Docker engine as a site: the calls of the contract."""

from __future__ import annotations

import logging
import math
import stat
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from docker.errors import NotFound
from typing_extensions import override

from skytether.api.manifest import ServiceSpec, Strict

from ..base import (
    ARCHITECTURES,
    Capacity,
    Launch,
    LogStream,
    Observation,
    OvertakenError,
    Phase,
    Runtime,
    RuntimeFailure,
    least_memory_mb,
)
from ..containers import USER, kept_owner, with_owner
from .engine import Engine, EngineGoneError
from .fence import Fence
from .follow import Follower
from .images import check_credentials
from .launch import Job, kill, later_runs, remove
from .limits import limits_of, security_of
from .logs import ContainerLog
from .namespaces import Namespaces
from .network import ensure_network, remove_network, remove_old_guards
from .objects import data_volume, refusal
from .options import DockerOptions
from .reports import ReportReader
from .seen import ContainerState, observation
from .volumes import Scales, remove_left

log = logging.getLogger(__name__)

_HOLDS = {"userns": "user namespace", "rootless": "rootless engine", "seccomp": "seccomp", "apparmor": "AppArmor"}
"""In words for people, what an engine says of its own security."""
_LIMITS = {"MemoryLimit": "memory", "CpuCfsQuota": "processor time", "PidsLimit": "processes"}
"""In words for people, what an engine says that it can limit."""
SWEEP_S = 10.0
"""Seconds between two looks for volumes whose containers somebody has removed."""
_LEAVE_S = 10.0
"""Seconds that starts under way get at the end: an engine that hangs must not hold up a restart for long."""
AGAIN_S = 10.0
"""Seconds between two attempts to make the network of a site ready that could not be."""


class DockerRuntime(Runtime):
    """Runs services as containers of one engine.

    Starts go on in threads of their own; what is seen comes from the engine's events. So ``start``, ``observe`` and
    ``capacity`` wait for nothing but the first connection.

    Attributes:
        options: What the operator says of the site.
        engine: How it is asked.
        fence: Who leads.
        follower: What is seen of it.
        namespaces: Networks that are ready for the next starts.
        scales: What volumes hold.
        jobs: Starts, the last one of each instance.
    """

    Options = DockerOptions
    unique = "owner"
    runs_as_us = False
    owner_options = frozenset(
        {"devices", "groups", "guard_image", "network", "egress", "registry_auth", "seccomp", "without_limits"}
    )

    @override
    def __init__(self, site: str, folder: Path, options: Strict) -> None:
        if not isinstance(options, DockerOptions):
            raise TypeError("options must be DockerOptions")
        for path in (options.tls.ca, options.tls.cert, options.tls.key) if options.tls else ():
            if not Path(path).is_file():
                raise RuntimeFailure(f"tls: there is no file {path}")
        if options.tls and stat.S_IMODE(Path(options.tls.key).stat().st_mode) & 0o007:
            raise RuntimeFailure(f"tls: others can read the key, and be us to the engine: chmod 600 {options.tls.key}")
        options.security  # noqa: B018 (a profile that cannot be read is told now)
        if options.registry_auth is not None:
            check_credentials(options.registry_auth)
        self._site = site
        self.options = options
        self._owner = options.owner or kept_owner(folder)
        self.engine = Engine(options, folder)
        self.fence = Fence(self.engine, self._owner)
        self.scales = Scales(self.engine, self._owner, options.data_mb)
        self._lock = threading.Lock()
        self.jobs: dict[str, Job] = {}
        self._asked: set[str] = set()
        """Containers that were asked to end."""
        self._network_lock = threading.Lock()
        self._network_ready = False
        self._blocked = ""
        """Why nothing can be started here, as far as is known."""
        self._tried_at = -math.inf
        self._swept_at = -math.inf
        self._early: threading.Thread | None = None
        self._early_lock = threading.Lock()
        """Held while that is begun: what is not begun yet cannot be waited for."""
        self.follower = Follower(self.engine, self._owner, self._on_connect, options.timeout_s)
        self.namespaces = Namespaces(
            self.engine, options, self._owner, self.follower, self._prepare, self.fence.must_lead
        )
        self._reports = ReportReader(self.engine, self._running)
        self.follower.start()

    @override
    @classmethod
    def completed(cls, options: dict[str, Any]) -> dict[str, Any]:
        return with_owner(options)

    def _running(self) -> list[str]:
        return [seen.id for seen in self.follower.seen(self.options.timeout_s) if seen.runs]

    def _on_connect(self) -> None:
        self._network_ready = False  # network and guard's image may have been removed meanwhile
        self._begin_early()

    def _begin_early(self) -> None:
        self._tried_at = time.monotonic()
        with self._early_lock:
            self._early = threading.Thread(target=self.prepare_early, name="docker-network", daemon=True)
            self._early.start()

    def _wait_early(self) -> None:
        with self._early_lock:
            early = self._early
        if early is not None:
            early.join(self.options.timeout_s)

    def prepare_early(self) -> None:
        """Make the site ready before the first start, and remove what is of no use; what cannot be done is told."""
        with suppress(RuntimeFailure):  # each start tries again, and says it to who asked
            self._prepare()
        with suppress(RuntimeFailure):  # they only take room
            remove_old_guards(self.engine)

    def _prepare(self, *, anew: bool = False) -> None:
        with self._network_lock:
            if anew or not self._network_ready:
                self._network_ready = False
                try:
                    self._must_hold_limits()
                    ensure_network(self.engine, self.options)
                except EngineGoneError:
                    raise
                except RuntimeFailure as error:
                    if str(error) != self._blocked:
                        log.warning("site %s: nothing can be started: %s", self._site, error)
                    self._blocked = str(error)
                    raise
                self._network_ready, self._blocked = True, ""

    def _must_hold_limits(self) -> None:
        told = self.follower.info(self.options.timeout_s)
        # Podman says what the machine has, and ignores the limits where cgroups are of version 1 and it is not root.
        none = told.get("Rootless", False) and told.get("CgroupVersion") == "1"
        lacking = [what for key, what in _LIMITS.items() if none or not told.get(key, True)]
        if lacking and not self.options.without_limits:
            raise RuntimeFailure(
                f"the engine holds no limit of {' and '.join(lacking)}, so one service could starve all others: give it"
                " cgroup 2 with these controllers (docs/docker.md), or the site the option without_limits"
            )

    @override
    def blocked(self) -> str:
        return self._blocked

    @override
    def isolation(self) -> tuple[str, ...]:
        try:
            names = security_of(self.follower.info(0))
        except RuntimeFailure:
            return ()
        return (f"user {USER}", "no capabilities", *(word for name, word in _HOLDS.items() if name in names))

    def refuses(self, spec: ServiceSpec) -> str | None:
        return refusal(spec, self.options)

    def capacity(self) -> Capacity:
        info, options = self.follower.info(self.options.timeout_s), self.options
        cpu = options.cpu or float(info["NCPU"])
        machine = str(info.get("Architecture", ""))
        memory = options.memory_mb or int(info["MemTotal"]) >> 20
        return Capacity(cpu, memory, options.gpu, ARCHITECTURES.get(machine, machine))

    @override
    def lead(self, epoch: int) -> None:
        self.fence.lead(epoch)
        self.follower.catch_up(self.options.timeout_s)  # after that: what the leader before has begun is in it
        with self._lock:
            # What came of starts for an earlier leader is seen; those that are under way are refused where they are.
            self.jobs = {instance: job for instance, job in self.jobs.items() if not job.ended}

    def _must_lead(self) -> None:
        with self._doubting():
            self.fence.must_lead()

    @contextmanager
    def _doubting(self) -> Iterator[None]:
        """Around a call that waits for the engine: if that is silent, the next look says so, and waits for nothing."""
        try:
            yield
        except EngineGoneError as error:
            self.follower.doubt(error)
            raise

    def start(self, launch: Launch) -> None:
        self.follower.seen(self.options.timeout_s)  # or it could not be known whether it runs
        self._must_lead()
        full = self.scales.exceeds(data_volume(self._owner, launch))
        if full:
            raise RuntimeFailure(full)
        with self._lock:
            job, newest = self.jobs.get(launch.instance), self._newest(launch.instance)
            if newest is not None and newest.runs and newest.attempt > launch.attempt:
                raise OvertakenError(later_runs(newest))
            there = newest is not None and newest.attempt == launch.attempt
            if job is not None and job.attempt == launch.attempt and not job.unanswered:
                if there or job.failure or not job.ended:
                    return  # or it was begun, and somebody has removed its container
            elif (
                newest is not None and there and newest.status != "created" and not (job and newest.id in job.given_up)
            ):
                return
            site = self.engine, self.options, self._owner, self.follower
            job = Job(launch, *site, self._prepare, self.namespaces, self.fence, job)
            self.jobs[launch.instance] = job
            job.start()

    def _newest(self, instance: str) -> ContainerState | None:
        seen = self.follower.of(instance)
        return seen[-1] if seen else None

    @override
    def keeps_size(self, spec: ServiceSpec) -> str:
        return ""

    @override
    def resize(self, instance: str, attempt: int, spec: ServiceSpec) -> bool:
        cores = float(self.follower.info(self.options.timeout_s)["NCPU"])
        seen, wanted = self._newest(instance), limits_of(spec, cores)
        if seen is None or not seen.runs or seen.attempt != attempt:
            return False
        if seen.limits == wanted:
            return True
        used = self.follower.meter.usage(seen.id)
        if used is not None and wanted.memory < min(seen.limits.memory, least_memory_mb(used.memory_bytes) << 20):
            raise RuntimeFailure(f"it uses {used.memory_bytes >> 20} MiB, and so much would be taken from it")
        self._must_lead()  # a change by an earlier leader that comes late is seen, and made good
        with self._doubting(), self.engine.asked():
            api: Any = self.engine.api()  # a `Client`
            api.change(seen.id, wanted.document())
            after = self.follower.inspect(seen.id)
        return after is not None and after.limits == wanted

    @override
    def expect(self, instances: int) -> None:
        self.follower.expect(instances)

    def observe(self) -> Mapping[str, Observation]:
        with self._lock:
            jobs = dict(self.jobs)
        begun = {
            instance for instance, job in jobs.items() if job.ended
        }  # before the look, which shows what came of it
        newest: dict[str, ContainerState] = {}
        for seen in self.follower.seen(self.options.timeout_s):
            # What a start has given up is no run, however it looks: an engine that answers late still ends it.
            if seen.instance in jobs and seen.id in jobs[seen.instance].given_up:
                continue
            if seen.instance not in newest or newest[seen.instance].attempt < seen.attempt:
                newest[seen.instance] = seen
        # One that was made and not begun is no run: the orchestrator was killed in between, or a job is just at it.
        meter = self.follower.meter
        helpers = self.follower.helpers()
        found = {
            instance: observation(
                seen,
                self.options,
                meter.usage(seen.id),
                self.scales.exceeds(seen.volume, seen.other_volumes),
                cut_off=bool(seen.namespace) and not (seen.namespace in helpers and helpers[seen.namespace].runs),
                reports=self._reports.of(seen.id),
                step_s=self._reports.step_s(seen.id),
            )
            for instance, seen in newest.items()
            if seen.status != "created"
        }
        for instance, job in jobs.items():
            # One that a start ends again, for it could not be closed off, is no run that crashed.
            told = found.get(instance)
            if told and told.attempt >= job.attempt and (job.ended or told.phase is not Phase.EXITED):
                continue
            if job.unanswered:
                continue  # as if it had not been begun: it is, once the engine answers
            if instance in begun and not told and not job.failure:
                continue  # its container was removed, by somebody else
            if job.failure:
                found[instance] = Observation(job.attempt, Phase.EXITED, detail=job.failure, unstarted=job.unstarted)
            else:
                found[instance] = Observation(job.attempt, Phase.STARTING, pull=job.pull)
        return found

    def stop(self, instance: str, *, force: bool) -> None:
        with self._lock:
            job = self.jobs.get(instance)
        newest = self._newest(instance)
        if job is not None and not job.ended and (newest is None or newest.attempt < job.attempt or not newest.runs):
            job.cancel()
        for seen in self._to_be_ended(instance):
            if not seen.runs or (not force and seen.id in self._asked):
                continue
            kill(self.engine, seen.id, "KILL" if force else "TERM")
            if not force:
                self._asked.add(seen.id)  # once only: services may take a second signal for impatience

    def remove(self, instance: str) -> None:
        with self._lock:
            job = self.jobs.pop(instance, None)
        if job is not None:
            job.cancel()
            job.join(self.options.timeout_s)
        for seen in self._to_be_ended(instance):
            remove(self.engine, self.follower, seen.id)
            self._asked.discard(seen.id)

    def _to_be_ended(self, instance: str) -> list[ContainerState]:
        """All its containers, none of which a later leader has begun."""
        self.follower.seen(self.options.timeout_s)  # or it could not be known what is there
        there = self.follower.of(instance)
        self._must_lead()  # after the look
        return there

    def logs(self, instance: str, lines: int) -> str:
        self.follower.seen(self.options.timeout_s)  # who asks an engine that is away need not wait for it
        texts: list[str] = []
        left = lines
        for seen in reversed(self.follower.of(instance)):
            with self.engine.asked():
                try:
                    text = self.engine.api().logs(seen.id, tail=left).decode(errors="replace")
                except NotFound:
                    continue
            texts.append(text)
            left -= text.count("\n")
            if left <= 0:
                break
        return "".join(reversed(texts))

    @override
    def follow(self, instance: str, lines: int) -> LogStream | None:
        self.follower.seen(self.options.timeout_s)
        newest = self._newest(instance)
        return ContainerLog(self.engine, newest.id, lines) if newest is not None and newest.runs else None

    @override
    def stored(self) -> Mapping[str, int]:
        return self.scales.by_robot

    @override
    def tidy(self) -> None:
        """Remove what was begun by halves, and see whether what the network lacked is there by now."""
        if self.fence.epoch:
            with self._doubting():
                self.fence.lead(self.fence.epoch)  # anew, should somebody have removed what tells of it
        self.remove_unbegun()
        if time.monotonic() - self._swept_at >= SWEEP_S:
            self._swept_at = time.monotonic()
            remove_left(self.engine, self._owner)
        self.scales.begin()
        self._reports.begin()
        with self._lock:
            starting = any(not job.ended for job in self.jobs.values())
        starting |= any(seen.runs and not seen.ready for seen in self.follower.seen(self.options.timeout_s))
        self.namespaces.begin(resting=not starting and not self._blocked)
        trying = self._early is not None and self._early.is_alive()
        if self._blocked and not trying and time.monotonic() - self._tried_at >= AGAIN_S:
            self._begin_early()

    def remove_unbegun(self) -> None:
        """What was made and never begun, or given up: an orchestrator was killed, or an engine answered too late.

        And end what a leader that was followed has begun beside a later run. Nobody else is told of these, so nobody
        else asks for their end.
        """
        with self._lock:
            busy = {instance for instance, job in self.jobs.items() if not job.ended}
            given_up = {container for job in self.jobs.values() if job.ended for container in job.given_up}
        there = self.follower.seen(self.options.timeout_s)
        latest: dict[str, int] = {}
        for seen in there:
            if seen.runs:
                latest[seen.instance] = max(seen.attempt, latest.get(seen.instance, 0))
        unbegun = [s for s in there if s.id in given_up or (s.status == "created" and s.instance not in busy)]
        doubled = [s for s in there if s.runs and s.attempt < latest[s.instance] and s.instance not in busy]
        if unbegun or doubled:
            self._must_lead()  # after the look: nothing of it was made by a later leader
        for seen in unbegun:
            remove(self.engine, self.follower, seen.id)
        for seen in doubled:
            kill(self.engine, seen.id, "KILL")

    @override
    def dismantle(self) -> None:
        self._wait_early()  # or it makes the network again
        self.remove_unbegun()
        self.namespaces.clear()
        remove_left(self.engine, self._owner)
        self.fence.clear()
        remove_network(self.engine, self.options)

    @override
    def erase(self) -> None:
        remove_left(self.engine, self._owner, data=True)

    @override
    def close(self) -> None:
        with self._lock:
            jobs = [job for job in self.jobs.values() if not job.ended]
        for job in jobs:
            job.leave()
        deadline = time.monotonic() + min(_LEAVE_S, self.options.timeout_s)
        for job in jobs:
            job.join(max(0.0, deadline - time.monotonic()))  # what it has begun is closed off, and seen in its network
        self.namespaces.close()
        self.follower.close()
        self._wait_early()  # or it leaves its container behind
        self.engine.drop()
