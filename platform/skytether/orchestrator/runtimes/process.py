"""Instances as processes on this machine (Linux), one folder each.

The folder holds the log and ``run.json``: pid, start time and boot, by which the process is found again after the
orchestrator's own restart and never mistaken for another one with the same pid. In its folder ``own``, the only one
that a run may write into beside that for its data, are the grant (0600) and the ready file that the service writes; it
is made anew for each run, so that none finds there what an earlier one left for the orchestrator to fall over. Each
process leads a session of its own, so that it survives the orchestrator, and so that all it started can be ended with
it. There are no limits on memory and processor here: that is what containers are for. What a process may reach is told
in ``confinement``.
"""

from __future__ import annotations

import contextlib
import json
import logging
import math
import os
import platform
import secrets
import signal
import socket
import subprocess
import sys
import time
from collections import deque
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import psutil
from pydantic import AfterValidator, Field, model_validator
from typing_extensions import override

from skytether.api.grant import GRANT_VARIABLE
from skytether.api.manifest import ServiceSpec, Strict

from .base import (
    ARCHITECTURES,
    Capacity,
    Launch,
    LogStream,
    Observation,
    OvertakenError,
    Phase,
    Runtime,
    RuntimeFailure,
)
from .confinement import confined, launch_file, opened, readable, this_machine
from .disk import MOST_FILES, folders_in, remove_tree, size_of
from .fence import Fence
from .file_log import FileLog, keep_newer_half, last_line
from .hosts import AdvertisedHost, BindHost, check_advertised
from .notes import noted_port, read_json, write_private
from .procfs import BOOT_ID, ProcessId, ProcessStat, all_children_run, stat_of
from .runs import OWN, Run, Runs
from .users import allocate_user, free_user, hand_over, noted_user

log = logging.getLogger(__name__)

_PASSED_ON = ("LANG", "LC_ALL", "PATH", "TZ")
"""Of our environment; nothing else, for there may be secrets in it."""
_OWN_MB = 64
"""MiB that a run may have in its own folder, which is also its home and has its temporary files."""
WEIGH_S = 2.0
"""Seconds between two looks at how much robots' services have written."""
_EMPTY = 0.2
"""Seconds at a time for what runs that have ended left behind."""
_MEASURE = 2.0
"""Seconds between two readings of processor time, memory and ready file of a child that runs; whether it still does is
looked at each time."""


def _absolute(path: Path) -> Path:
    """Each service is started in a folder of its own, and would look for another place from there."""
    if not path.is_absolute():
        raise ValueError(f"must be an absolute path such as /var/lib/skytether/two, not '{path}'")
    return path


class ProcessOptions(Strict):
    """Options of a process site."""

    bind_host: BindHost = "127.0.0.1"
    """Address (a number, no name) that services listen on."""
    folder: Annotated[Path, AfterValidator(_absolute)] | None = None
    """Of the instances, the same for several orchestrators on this machine; None: in the orchestrator's own state."""
    owner: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9-]{0,31}$")] | None = None
    """Under this name instances are found again in ``folder``, beside those of other databases; None: one is made up
    when the site is added."""
    advertise_host: AdvertisedHost | None = None
    """Address that robots are told; None: the one bound. Needed when that is a wildcard."""
    cpu: Annotated[float, Field(gt=0)] | None = None
    """Cores that instances may ask for in all; None: all of the machine's."""
    memory_mb: Annotated[int, Field(gt=0)] | None = None
    """None: all of the machine's."""
    python_path: tuple[str, ...] = ()
    """Folders with services that are not installed."""
    environment: dict[str, str] = {}
    """More variables for the services."""
    readable: tuple[Annotated[Path, AfterValidator(_absolute)], ...] = ()
    """More folders and files that services may read, beside the system's, Python's and ``python_path``: models, maps, a
    ROS that is not in /usr or /opt/ros."""
    writable: tuple[Annotated[Path, AfterValidator(_absolute)], ...] = ()
    """More that they may write into, devices such as /dev/video0 among them."""
    groups: tuple[Annotated[int, Field(ge=1, lt=1 << 31)], ...] = ()
    """Numbers of groups that services are in, where each has a user of its own: those that own such files."""
    confined: bool = True
    """Held as far as this machine can (``isolation`` of the site says with what); false: they are the orchestrator's
    user and may do all that it may."""
    log_bytes: Annotated[int, Field(ge=1024)] = 4 << 20
    """Above this a log is cut to its newer half. Looked at once a second: a flood goes over it until then."""
    data_mb: Annotated[int, Field(ge=1)] = 20_480
    """MiB that one robot's services may have written in all; what writes beyond is ended, and nothing is started until
    there is room again. Looked at every two seconds: a fast writer goes over it until then."""

    @model_validator(mode="after")
    def _can_be_reached(self) -> ProcessOptions:
        check_advertised(self.advertise_host or self.bind_host)
        return self


