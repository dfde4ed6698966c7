"""What a runtime is, and what each of its calls means.

A runtime starts, stops and observes instances on one site. It decides nothing: when to start again, how long to wait
for an end, what to do with strangers is the reconciler's. All calls come from the site's own thread, except ``logs``,
``refuses`` and ``blocked``, which may come from any. No call waits for a service: what takes long is begun, and
``observe`` tells how far it is.

Several orchestrators may have the same site open, and for a short time two of them may believe that they lead: one was
frozen, or has lost its database. So a runtime never trusts its memory about what is at the site, and refuses what it is
asked on behalf of a leader that another one has followed (``lead``).

A runtime is found by its entry point in group ``skytether.runtimes``; :mod:`skytether.testing.runtime_contract` is the
suite each must pass, and docs/writing-a-runtime.md says how to write one.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any, ClassVar

from skytether.api.grant import Grant
from skytether.api.manifest import ServiceSpec, Strict
from skytether.api.pull_progress import PullProgress
from skytether.api.service_report import ServiceReport

ENGINE_SOCKET, ENGINE_AWAY = "engine.sock", "engine.away"
"""In the folder of a site that joined: the socket of its engine while the node is linked, and why it is not."""
_ROOM_MB = 32
"""Memory that is left beside what is used, however little that is [MiB]."""


def least_memory_mb(used_bytes: int) -> int:
    """Below which nothing that uses so much is brought while it runs [MiB]: the kernel would kill it."""
    return math.ceil(max(used_bytes * 1.1, used_bytes + (_ROOM_MB << 20)) / 2**20)


class Phase(StrEnum):
    """How far a run is."""

    STARTING = "starting"
    RUNNING = "running"
    """Ready: its end of the bridge listens."""
    EXITED = "exited"


@dataclass(frozen=True, slots=True)
class Observation:
    """One instance as the runtime finds it."""

    attempt: int
    """The run it is of, as given to ``start``."""
    phase: Phase
    host: str | None = None
    """Where a robot reaches the service: the address to connect to, not the one bound. Known when RUNNING."""
    port: int | None = None
    exit_status: int | None = None
    """When EXITED; negative: the signal that ended it; None: unknown (it was not our child)."""
    last_line: str = ""
    """When EXITED: the last line of its log."""
    detail: str = ""
    """STARTING: what it waits for ("room on a node"); as long as this or ``pull`` changes, the start makes progress.
    RUNNING: what its own health check finds wrong; empty: it is well. EXITED: how it ended, where the status does not
    tell; continues "the service ..."."""
    pull: PullProgress | None = None
    """STARTING: how far the pull is that it waits for, instead of ``detail``."""
    out_of_memory: bool = False
    """EXITED: it was killed for taking more memory than it may."""
    unstarted: bool = False
    """EXITED: it could not even be begun, and nothing of it or of earlier runs is left: another site may do better.
    STARTING: nothing of it runs yet."""
    leaving: str = ""
    """RUNNING: why the site is about to end it, though nothing is wrong with it, as a sentence: it is moved first."""
    exceeds: str = ""
    """STARTING, RUNNING: what it took more of than it may, and is ended for; continues "the service ..."."""
    cpu_s: float | None = None
    """Processor time of this run so far."""
    memory_bytes: int | None = None
    received_bytes: int | None = None
    """By the network, of this run so far."""
    sent_bytes: int | None = None
    step_s: float | None = None
    """Of 20 of its last steps 19 took no longer, says the service; None: it does not say."""
    reports: tuple[ServiceReport, ...] = ()
    """The newest that the run reported, read from the file beside its ready file within some seconds; a runtime that
    cannot reads none."""


@dataclass(frozen=True, slots=True)
class Launch:
    """What to start."""

    attempt: int
    """Counts runs of one instance; a runtime reports it back with each observation."""
    spec: ServiceSpec
    grant: Grant
    """Without what only the runtime knows: addresses to bind, paths."""

    @property
    def instance(self) -> str:
        return self.grant.instance


@dataclass(frozen=True, slots=True)
class Capacity:
    """What a site offers in all, used or not."""

    cpu: float
    """Cores."""
    memory_mb: int
    gpu: int = 0
    architecture: str = ""
    """As container images name it, ``amd64`` or ``arm64``; empty: not known."""


ARCHITECTURES = {"x86_64": "amd64", "aarch64": "arm64", "armv7l": "arm"}
"""Names of container images for what the kernel says."""


class LogStream(ABC):
    """What one run writes, as it comes. Used from one thread at a time, but for ``close``."""

    @abstractmethod
    def read(self) -> str | None:
        """What is new; empty after about a second without; None: the run has ended, and all of it was read."""

    @abstractmethod
    def close(self) -> None:
        """Let go; may be called again, and while somebody reads."""


class RuntimeFailure(Exception):  # noqa: N818 (not an error of ours)
    """The site did not do what it was asked, or does not answer; one sentence saying what to do."""


class SiteSilentError(RuntimeFailure):
    """The site does not answer: nothing is known of what runs there, and no service is to blame."""


class OvertakenError(RuntimeFailure):
    """Another orchestrator leads by now, or has begun a later run: nothing was done, and no service is to blame."""

    epoch = 0
    """Of the leader who was here; 0: not told."""

    @classmethod
    def by_leader(cls, told: object, epoch: int) -> OvertakenError:
        """Of a later epoch; ``told``: the file or object that says so."""
        error = cls(f"another orchestrator leads by now, says {told}: this one does nothing here any more")
        error.epoch = epoch
        return error


class Runtime(ABC):
    """One site's runtime."""

    Options: ClassVar[type[Strict]]
    """The site's ``options``, validated; unknown keys are refused by name before the runtime is made."""

    unique: ClassVar[str] = ""
    """Option by which the site's instances are found: two sites with the same would end each other's."""

    runs_as_us: ClassVar[bool] = True
    """What it starts are processes of the orchestrator's own user, who has all its secrets: whoever chooses what runs
    there, or with which variables, is that user. Such a site is made by the operator of the state folder alone."""

    owner_options: ClassVar[frozenset[str]] = frozenset()
    """Options with which whoever chooses them has the site's machine, or secrets of ours; the operator of the state
    folder alone does."""

    @abstractmethod
    def __init__(self, site: str, folder: Path, options: Strict) -> None:
        """Take charge of what is there already, also what an earlier orchestrator started.

        Args:
            site: The site's name.
            folder: The runtime's own, kept over restarts; it exists, with mode 0700.
            options: Of type ``Options``.

        Raises:
            RuntimeFailure: It can never work with these options.
        """

    @classmethod
    def completed(cls, options: dict[str, Any]) -> dict[str, Any]:
        """The options of a new site, with what is made up once and has to stay as it is wherever the site is opened."""
        return options

    @abstractmethod
    def refuses(self, spec: ServiceSpec) -> str | None:
        """Why this runtime cannot run the service at all (no image, no entry point); None: it can. Pure."""

    def blocked(self) -> str:
        """Why nothing can be started at present, though the site answers; empty: nothing is known. From any thread."""
        return ""

    def isolation(self) -> tuple[str, ...]:
        """What keeps instances from one another and from the site, a few words each, for people."""
        return ()

    @abstractmethod
    def capacity(self) -> Capacity:
        """What the site offers. Called about once a second, so it should be cheap.

        Raises:
            RuntimeFailure: The site does not answer.
        """

    def lead(self, epoch: int) -> None:  # noqa: B027 (where a site is of one orchestrator alone, there is no other)
        """From now on act for the leader of this epoch, and let nobody act here for an earlier one.

        Called before the first look of a leader at the site, again until it succeeds. Until then a runtime acts for
        whoever asks, as tools and single orchestrators do. Whatever an earlier leader begins after this is refused with
        ``OvertakenError`` and does nothing; what it had begun before is seen by ``observe``, now or when it is done.
        What ``observe`` tells after this was looked at after this: who leads begins anew what it does not see.

        Args:
            epoch: Of the leader, above 0; each new leader has a higher one than all before.

        Raises:
            OvertakenError: A leader of a later epoch was here.
            RuntimeFailure: The site does not answer, so nobody was told; do nothing here.
        """

    @abstractmethod
    def start(self, launch: Launch) -> None:
        """Begin a run. Nothing happens if this very attempt was begun before, by whomever; earlier ones are ended.

        Raises:
            OvertakenError: Another orchestrator leads by now, or a later attempt runs.
            SiteSilentError: The site does not answer, or another orchestrator is just acting on this instance.
            RuntimeFailure: It cannot be started; nothing of it is left running.
        """

    def keeps_size(self, spec: ServiceSpec) -> str:  # noqa: ARG002 (here none can be changed)
        """Why what a run of the service may take cannot be changed while it runs; empty: it can. From any thread."""
        return "what runs there keeps the cores and memory that it began with"

    def resize(self, instance: str, attempt: int, spec: ServiceSpec) -> bool:  # noqa: ARG002
        """Have a run have the cores and memory that a launch with this spec would give it, without a restart.

        Asked again and again, by whoever leads; a run that has it already is left alone, and so is one that is not
        there, or of another attempt. What runs is never brought below what it uses.

        Returns:
            Whether it has it; False: the site is at it, or knows of no such run (yet).

        Raises:
            OvertakenError: Another orchestrator leads by now.
            SiteSilentError: The site does not answer: whether it has it is known later.
            RuntimeFailure: It cannot have it; it has what it had.
        """
        raise RuntimeFailure(self.keeps_size(spec))

    @abstractmethod
    def observe(self) -> Mapping[str, Observation]:
        """The latest run of every instance here, by id, ended ones until they are removed. Looks, never acts.

        Raises:
            RuntimeFailure: The site does not answer.
        """

    def expect(self, instances: int) -> None:  # noqa: B027 (whoever is not told by others what is there need not)
        """Before a look at all: so many instances are to be there. What a site tells of beyond is not believed to be.

        For runtimes that spend something on each, and are told what is there by a machine of somebody else's.
        """

    def observe_some(self, instances: Collection[str]) -> Mapping[str, Observation]:
        """What ``observe`` tells, of these only: asked again and again while they start or stop, so it should be cheap.

        Raises:
            RuntimeFailure: The site does not answer.
        """
        return {instance: seen for instance, seen in self.observe().items() if instance in instances}

    @abstractmethod
    def stop(self, instance: str, *, force: bool) -> None:
        """Ask a run to end, or with ``force`` end it now with all it started. May be called again and again.

        An instance that is unknown or has ended is left as it is; so is an exit that is under way.

        Raises:
            OvertakenError: Another orchestrator leads by now.
            RuntimeFailure: The site does not answer, or another orchestrator is just acting on this instance.
        """

    @abstractmethod
    def remove(self, instance: str) -> None:
        """Forget an instance and its log; end it first if it runs. May be called again. Its data stays.

        Raises:
            OvertakenError: Another orchestrator leads by now.
            RuntimeFailure: The site does not answer, or another orchestrator is just acting on this instance.
        """

    @abstractmethod
    def logs(self, instance: str, lines: int) -> str:
        """The last lines that all runs of the instance wrote; empty if there are none.

        Raises:
            RuntimeFailure: The site does not answer.
        """

    def follow(self, instance: str, lines: int) -> LogStream | None:  # noqa: ARG002 (none is followed here)
        """The last lines of the present run, then what it writes; None: nothing runs, or it cannot be followed.

        From any thread.

        Raises:
            RuntimeFailure: The site does not answer.
        """
        return None

    def load(self) -> float | None:
        """Share of the site's processors that is busy, whoever makes them so, 0 to 1; None: not known.

        Called about once a second, after ``observe``.

        Raises:
            RuntimeFailure: The site does not answer.
        """
        return None

    def stored(self) -> Mapping[str, int]:
        """Bytes that services have written and left here, by robot, as far as they were weighed. From any thread."""
        return {}

    def tidy(self) -> None:  # noqa: B027 (most need none)
        """Keep what grows within bounds (logs). Called about once a second.

        Raises:
            OvertakenError: Another orchestrator leads by now.
            RuntimeFailure: The site does not answer.
        """

    def dismantle(self) -> None:  # noqa: B027 (most make none)
        """Remove what was made for the site as such; before ``close``, when it is deleted and nothing runs there.

        Raises:
            RuntimeFailure: The site does not answer.
        """

    def erase(self) -> None:  # noqa: B027 (most keep it in the folder of the site)
        """Delete what services wrote and left here, which otherwise stays; after ``dismantle``, of a machine that goes.

        Raises:
            RuntimeFailure: The site does not answer.
        """

    def close(self) -> None:  # noqa: B027 (most need none)
        """Let go of the site; what runs there runs on."""
