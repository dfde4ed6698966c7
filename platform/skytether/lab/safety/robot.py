"""A robot whose hardware is played in this process: wheels that remember, a laser, a joystick, a button.

Guard, gate and agent are the real ones, in processes of their own, to be killed, frozen and starved. Whatever becomes
of them, `PlayedRobot.close` ends them all, found by a mark in their environment.
"""

from __future__ import annotations

import json
import math
import os
import secrets
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, suppress
from pathlib import Path
from signal import SIGKILL
from types import TracebackType
from typing import Any

import numpy as np
import psutil
import yaml

from skytether.guard.clock import now
from skytether.guard.velocity import STANDSTILL, Velocity
from skytether.messages import Bool, Header, Joy, LaserScan, Time
from skytether.robot.safety.client import GateError, ask
from skytether.robot.safety.config.safety_config import SafetyConfig

from .socket_hardware import Hardware, SocketHardware

LIMITS: Mapping[str, float] = {"linear_max": 0.5, "linear_min": -0.1, "angular_max": 0.8}
"""Of the wheels and of the agent."""
WANTED = Velocity(0.5, 0.3)
"""What the agent wants all the time."""
SAFETY: Mapping[str, Any] = {
    "footprint": {"radius": 0.3},
    "limits": LIMITS,
    "zones": {"slow_speed": 0.1},
    "sensors": {"scan": {"max_age_s": 0.3}},
    "joystick": {"deadman": 0, "linear_axis": 0, "angular_axis": 1},
    "estop": {"max_age_s": 0.5},
}
"""The section of robot.yaml: defaults, but for what has none."""

PATIENCE_S = 30.0
"""For what is expected to happen at some time."""
_LOOK_S = 0.01
_SENSE_S = 0.04
"""Between readings: 25 Hz."""
_FRESH_S = 0.2
"""What the wheels were told longer ago than this is no motion."""
_ASK_AGAIN_S = 0.2
_MARK = "SKYTETHER_PLAYED_ROBOT"
RAYS = 360
"""Of the laser, all around."""

Scan = Callable[[], LaserScan | None]


class StagingError(Exception):
    """What was to be shown did not come about; the text says what, with the end of the log."""


