"""Attacks on what processes need: the gate's sockets are flooded, cores, descriptors, memory, disk and log run out."""

from __future__ import annotations

import os
import resource
import signal
import socket
import subprocess
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import psutil

from .attacks import Attacks
from .cores import busy_cores
from .robot import PlayedRobot
from .small_disk import small_disk
from .stage import Stage

_FLOOD_S = 2.0
_ACKNOWLEDGED_S = 0.5
_MANY_CLIENTS = 300
_MORE_FILES = 64
"""Than are open: many times what guard and gate need, far fewer than there are clients."""
_LITTLE_MEMORY = 4 * 1024 * 1024
_DISK_BYTES = 256 * 1024
_PAGE = 4096


def enter(attacks: Attacks) -> None:
    """Add them."""
    attacks.add("flood-mad-agent", "an agent gone mad: 5 m/s, NaN, to and fro, as fast as it can", _mad, seconds=5)
    for kind, what in (
        ("commands", "bytes that are no commands"),
        ("readings", "bytes that are no readings"),
        ("stops", "bytes that are no word of a button"),
        ("scans", "scans of 20,000 rays"),
        ("clients", "clients who ask nonsense or nothing"),
    ):
        attacks.add(f"flood-{kind}", f"{what}, as fast as somebody can, and then a stop", _flood(kind), seconds=4)
    attacks.add("starve-cores", "all cores taken; the agent is frozen for 1 s", _cores, seconds=5)
    attacks.add(
        "starve-clients",
        f"{_MANY_CLIENTS} clients hold the gate's descriptors, and then a stop",
        _clients,
        seconds=3,
    )
    attacks.add(
        "starve-descriptors",
        "the guard gets no descriptor more, and the gate is killed",
        _descriptors,
        seconds=5,
    )
    attacks.add(
        "starve-memory",
        "the gate gets no memory more while large scans come, and the agent is killed",
        _memory,
        seconds=6,
        spoils=True,
    )
    attacks.add(
        "pipe-full",
        "nobody reads the log; gate and agent are killed, a stop",
        _mute,
        seconds=12,
        robot=_unread,
        spoils=True,
    )
    attacks.add(
        "disk-full", "the disk is full; a stop, the gate is killed", _full, seconds=9, robot=_small_disk, spoils=True
    )


@contextmanager
def _flooding(stage: Stage, kind: str) -> Iterator[subprocess.Popen[bytes]]:
    flood = stage.robot.helper("skytether.lab.safety.flood", kind, str(stage.robot.folder), str(_FLOOD_S))
    try:
        yield flood
    finally:
        flood.kill()
        flood.wait()


def _mad(stage: Stage) -> None:
    stage.robot.signal("agent", signal.SIGKILL)
    with _flooding(stage, "mad-agent") as flood:
        stage.sleep(_FLOOD_S)
        with stage.stands(stage.promised.agent, "the flood of a mad agent was over"):
            flood.kill()
            stage.sleep(1.0)


def _flood(kind: str) -> Callable[[Stage], None]:
    def run(stage: Stage) -> None:
        with _flooding(stage, kind):
            stage.sleep(_FLOOD_S / 2)
            with stage.stands(stage.promised.stop, f"a stop during a flood of {kind}"):
                stage.timed(stage.stop, "the stop is acknowledged", _ACKNOWLEDGED_S)
                stage.sleep(_FLOOD_S / 2)

    return run


def _cores(stage: Stage) -> None:
    with busy_cores():
        stage.sleep(1.0)
        with stage.stands(stage.promised.agent, "the agent was frozen, with all cores taken"):
            agent = stage.robot.signal("agent", signal.SIGSTOP)
            stage.sleep(1.0)
        stage.robot.kill(agent, signal.SIGCONT)
        stage.drives_on("the robot drives on with all cores taken")


def _clients(stage: Stage) -> None:
    with ExitStack() as undo:
        for role in ("guard", "gate"):
            undo.enter_context(_descriptors_limited(stage.robot.pid(role), _MORE_FILES))
        for path in (stage.robot.folder / "control.sock", stage.robot.folder / "stop.sock"):
            for _ in range(_MANY_CLIENTS if path.exists() else 0):
                client = undo.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET))
                client.setblocking(False)
                with suppress(OSError):
                    client.connect(str(path))
        with stage.stands(stage.promised.stop, f"a stop beside {_MANY_CLIENTS} clients"):
            stage.timed(stage.stop, "the stop is acknowledged", _ACKNOWLEDGED_S)
            stage.sleep(0.7)


