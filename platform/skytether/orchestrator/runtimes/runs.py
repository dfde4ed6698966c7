"""The runs at a process site, as its folders have them now, whoever began them.

Several orchestrators may have the same site open. So what is known of a run is read again wherever its note
(``run.json``) is another than the one that was read; to see that costs one call of the kernel.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from skytether.api.grant import GRANT_VARIABLE
from skytether.api.service_report import FILE_NAME, ServiceReport, pull_reports, pull_step_s

from .base import Observation, Phase, RuntimeFailure
from .disk import remove_tree, size_of
from .fence import Fence
from .notes import noted_port, read_json, write_private
from .procfs import BOOT_ID, ProcessId, find_by_environment, session_members, stat_of, user_of
from .users import end_all_of, free_user, keep_user, noted_user

OWN = "own"
"""A run's own folder, in that of its instance."""
_TOLD_BYTES = 1 << 20
"""On disk, of what a run has told, at most."""
_PASSES = 20
"""Looks at a session that is being ended: whoever forks meanwhile is in the next one."""
_WHOLE = 1.0
"""Seconds between two looks at all notes, where no folder came or went."""
END_S = 5.0
"""Seconds that a killed process gets to be gone."""

Stamp = tuple[int, int, int]
"""Which file it was: inode, time of change [ns], size."""


@dataclass
class Run:
    """The latest run of one instance."""

    attempt: int
    process: ProcessId | None
    folder: str
    """Of the instance; all that is looked at again and again is named by text, for paths are slow to put together."""
    data: str = ""
    """Folder for what the service produces."""
    ready_file: str = ""
    user: int | None = None
    """Whose process it is, where it has one of its own."""
    child: subprocess.Popen[bytes] | None = None
    """None for one that another orchestrator started."""
    note: Stamp | None = None
    """The note that it was read from; None: there is none."""
    beginning: bool = False
    """Another orchestrator is just at it: it may have a process in a moment, which is not noted yet."""
    asked_to_end: bool = False
    exceeds: str = ""
    """What it took more of than it may."""
    seen: Observation | None = None
    """As it was when it was read last."""
    ready: tuple[Stamp, int] | None = None
    """Which ready file was read, and its port."""
    reported: tuple[Stamp, tuple[ServiceReport, ...], float | None] | None = None
    """Which file of reports was read, what is in it, and how long it says that steps take [s]."""
    emptied: bool = False
    """Of what it left in its own folder."""

    @property
    def ended(self) -> Observation | None:
        """Its end, which cannot change any more; nothing on the machine does. None: it has not."""
        return self.seen if self.seen and self.seen.phase is Phase.EXITED else None

    @property
    def lives(self) -> bool:
        """Whether its process is there now."""
        stat = self.process and stat_of(self.process)
        return bool(stat and not stat.zombie)

    def runs_on(self, all_run: bool) -> bool:
        """A child that was running, and has not ended since: one system call tells, or that no child has ended."""
        if not (self.seen and self.seen.phase is Phase.RUNNING and self.child):
            return False
        return (self.child.returncode if all_run else self.child.poll()) is None

    def port(self) -> int | None:
        """Where it listens; its ready file is read again where it was written again."""
        written = _stamp(self.ready_file)
        if written is None:
            return None
        if self.ready is None or self.ready[0] != written:
            port = noted_port(Path(self.ready_file))
            self.ready = None if port is None else (written, port)
        return self.ready[1] if self.ready else None

    def reports(self) -> tuple[tuple[ServiceReport, ...], float | None]:
        """What it reported, and how long it says that steps take [s]; read again where it was written again."""
        path = f"{os.path.dirname(self.ready_file)}/{FILE_NAME}"
        written = _stamp(path)
        if written is None:
            return (), None
        if self.reported is None or self.reported[0] != written:
            document = read_json(Path(path))
            self.reported = written, pull_reports(document), pull_step_s(document)
        return self.reported[1:]

    def empty(self) -> None:
        """End what it left behind once it has ended, and remove its own folder's content, but for what it told.

        The instance is kept for a day, so that people can ask for its log: so long its home and its temporary files
        would count for nobody, however large, and its grant would be there to be read.
        """
        own = f"{self.folder}/{OWN}"
        told = [Path(own, os.path.basename(self.ready_file)), Path(own, FILE_NAME)]
        with contextlib.suppress(OSError):  # its folder is gone, or the disk is full
            size = size_of(own, _TOLD_BYTES)
            if size is None or size > _TOLD_BYTES or not {*os.listdir(own)} <= {path.name for path in told}:
                self.kill()  # what its main process left behind would write on
                documents = [(path, read_json(path)) for path in told]
                remove_tree(own)
                os.mkdir(own, 0o700)
                for path, document in documents:
                    if document:
                        write_private(path, json.dumps(document))
        self.emptied = True

    def kill(self) -> None:
        """Kill it and everything in its session, and of its own user: it may have left the session."""
        if self.process is None:
            return
        ended: set[int] = set()
        for _ in range(_PASSES):
            found = {*session_members(self.process)} - ended
            if not found:
                break
            ended |= found
            for pid in found:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
        if self.user is not None:  # last: a run that was just being started was root until then
            end_all_of(self.user)

    def end(self) -> None:
        """The same, and wait until it is gone.

        Raises:
            RuntimeFailure: It does not go, as one that waits for a broken disk.
        """
        self.kill()
        deadline = time.monotonic() + END_S
        while self.lives:
            if time.monotonic() > deadline:
                pid = self.process.pid if self.process else 0
                raise RuntimeFailure(f"the run before (process {pid}) cannot be ended: see what it waits for")
            time.sleep(0.002)
        if self.child is not None:
            with contextlib.suppress(subprocess.TimeoutExpired):
                self.child.wait(END_S)


