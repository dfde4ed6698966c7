"""Runtimes that run nothing, named by how they fail: for tests of what stands above a runtime.

They keep the contract of :mod:`skytether.orchestrator.runtimes.base`, as :mod:`.runtime_contract` checks; so they also
show the least that a runtime of one's own has to do.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field
from typing_extensions import override

from skytether.api.manifest import ServiceSpec, Strict
from skytether.api.service_report import ServiceReport
from skytether.orchestrator.runtimes.base import (
    Capacity,
    Launch,
    Observation,
    OvertakenError,
    Phase,
    Runtime,
    RuntimeFailure,
)


class FakeOptions(Strict):
    """Options of all fakes."""

    cpu: Annotated[float, Field(gt=0)] = 64
    memory_mb: Annotated[int, Field(gt=0)] = 65_536


@dataclass
class FakeRun:
    """One run as the made-up machine has it."""

    launch: Launch
    port: int
    looks: int = 0
    """How often it was observed."""
    ended: bool = False
    exit_status: int | None = None
    last_line: str = ""
    log: str = ""
    reports: tuple[ServiceReport, ...] = ()
    leaving: str = ""
    """Why the site is about to end it."""
    cpu_s: float | None = None
    """What it has used; None: a little with each look."""
    memory_bytes: int = 1 << 20
    step_s: float | None = None
    out_of_memory: bool = False
    """How it ended."""


class FakeWorld(dict[str, FakeRun]):
    """The made-up machine: its runs by instance."""

    epoch = 0
    """Of the last leader that was here; 0: there was none."""


class FakeRuntime(Runtime):
    """Every service is ready at once, runs until it is stopped, and ends when it is asked to."""

    Options = FakeOptions
    runs_as_us = False
    looks_until_ready: float = 0
    """How often a run must have been observed before it listens."""
    obedient = True
    """Whether a run ends when it is asked to."""

    @override
    def __init__(self, site: str, folder: Path, options: Strict, world: FakeWorld | None = None) -> None:
        """``world``: that of an earlier runtime, or of another orchestrator."""
        if not isinstance(options, FakeOptions):
            raise TypeError("options must be FakeOptions")
        self.site = site
        self.world = FakeWorld() if world is None else world
        self.epoch = 0
        """Of the leader for whom it acts; 0: of any."""
        self.silent = False
        """Set it, and the site answers no more."""
        self.closed = ""
        """Why nothing can be started at present."""
        self.started: list[tuple[str, int]] = []
        """Instance and attempt of every run that was begun here."""
        self.resized: list[tuple[str, float, int]] = []
        """Instance, cores and memory of every change that was made here."""
        self.keeps = ""
        """Why it changes nothing of what runs."""
        self._options = options
        self._ports = count(40_000)

    def refuses(self, spec: ServiceSpec) -> str | None:
        return None if spec.entrypoint else "the service has no entrypoint"

    @override
    def blocked(self) -> str:
        return self.closed

    def capacity(self) -> Capacity:
        self._answer()
        return Capacity(self._options.cpu, self._options.memory_mb)

    @override
    def lead(self, epoch: int) -> None:
        self.epoch = epoch
        self._must_lead()
        self.world.epoch = epoch

    def start(self, launch: Launch) -> None:
        self._must_lead()
        old = self.world.get(launch.instance)
        if old is not None and old.launch.attempt == launch.attempt:
            return
        if old is not None and old.launch.attempt > launch.attempt and not old.ended:
            raise OvertakenError(f"attempt {old.launch.attempt} of {launch.instance} runs already")
        log = f"{old.log if old else ''}run {launch.attempt} of {launch.grant.service}\n"
        said = launch.grant.params.get("report")
        reports = (ServiceReport(1, "said", said),) if said else ()
        port = old.port if old else next(self._ports)
        self.world[launch.instance] = FakeRun(launch, port, log=log, reports=reports)
        self.started.append((launch.instance, launch.attempt))

    @override
    def keeps_size(self, spec: ServiceSpec) -> str:
        return self.keeps

    @override
    def resize(self, instance: str, attempt: int, spec: ServiceSpec) -> bool:
        self._must_lead()
        if self.keeps:
            raise RuntimeFailure(self.keeps)
        run = self.world.get(instance)
        if run is None or run.ended or run.launch.attempt != attempt:
            return False
        size = (spec.needs.cpu, spec.needs.memory_mb)
        if size != (run.launch.spec.needs.cpu, run.launch.spec.needs.memory_mb):
            run.launch = replace(run.launch, spec=spec)
            self.resized.append((instance, *size))
        return True

    def observe(self) -> Mapping[str, Observation]:
        self._answer()
        for run in self.world.values():
            run.looks += 1
        return {instance: self._observe(run) for instance, run in self.world.items()}

    def _observe(self, run: FakeRun) -> Observation:
        attempt = run.launch.attempt
        if run.ended:
            how: dict[str, Any] = {"exit_status": run.exit_status, "last_line": run.last_line}
            return Observation(attempt, Phase.EXITED, **how, out_of_memory=run.out_of_memory)
        if run.looks < self.looks_until_ready:
            return Observation(attempt, Phase.STARTING)
        here = Observation(attempt, Phase.RUNNING, "127.0.0.1", run.port, leaving=run.leaving, reports=run.reports)
        cpu_s = 0.01 * run.looks if run.cpu_s is None else run.cpu_s
        return replace(here, cpu_s=cpu_s, memory_bytes=run.memory_bytes, step_s=run.step_s)

    def stop(self, instance: str, *, force: bool) -> None:
        self._must_lead()
        run = self.world.get(instance)
        if run is not None and not run.ended and (force or self.obedient):
            run.ended, run.exit_status = True, -9 if force else 0

    def remove(self, instance: str) -> None:
        self._must_lead()
        self.world.pop(instance, None)

    def logs(self, instance: str, lines: int) -> str:
        run = self.world.get(instance)
        return "".join(run.log.splitlines(keepends=True)[-lines:]) if run else ""

    def crash(self, instance: str, exit_status: int = 1, last_line: str = "") -> None:
        """Let a run end by itself."""
        run = self.world[instance]
        run.ended, run.exit_status, run.last_line = True, exit_status, last_line
        run.log += f"{last_line}\n" if last_line else ""

    def _must_lead(self) -> None:
        self._answer()
        if 0 < self.epoch < self.world.epoch:
            raise OvertakenError.by_leader(f"site {self.site}", self.world.epoch)

    def _answer(self) -> None:
        if self.silent:
            raise RuntimeFailure(f"site {self.site} does not answer")


class SlowRuntime(FakeRuntime):
    """Services are ready only when they were looked at a few times."""

    looks_until_ready = 3


class NeverReadyRuntime(FakeRuntime):
    """Services start and never listen."""

    looks_until_ready = math.inf


class StubbornRuntime(FakeRuntime):
    """Services end only when they are forced to."""

    obedient = False


class CrashingRuntime(FakeRuntime):
    """Services end at once, with a last line that says why."""

    exit_status = 1
    last_line = "boom"

    def start(self, launch: Launch) -> None:
        old = self.world.get(launch.instance)
        super().start(launch)
        if self.world[launch.instance] is not old:
            self.crash(launch.instance, self.exit_status, self.last_line)


class RefusingRuntime(FakeRuntime):
    """Nothing can be started."""

    @override
    def start(self, launch: Launch) -> None:
        raise RuntimeFailure("no space left on the site")


class BlockedRuntime(FakeRuntime):
    """Nothing can be started, and it says so, until ``obstacle`` is emptied."""

    obstacle = "the network is missing"

    @override
    def blocked(self) -> str:
        return self.obstacle

    @override
    def start(self, launch: Launch) -> None:
        if self.obstacle:
            raise RuntimeFailure(self.obstacle)
        super().start(launch)