class PlayedRobot:
    """Hardware here, guard and agent beside it. A context manager: leaving ends everything.

    Args:
        folder: For sockets, log and configuration; must be there.
        safety: Keys of the section ``safety`` that differ from `SAFETY`.
        output: Descriptor for what the processes print; None: the file ``log`` in the folder.
        before: Run in each process before its program; for limits of its own.
        drive: False: there is no agent.
        hardware: Makes wheels and sensors, given the folder of the gate's sockets.
    """

    def __init__(
        self,
        folder: Path,
        safety: Mapping[str, Any] | None = None,
        *,
        output: int | None = None,
        before: Callable[[], None] | None = None,
        drive: bool = True,
        hardware: Callable[[Path], Hardware] = SocketHardware,
    ) -> None:
        self.folder = folder / "run"
        self.folder.mkdir(exist_ok=True)
        self.log = folder / "log"
        self.scan: Scan | None = self.clear
        """What the laser sends; None: nothing at all."""
        self.pressed: bool | None = False
        """The button; None: it is silent."""
        self.pad: Callable[[], Joy] | None = None
        """What the joystick sends; None: nothing."""
        self._undo = ExitStack()
        self._file = folder / "robot.yaml"
        self._output = output
        self._before = before
        self._mark = secrets.token_hex(8)
        self._ended = threading.Event()
        try:
            self.hardware = hardware(self.folder)
            self._undo.callback(self.hardware.close)
            self.record = self.hardware.record
            section = {**SAFETY, **self.hardware.section, **(safety or {}), "folder": str(self.folder)}
            self.config = SafetyConfig.model_validate(section)
            self._file.write_text(yaml.safe_dump({"safety": _plain(section)}))
            self._undo.callback(self._end_processes)
            self._sensing = threading.Thread(target=self._sense, name="sensors")
            self._sensing.start()
            self._undo.callback(self._sensing.join)
            self._undo.callback(self._ended.set)
            self.guard = self.start_guard()
            self.agent: subprocess.Popen[bytes] | None = self.start_agent() if drive else None
        except BaseException:
            self._undo.close()
            raise

    def __enter__(self) -> PlayedRobot:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """End everything, for certain."""
        self._undo.close()

    # Processes

    def start_guard(self) -> subprocess.Popen[bytes]:
        """Start guard and gate, as people do."""
        self.guard = self._start("skytether.cli", "robot", "gate", str(self._file))
        return self.guard

    def start_agent(self) -> subprocess.Popen[bytes]:
        """Start the agent, which wants `WANTED`."""
        self.agent = self._start("skytether.lab.safety.agent", str(self.folder), json.dumps(WANTED))
        return self.agent

    def pid(self, role: str) -> int:
        """The process of ``agent``, ``guard``, ``gate`` or ``writer``.

        Raises:
            StagingError: There is none.
        """
        own = {"agent": self.agent, "guard": self.guard}.get(role)
        if own is not None:
            return own.pid
        found = [process.pid for process in self.processes() if _role(process) == role]
        if not found:
            raise StagingError(f"there is no process of the {role}")
        return found[-1]

    def signal(self, role: str, number: int) -> int:
        """Send a signal to a process; its id."""
        pid = self.pid(role)
        self.kill(pid, number)
        return pid

    def helper(self, module: str, *arguments: str) -> subprocess.Popen[bytes]:
        """Start another program beside them, which ends with the robot at the latest."""
        return self._start(module, *arguments)

    def kill(self, pid: int, number: int = SIGKILL) -> None:
        """Send a signal to a process that may have ended by itself meanwhile."""
        with suppress(ProcessLookupError):
            os.kill(pid, number)
        if number == SIGKILL:
            self._reap(pid)

    def alive(self, role: str) -> bool:
        """Whether a process is there."""
        own = {"agent": self.agent, "guard": self.guard}.get(role)
        if own is not None:
            return own.poll() is None
        return any(_role(process) == role for process in self.processes())

    def processes(self) -> Iterator[psutil.Process]:
        """All that belong to this robot, zombies excepted."""
        for process in psutil.process_iter():
            with suppress(psutil.Error):
                if process.status() != psutil.STATUS_ZOMBIE and process.environ().get(_MARK) == self._mark:
                    yield process

    # What people do

    def ask(self, do: str, **more: Any) -> dict[str, Any]:
        """Put a request to the gate.

        Raises:
            GateError: It does not answer, or says no.
        """
        return ask(self.folder, {"do": do, **more})

    def stop(self, reason: str) -> None:
        """Emergency stop; returns when it is acknowledged.

        Raises:
            GateError: It is not.
        """
        self.ask("stop", reason=reason)

    def reset(self) -> None:
        """Reset, as soon as the gate takes it."""

        def taken() -> bool:
            try:
                self.ask("reset")
            except GateError:
                return False
            return True

        self.wait(taken, "the reset is taken", _ASK_AGAIN_S)

    def start(self) -> None:
        """Let the agent's commands be followed again, after a reset."""
        with suppress(GateError):
            self.ask("start")

    def go(self) -> None:
        """Start what has ended, reset and start until the robot drives as the agent wants."""
        if self.guard.poll() is not None:
            self.start_guard()
        if self.agent is not None and self.agent.poll() is not None:
            self.start_agent()
        asked = 0.0

        def drives() -> bool:
            nonlocal asked
            if self.drives():
                return True
            if now() - asked > _ASK_AGAIN_S:
                with suppress(GateError):
                    if self.ask("status")["stopped"]:
                        self.ask("reset")
                    self.ask("start")
                asked = now()
            return False

        self.wait(drives, "the robot drives")

    def another_gate(self, dead: int) -> None:
        """Wait until a gate answers that is not the one with this process id."""

        def answers() -> bool:
            try:
                return int(self.ask("status")["pid"]) != dead
            except GateError:
                return False

        self.wait(answers, "another gate answers", _ASK_AGAIN_S)

    # What happens

    @property
    def velocity(self) -> Velocity:
        """What the wheels were told a moment ago; standstill if nothing."""
        newest = self.record.last
        return newest.velocity if now() - newest.at < _FRESH_S else STANDSTILL

    def drives(self) -> bool:
        """Whether the wheels do what the agent wants, nearly."""
        return self.velocity.linear > 0.9 * WANTED.linear

    def wait(self, condition: Callable[[], bool], what: str, look_s: float = _LOOK_S) -> None:
        """Wait until something is so.

        Raises:
            StagingError: It is not, after `PATIENCE_S`.
        """
        end = now() + PATIENCE_S
        while not condition():
            if now() > end:
                log = self.log.read_text(errors="replace")[-2000:] if self.log.exists() else ""
                raise StagingError(f"not within {PATIENCE_S:g} s: {what}\n{log}")
            time.sleep(look_s)

    # Hardware

    def clear(self) -> LaserScan:
        """Nothing within 5 m, all around."""
        return scan_of(np.full(RAYS, 5.0, dtype=np.float32))

    def _sense(self) -> None:
        while not self._ended.wait(_SENSE_S):
            scan, pressed, pad = self.scan, self.pressed, self.pad
            if scan is not None and (seen := scan()) is not None:
                self.hardware.send("scan", seen)
            if pressed is not None:
                self.hardware.send("estop", Bool(pressed))
            if pad is not None:
                self.hardware.send("joy", pad())

    def _start(self, module: str, *arguments: str) -> subprocess.Popen[bytes]:
        with self.log.open("ab") as log:
            output = log.fileno() if self._output is None else self._output
            return subprocess.Popen(
                [sys.executable, "-P", "-m", module, *arguments],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                env={**os.environ, _MARK: self._mark},
                preexec_fn=self._before,
                start_new_session=True,
            )

    def _reap(self, pid: int) -> None:
        for own in (self.guard, self.agent):
            if own is not None and own.pid == pid:
                own.wait()

    def _end_processes(self) -> None:
        while left := list(self.processes()):  # again: a guard may have started a gate meanwhile
            for process in left:
                with suppress(psutil.Error):
                    process.kill()
            psutil.wait_procs(left, timeout=1)
        for own in (getattr(self, "guard", None), getattr(self, "agent", None)):
            if own is not None:
                own.wait()


def scan_of(
    ranges: np.ndarray[Any, np.dtype[np.float32]], step: float = 0.0, age_s: float = 0.0, wall_s: float | None = None
) -> LaserScan:
    """A laser's message; its first ray looks backward.

    Args:
        ranges: [m].
        step: From one ray to the next [rad]; 0: one degree.
        age_s: How long ago it was taken [s].
        wall_s: The time now [s]; None: of this machine.
    """
    wall = (time.time_ns() if wall_s is None else int(wall_s * 1e9)) - int(age_s * 1e9)
    return LaserScan(
        header=Header(stamp=Time(wall // 10**9, wall % 10**9), frame_id="laser"),
        angle_min=-math.pi,
        angle_max=-math.pi + (len(ranges) - 1) * (step or 2 * math.pi / RAYS),
        angle_increment=step or 2 * math.pi / RAYS,
        range_min=0.05,
        range_max=8.0,
        ranges=ranges,
    )


def _role(process: psutil.Process) -> str:
    """``gate`` of ``python -m some.package.gate``."""
    words = process.cmdline()
    return words[words.index("-m") + 1].rpartition(".")[2] if "-m" in words[:-1] else ""


def _plain(section: Mapping[str, Any]) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(json.dumps(section, default=dict))
    return found