class ProcessRuntime(Runtime):
    """Runs ``python -m ENTRYPOINT`` with the same interpreter."""

    Options = ProcessOptions
    unique = "folder"

    @override
    def __init__(self, site: str, folder: Path, options: Strict) -> None:
        if not isinstance(options, ProcessOptions):
            raise TypeError("options must be ProcessOptions")
        if not sys.platform.startswith("linux"):
            raise RuntimeFailure("the process runtime needs Linux: use a container site")
        self._options = options
        self._machine = this_machine() if self._options.confined else None
        self._readable = readable((*self._options.readable, *map(Path, self._options.python_path)))
        self._closed = [path for path in (folder, self._options.folder) if path]
        for path in self._closed if self._machine else ():
            if by := opened(path, (*self._readable, *map(str, self._options.writable))):
                raise RuntimeFailure(
                    f"services may reach {by}, which holds {path}: keep the orchestrator's state elsewhere"
                )
        if lacks := self._machine.lacks() if self._machine else "":
            log.warning("site %s: %s", site, lacks)
        log.info("site %s: instances are held by: %s", site, ", ".join(self.isolation()) or "nothing")
        if self._options.folder is not None:
            folder = self._options.folder / (self._options.owner or "")
        self._folder = folder / "instances"
        self._data = folder / "data"
        self._folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        self._measured_at = -math.inf
        self._weighed_at = -WEIGH_S
        self._stored: dict[str, int] = {}
        """By robot, as weighed last."""
        self._unweighed: list[str] = []
        """Robots' folders that are still to be weighed, before all of them are again."""
        self._fence = Fence(folder)
        self._runs = Runs(self._folder, self._fence)
        self._runs.all()

    @override
    @classmethod
    def completed(cls, options: dict[str, Any]) -> dict[str, Any]:
        return {"owner": secrets.token_hex(6), **options} if options.get("folder") else options

    @override
    def isolation(self) -> tuple[str, ...]:
        return self._machine.holds() if self._machine else ()

    def refuses(self, spec: ServiceSpec) -> str | None:
        return None if spec.entrypoint else "the service has no entrypoint, only an image: it needs a container site"

    def capacity(self) -> Capacity:
        memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") >> 20
        cpu = self._options.cpu or float(os.cpu_count() or 1)
        machine = platform.machine()
        return Capacity(cpu, self._options.memory_mb or memory, architecture=ARCHITECTURES.get(machine, machine))

    @override
    def load(self) -> float | None:
        return psutil.cpu_percent() / 100

    @override
    def lead(self, epoch: int) -> None:
        self._fence.lead(epoch)
        self._runs.read_anew()

    def start(self, launch: Launch) -> None:
        with self._fence.acting(launch.instance):
            old = self._runs.find(launch.instance, acting=True)
            if old is not None and old.attempt == launch.attempt and old.process is not None:
                return
            if old is not None and old.attempt > launch.attempt and old.lives:
                raise OvertakenError(
                    f"attempt {old.attempt} of {launch.instance} runs: attempt {launch.attempt} is not begun any more"
                )
            if old is not None:
                old.end()
            self._begin(launch, anew=old is None)

    def _begin(self, launch: Launch, *, anew: bool) -> None:
        folder = self._folder / launch.instance
        data = self._data / launch.grant.robot / launch.grant.service / launch.instance
        if full := self._full(launch.grant.robot):
            raise RuntimeFailure(f"robot '{launch.grant.robot}' {full}")
        read = self._read_by(launch.spec)
        try:
            folder.mkdir(mode=0o700, exist_ok=True)
            data.mkdir(mode=0o700, parents=True, exist_ok=True)
            noted = read_json(folder / "run.json")
            port = noted_port(Path(str(noted.get("ready", "")))) or noted_port(folder / "run.json")
            user = self._user_for(folder, noted)
            ready = self._prepare(launch, folder, data, port, user)
            note = {"attempt": launch.attempt, "boot": BOOT_ID, "data": str(data), "port": port, "ready": ready}
            note["user"] = user
            write_private(folder / "run.json", json.dumps(note))
            child = self._spawn(launch.spec, read, folder, data, user)
            process = ProcessId(child.pid, _start_time(child.pid))
            write_private(folder / "run.json", json.dumps({**note, "process": [process.pid, process.start_time]}))
        except OSError as error:
            if anew:
                free_user(str(folder))
            raise RuntimeFailure(f"cannot start {launch.grant.service} on this machine: {error}") from error
        run = Run(launch.attempt, process, str(folder), str(data), ready, user, child)
        self._runs.keep(launch.instance, run)

    def _read_by(self, spec: ServiceSpec) -> list[str]:
        if not (self._machine and spec.launch and spec.launch.startswith("/")):
            return self._readable
        more = launch_file(spec.launch, [*self._readable, *map(str, self._options.writable)], self._closed)
        return [*self._readable, more] if more else self._readable

    def _user_for(self, folder: Path, noted: Mapping[str, Any]) -> int | None:
        """An instance's own, the same in all its runs, so that it can go on with its data; None: there are none."""
        if not (self._machine and self._machine.user):
            return None
        return allocate_user(str(folder), noted_user(noted.get("user")))

    def _prepare(self, launch: Launch, folder: Path, data: Path, port: int | None, user: int | None) -> str:
        """Make the run's own folder, with the grant in it; returns the path of the ready file."""
        own = folder / OWN
        remove_tree(str(own))
        own.mkdir(mode=0o700)
        ready = str(own / "ready.json")
        grant = launch.grant.model_copy(
            update={
                "bind_host": self._options.bind_host,
                "bind_port": _free_or_zero(self._options.bind_host, port),
                "ready_file": ready,
                "data_dir": str(data),
            }
        )
        write_private(own / "grant.json", grant.model_dump_json())
        if user is not None:
            hand_over(str(own), user)
            if data.lstat().st_uid != user:  # new, or from when it had no user of its own
                hand_over(str(data), user)
        return ready

    def _spawn(
        self, spec: ServiceSpec, read: Sequence[str], folder: Path, data: Path, user: int | None
    ) -> subprocess.Popen[bytes]:
        own = str(folder / OWN)
        environment = {name: os.environ[name] for name in _PASSED_ON if name in os.environ}
        environment |= {"PYTHONUNBUFFERED": "1", "HOME": own, "TMPDIR": own, **self._options.environment}
        if self._options.python_path:
            environment["PYTHONPATH"] = os.pathsep.join(self._options.python_path)
        environment[GRANT_VARIABLE] = f"{own}/grant.json"
        # -P: what a service writes into its data folder must not be importable.
        command = [sys.executable, "-P", "-m", str(spec.entrypoint)]
        if self._machine:
            write = [*map(str, self._options.writable), own, str(data)]
            command = confined(command, self._machine, read, write, user, self._options.groups, spec.limits.pids)
        with open(os.open(folder / "log", os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600), "ab") as output:
            return subprocess.Popen(
                command,
                env=environment,
                cwd=data,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                start_new_session=True,
            )

    @override
    def keeps_size(self, spec: ServiceSpec) -> str:
        return ""

    @override
    def resize(self, instance: str, attempt: int, spec: ServiceSpec) -> bool:
        self._fence.must_lead()
        run = self._runs.find(instance)
        return run is not None and run.attempt == attempt and run.lives  # nothing holds it to what it is promised

    def observe(self) -> Mapping[str, Observation]:
        now = time.monotonic()
        if measure := now - self._measured_at >= _MEASURE:
            self._measured_at = now
        runs = self._runs.all()
        all_run = all_children_run()
        return {i: seen for i, run in runs.items() if (seen := self._seen(run, measure=measure, all_run=all_run))}

    @override
    def observe_some(self, instances: Collection[str]) -> Mapping[str, Observation]:
        runs = ((instance, self._runs.find(instance)) for instance in instances)
        return {i: seen for i, run in runs if run and (seen := self._seen(run))}

    def _seen(self, run: Run, *, measure: bool = False, all_run: bool = False) -> Observation | None:
        if not run.ended and (measure or not run.runs_on(all_run)):
            run.seen = self._observe(run)
        return run.seen

    def _observe(self, run: Run) -> Observation:
        if run.beginning:
            return Observation(run.attempt, Phase.STARTING)
        stat = run.process and stat_of(run.process)
        if not stat or stat.zombie:
            status = run.child.poll() if run.child else None
            if run.child and status is None:
                return Observation(run.attempt, Phase.STARTING)  # the kernel is just at it
            line = last_line(Path(run.folder, "log"))
            return Observation(run.attempt, Phase.EXITED, exit_status=status, last_line=line, reports=run.reports()[0])
        port = run.port()
        phase = Phase.RUNNING if port else Phase.STARTING
        host = (self._options.advertise_host or self._options.bind_host) if phase is Phase.RUNNING else None
        reports, step_s = run.reports()
        return Observation(
            run.attempt,
            phase,
            host,
            port,
            exceeds=run.exceeds,
            cpu_s=stat.cpu_s,
            memory_bytes=stat.memory_bytes,
            step_s=step_s,
            reports=reports,
        )

    def stop(self, instance: str, *, force: bool) -> None:
        with self._fence.acting(instance):
            run = self._runs.find(instance, acting=True)
            if run is None or run.process is None:
                return
            if force:
                run.kill()
            elif not run.asked_to_end and stat_of(run.process):
                # Once only: services may take a second signal for impatience.
                run.asked_to_end = True
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(run.process.pid, signal.SIGTERM)

    def remove(self, instance: str) -> None:
        with self._fence.acting(instance):
            run = self._runs.find(instance, acting=True)
            if run is None:
                return
            run.end()
            remove_tree(run.folder)
            self._runs.forget(instance)
            with contextlib.suppress(OSError):  # not empty: then it is worth keeping
                os.removedirs(run.data)

    def logs(self, instance: str, lines: int) -> str:
        with contextlib.suppress(FileNotFoundError), self._log(instance).open("rb") as file:
            file.seek(max(0, os.fstat(file.fileno()).st_size - self._options.log_bytes))
            return b"".join(deque(file, maxlen=lines)).decode(errors="replace")
        return ""

    @override
    def follow(self, instance: str, lines: int) -> LogStream | None:
        path = self._log(instance)

        def ended() -> bool:
            run = self._runs.find(instance)
            return not path.exists() or (run is not None and not run.beginning and not run.lives)

        return None if ended() else FileLog(path, lines, ended)

    def _log(self, instance: str) -> Path:
        # Ids come from the store; the check keeps a mistake elsewhere from reading other folders.
        return self._folder / Path(instance).name / "log"

    def close(self) -> None:
        _left_running.extend(self._runs.living_children())

    def _full(self, robot: str) -> str:
        """Why a robot may write no more here; empty: it may."""
        most, folder = self._options.data_mb, self._data / robot
        size = size_of(str(folder), most << 20)
        self._stored = {**self._stored, robot: most << 20 if size is None else size}
        if size is None:
            return f"has more than {MOST_FILES} files, or too deep ones, in {folder}: delete what is not needed"
        if size > most << 20:
            return f"has more than {most} MiB in {folder} (the site's data_mb): delete what is not needed"
        return ""

    def stored(self) -> Mapping[str, int]:
        return self._stored

    def _weigh_one(self) -> None:
        """One more of the robots of which nothing runs; all at once would keep those waiting that run."""
        if not self._unweighed:
            self._unweighed = folders_in(self._data)
            self._stored = {robot: size for robot, size in self._stored.items() if robot in self._unweighed}
        if self._unweighed:
            self._full(self._unweighed.pop())

    def _weigh(self) -> None:
        """Mark the runs of robots that wrote too much."""
        running = [run for run in self._runs.all().values() if not run.ended and run.data]
        full = {robot: self._full(robot) for robot in {Path(run.data).parents[1].name for run in running}}
        for run in running:
            run.exceeds = full[Path(run.data).parents[1].name]
            own = size_of(f"{run.folder}/{OWN}", _OWN_MB << 20)
            if own is None or own > _OWN_MB << 20:
                run.exceeds = f"has more than {_OWN_MB} MiB, {MOST_FILES} files or too deep ones in its own folder"
            if run.exceeds:
                run.seen = self._observe(run)

    def tidy(self) -> None:
        self._fence.must_lead()
        if time.monotonic() - self._weighed_at >= WEIGH_S:
            self._weigh()
            self._weigh_one()
            self._weighed_at = time.monotonic()
        for instance, run in self._runs.all().items():
            path = f"{run.folder}/log"
            with contextlib.suppress(FileNotFoundError):
                if os.stat(path).st_size > self._options.log_bytes:
                    with self._fence.acting(instance):
                        keep_newer_half(Path(path), self._options.log_bytes // 2)
        self._empty_some()

    def _empty_some(self) -> None:
        """Own folders of runs that have ended, for a while: others wait, and the rest has its turn at the next call."""
        began = time.monotonic()
        for instance, run in self._runs.all().items():
            if run.ended and not run.emptied and time.monotonic() - began < _EMPTY:
                with self._fence.acting(instance):
                    if self._runs.find(instance, acting=True) is run:  # else somebody has begun it anew
                        run.empty()


_left_running: list[subprocess.Popen[bytes]] = []
"""Children that outlive the runtime that started them: the standard library warns of one that is dropped."""


def _start_time(pid: int) -> int:
    stat = ProcessStat.read(pid)
    return stat.start_time if stat else 0


def _free_or_zero(host: str, port: int | None) -> int:
    """The port of the run before, so that its robot finds the next one where it was; 0 if another has it now."""
    if port is None:
        return 0
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind((host, port))
        except OSError:
            return 0
    return port