class Runs:
    """All runs of a site. From any thread."""

    def __init__(self, folder: Path, fence: Fence, clock: Callable[[], float] = time.monotonic) -> None:
        """``folder``: has one folder for each instance; ``clock``: seconds."""
        self._clock = clock
        self._folder = str(folder)
        self._fence = fence
        self._lock = threading.RLock()
        self._known: dict[str, Run] = {}
        self._replaced: list[subprocess.Popen[bytes]] = []
        """Our children whose instances another orchestrator has removed or started anew; to be waited for."""
        self._found: dict[str, Run] = {}
        """All of them when all were read last."""
        self._listed: Stamp | None = None
        self._read_at = -math.inf

    def all(self) -> dict[str, Run]:
        """By instance. What another orchestrator began or removed is seen at once, what it began anew within 1 s."""
        with self._lock:
            now, listed = self._clock(), _stamp(self._folder)
            if listed != self._listed or now - self._read_at >= _WHOLE:
                self._found = self._find_all()
                # Of those that are just begun or removed more is known in a moment.
                settled = len(self._found) == len(self._known) and not any(
                    run.beginning for run in self._found.values()
                )
                self._listed, self._read_at = listed if settled else None, now
            self._replaced = [child for child in self._replaced if child.poll() is None]
            return dict(self._found)

    def _find_all(self) -> dict[str, Run]:
        names = os.listdir(self._folder)
        names += self._known.keys() - set(names)  # those are forgotten, if nobody has begun them anew
        return {name: run for name in names if (run := self.find(name))}

    def find(self, instance: str, *, acting: bool = False) -> Run | None:
        """One of them; None: there is none, or only a folder that another orchestrator is just filling or emptying.

        Args:
            instance: Its id.
            acting: It is called by an act on the instance, so nobody else is at it.
        """
        folder = f"{self._folder}/{instance}"
        with self._lock:
            known = self._known.get(instance)
            stamp = _stamp(f"{folder}/run.json")
            if known is not None and stamp is not None and known.note == stamp and not known.beginning:
                return known
            if stamp is None and not os.path.isdir(folder):
                if known is not None and known.lives:
                    return known  # its folder was taken from under it: whoever removes a run ends it first
                self._forget(instance)
                return None
            run = self._read(Path(folder), instance, acting=acting)
            self.keep(instance, run)
            return None if run.beginning and run.note is None else run

    def keep(self, instance: str, run: Run) -> None:
        """This is the instance's run now."""
        with self._lock:
            known = self._known.get(instance)
            if known is not None and known.child is not None and run.child is None:
                if run.process == known.process:
                    run.child, run.asked_to_end = known.child, known.asked_to_end
                else:
                    self._let_go_of(known.child)
            self._known[instance] = run
            self._listed = None

    def read_anew(self) -> None:
        """Whatever is known, the next look reads all notes."""
        with self._lock:
            self._listed = None

    def forget(self, instance: str) -> None:
        """It was removed."""
        with self._lock:
            self._forget(instance)

    def _forget(self, instance: str) -> None:
        run = self._known.pop(instance, None)
        if run is not None and run.child is not None:
            self._let_go_of(run.child)
        free_user(f"{self._folder}/{instance}")

    def _let_go_of(self, child: subprocess.Popen[bytes]) -> None:
        if child.poll() is None:
            self._replaced.append(child)

    def living_children(self) -> list[subprocess.Popen[bytes]]:
        """Ours, of all runs."""
        with self._lock:
            children = [run.child for run in self._known.values() if run.child] + self._replaced
            return [child for child in children if child.poll() is None]

    def _read(self, folder: Path, instance: str, *, acting: bool) -> Run:
        note = folder / "run.json"
        while True:
            stamp = _stamp(str(note))
            noted = read_json(note)
            process = _noted_process(noted)
            beginning = not acting and "process" not in noted and self._fence.busy(instance)
            if beginning or noted.get("boot", BOOT_ID) != BOOT_ID:
                process = None
            elif process is None:
                # The orchestrator was killed between launch and note, or the note was broken or taken away since: the
                # process is known by its grant.
                process = find_by_environment(GRANT_VARIABLE, str(folder / OWN / "grant.json"))
                if process is not None and acting:
                    found = {"boot": BOOT_ID, **noted, "process": [process.pid, process.start_time]}
                    write_private(note, json.dumps(found))
                    stamp = _stamp(str(note))
            if _stamp(str(note)) == stamp:
                break
        user = None
        if process is not None:
            noted_or_seen = noted["user"] if "user" in noted else user_of(process)
            user = keep_user(str(folder), noted_user(noted_or_seen))
        ready = str(noted.get("ready", folder / OWN / "ready.json"))
        data = str(noted.get("data", ""))
        attempt = noted.get("attempt")
        # Without its note a run is of no attempt: it is no start that was asked for, and is ended before the next one.
        attempt = attempt if type(attempt) is int else 0
        return Run(attempt, process, str(folder), data, ready, user, note=stamp, beginning=beginning)


def _noted_process(noted: Mapping[str, object]) -> ProcessId | None:
    """None: the note names none, or was broken."""
    match noted.get("process"):
        case [int(pid), int(start_time)] if pid > 0:
            return ProcessId(pid, start_time)
    return None


def _stamp(path: str) -> Stamp | None:
    try:
        stat = os.stat(path, follow_symlinks=False)
    except OSError:
        return None
    return stat.st_ino, stat.st_mtime_ns, stat.st_size