def _descriptors(stage: Stage) -> None:
    with (
        _descriptors_limited(stage.robot.pid("guard"), 0),
        stage.stands(stage.promised.partner, "the gate was killed while the guard could open nothing"),
    ):
        stage.robot.signal("gate", signal.SIGKILL)
        stage.sleep(2.0)


@contextmanager
def _descriptors_limited(pid: int, more: int) -> Iterator[None]:
    """A process may open only so many files more."""
    before = resource.prlimit(pid, resource.RLIMIT_NOFILE)
    most = psutil.Process(pid).num_fds() + more
    resource.prlimit(pid, resource.RLIMIT_NOFILE, (most, before[1]))
    try:
        yield
    finally:
        with suppress(ProcessLookupError):
            resource.prlimit(pid, resource.RLIMIT_NOFILE, before)


def _memory(stage: Stage) -> None:
    gate = psutil.Process(stage.robot.pid("gate"))
    most = gate.memory_info().vms + _LITTLE_MEMORY
    resource.prlimit(gate.pid, resource.RLIMIT_AS, (most, most))
    with _flooding(stage, "scans"):
        stage.sleep(1.0)
    with stage.stands(stage.promised.agent, "the agent was killed while the gate had no memory"):
        stage.robot.signal("agent", signal.SIGKILL)
        stage.sleep(1.0)


@contextmanager
def _unread(folder: Path, safety: Mapping[str, Any]) -> Iterator[PlayedRobot]:
    """Processes whose output goes into a pipe that is full from the start and that nobody reads."""
    unread, output = os.pipe()
    os.set_blocking(output, False)
    with suppress(BlockingIOError):
        while True:
            os.write(output, bytes(_PAGE))
    with suppress(BlockingIOError):
        while True:
            os.write(output, b"\0")
    os.set_blocking(output, True)
    try:
        with PlayedRobot(folder, safety, output=output) as robot:
            yield robot
    finally:
        os.close(unread)
        os.close(output)


def _mute(stage: Stage) -> None:
    robot = stage.robot
    robot.signal("gate", signal.SIGKILL)
    stage.sleep(0.5)
    robot.go()  # the agent's writes failed meanwhile, of which it had something to say
    with stage.stands(stage.promised.stop, "a stop, and nobody reads the log"):
        stage.stop()
        stage.sleep(0.7)
    robot.go()
    with stage.stands(stage.promised.agent, "the agent was killed, and nobody reads the log"):
        robot.signal("agent", signal.SIGKILL)
        stage.sleep(0.7)


@contextmanager
def _small_disk(folder: Path, safety: Mapping[str, Any]) -> Iterator[PlayedRobot]:
    """On a disk of its own, where that is permitted; else no file of the processes may become larger than it is."""
    with ExitStack() as undo:
        before: Callable[[], None] | None = None
        try:
            undo.enter_context(small_disk(folder, _DISK_BYTES))
        except OSError:
            before = _no_room
        yield undo.enter_context(PlayedRobot(folder, safety, before=before))


def _no_room() -> None:
    resource.setrlimit(resource.RLIMIT_FSIZE, (_PAGE, _PAGE))


def _full(stage: Stage) -> None:
    robot = stage.robot
    with suppress(OSError), (robot.folder.parent / "fill").open("wb", buffering=0) as file:
        while file.tell() < 4 * _DISK_BYTES:
            file.write(bytes(_PAGE))
    stage.sleep(0.5)
    with stage.stands(stage.promised.stop, "a stop with a full disk, and the gate was killed"):
        stage.stop()
        stage.sleep(0.5)
        gate = robot.signal("gate", signal.SIGKILL)
        robot.another_gate(gate)
        stage.sleep(0.7)
    robot.go()
    with stage.stands(stage.promised.agent, "the agent was killed with a full disk"):
        robot.signal("agent", signal.SIGKILL)
        stage.sleep(0.7)
