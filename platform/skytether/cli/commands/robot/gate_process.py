"""The gate of ``skytether robot run``: the one that runs already, or one of its own that ends with it.

A gate of its own is a process that no signal of the terminal reaches: the agent ends first, then the gate is told to.
If the agent dies, the kernel tells it (``own_gate``). Either way it brakes before it ends.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from math import inf
from pathlib import Path

from skytether.api.config_file import ConfigError
from skytether.guard.claim import guarded
from skytether.guard.estop import LATCH_FILE
from skytether.guard.folder import objection
from skytether.guard.protocol import FIRST_ACT
from skytether.guard.record import lost_at_reboot
from skytether.robot.config.gate_config import load_safety
from skytether.robot.safety.client import GateError, ask, listens
from skytether.robot.safety.config.safety_config import SafetyConfig
from skytether.ros.ros1.arguments import RosArguments

from ...output import console, fail

_OWN_GATE = "skytether.cli.commands.robot.own_gate"
_START_S = 20.0
"""For a gate to listen: it reads the configuration, and becomes another program."""
_END_S = 10.0
"""For it to brake and end."""
_AGAIN_S, _AGAIN_MOST_S = 1.0, 16.0
"""Between two starts of one that ended by itself; twice as long each time that it ends soon: a start takes a second of
a processor, and a robot.yaml that is broken under way stays so until somebody mends it."""
_SOON_S = 10.0
_POLL_S = 0.05
_STRANGE_S = 15.0
"""A gate that was there when we came, and ends so soon after, was the one of an agent that has died."""
_GONE_S = 1.0
"""A guard that listens no more for so long has ended, or is started anew by whoever looks after it."""
_ASSUMED_S = _START_S + _STRANGE_S
"""Whoever starts the robot has looked at it so long ago at most."""
_ASK_S = 3.0

NO_GATE = (
    "there is no gate (safety: none): nothing limits what else is told to the wheels, and if this program is killed, "
    "the last velocity is the last thing that the wheels hear"
)
ASSUMED = (
    "robot.yaml has no section safety: the gate knows limits and silence only, no sensors, joystick or emergency stop "
    "button; docs/safety.md says what to write"
)

NOT_RESET = (
    "this start is no reset, and the robot stands: a stop that a person asked for may have been forgotten ({why}); "
    "look at the robot, then say `skytether robot reset` and `skytether robot start`"
)


def _forgets(safety: SafetyConfig) -> str:
    """Why a stop that was kept may be gone after a reboot; empty: it is not, as far as known."""
    if not lost_at_reboot(str(safety.place() / LATCH_FILE)):
        return ""
    return lost_at_reboot(str(safety.record_file()))


def _there(folder: Path) -> bool:
    """Whether a guard has a folder that can be relied upon; its gate may be on its way."""
    return guarded(str(folder)) and not objection(str(folder))


class OwnGate:
    """A gate that was started here.

    Args:
        config: The robot.yaml.
        safety: Its section.
        assumed: There is none: whoever starts the robot has reset and started it, as far as there is something to.
        words: What else its command line has.
        clock: Monotonic seconds.
    """

    def __init__(
        self,
        config: Path,
        safety: SafetyConfig,
        *,
        assumed: bool,
        words: Sequence[str] = (),
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._arguments = (str(config), *words)
        self._folder = safety.place()
        self._clock = clock
        self._started_at, self._again_s = clock(), _AGAIN_S
        self._assumed_until = self._started_at + _ASSUMED_S if assumed else -inf
        self._forgets = _forgets(safety)
        self._unsaid = ""
        self._process = self._start()

    def wait(self) -> None:
        """Until it listens.

        Raises:
            GateError: It does not; the text says why.
        """
        end = time.monotonic() + _START_S
        while not listens(self._folder):
            status = self._process.poll()
            if status is not None:
                raise GateError(f"the gate ended with status {status}; what it said is above")
            if time.monotonic() > end:
                raise GateError(f"the gate does not listen in {self._folder} after {_START_S:.0f} s")
            time.sleep(_POLL_S)
        if self._clock() < self._assumed_until:
            self._let_go(start=False)

    def ensure_running(self) -> str:
        """Start it again if it has ended by itself. Returns a sentence about that; empty: it runs, or another does."""
        status, now = self._process.poll(), self._clock()
        if status is None:
            if now < self._assumed_until and listens(self._folder) and self._let_go(start=True):
                self._assumed_until = -inf  # that was for this start; from now on a person is asked
            unsaid, self._unsaid = self._unsaid, ""
            return unsaid
        ran = now - self._started_at
        if ran < self._again_s or _there(self._folder):
            return ""
        self._again_s = min(2 * self._again_s, _AGAIN_MOST_S) if ran < self._again_s + _SOON_S else _AGAIN_S
        self._started_at = now
        self._process = self._start()
        return f"the gate ended with status {status}; it is started again"

    def close(self) -> None:
        """Have it brake and end; one that does not is left alone, for it may hold the wheels."""
        self._process.terminate()
        try:
            self._process.wait(_END_S)
        except subprocess.TimeoutExpired:
            console.print(f"the gate (process {self._process.pid}) does not end; it is left as it is", markup=False)

    def _start(self) -> subprocess.Popen[bytes]:
        # -P: whoever may write where the robot was started is not its gate.
        command = [sys.executable, "-P", "-m", _OWN_GATE, str(os.getpid()), *self._arguments]
        return subprocess.Popen(command, stdin=subprocess.DEVNULL, start_new_session=True)

    def _let_go(self, *, start: bool) -> bool:
        """Do what a person who starts the robot does; a stop that somebody asked for stays.

        Where a stop is not kept, that nobody has reset the robot may stand for one that somebody asked for.

        Returns:
            Whether it is done. Of a gate that was not started here nothing is asked.
        """
        with contextlib.suppress(GateError):
            status = ask(self._folder, {"do": "status"}, _ASK_S)
            if status.get("guard_pid") != self._process.pid:  # what is started becomes the guard
                return False
            stopped = status["stopped"]
            if stopped == FIRST_ACT and (self._forgets or not status["kept"]):
                if self._forgets:
                    self._unsaid = NOT_RESET.format(why=self._forgets)
                return bool(self._forgets)  # what is not kept yet may be at the next look
            if stopped == FIRST_ACT:
                ask(self._folder, {"do": "reset", "only": FIRST_ACT}, _ASK_S)
            if start and stopped in ("", FIRST_ACT):
                ask(self._folder, {"do": "start"}, _ASK_S)
            return True
        return False  # it did not answer, or not yet with yes: at the next look again


class FoundGate:
    """A gate that ran already. It may be that of an agent that was killed a moment ago, and brakes before it ends.

    Args:
        config: The robot.yaml.
        safety: Its section.
        assumed: See `OwnGate`.
        make: Starts another one.
        there: Whether a guard listens in the folder; its gate may be on its way.
        clock: Monotonic seconds.
    """

    def __init__(
        self,
        config: Path,
        safety: SafetyConfig,
        *,
        assumed: bool,
        make: Callable[..., OwnGate] = OwnGate,
        there: Callable[[Path], bool] = _there,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._config = config
        self._safety = safety
        self._assumed = assumed
        self._make = make
        self._there = there
        self._clock = clock
        self._end = clock() + _STRANGE_S
        self._gone_at: float | None = None
        self._own: OwnGate | None = None

    def ensure_running(self) -> str:
        """Start one if it has ended. Returns a sentence about that; empty: it runs."""
        if self._own is not None:
            return self._own.ensure_running()
        now = self._clock()
        if self._there(self._safety.place()):
            self._gone_at = None
            return ""
        self._gone_at = now if self._gone_at is None else self._gone_at
        if self._gone_at > self._end or now - self._gone_at < _GONE_S:
            return ""
        self._own = self._make(self._config, self._safety, assumed=self._assumed)
        return "the gate that ran here has ended: it was that of another agent; one of our own is started"

    def close(self) -> None:
        """Have the one that was started end."""
        if self._own is not None:
            self._own.close()


def other_wheels(config: Path, folder: Path, ros: RosArguments) -> str:
    """Whether the gate that runs in a folder is another robot's: a sentence; empty: it is this one's, or hangs.

    Raises:
        ConfigError: The gate's part of the file is wrong.
    """
    ours = load_safety(config, ros).frozen().wheels_at()
    try:
        theirs = ask(folder, {"do": "status"}, _ASK_S)["wheels"]
    except (GateError, KeyError, OSError):
        return ""
    if theirs == ours:
        return ""
    return (
        f"the gate that runs in {folder} has other wheels ({theirs}) than robot.yaml says ({ours}); if it is another "
        "robot's, name a folder of this one's own: safety.folder, or SKYTETHER_GATE_FOLDER"
    )


@contextmanager
def gate(
    config: Path, safety: SafetyConfig | None, *, assumed: bool, ros: RosArguments
) -> Iterator[OwnGate | FoundGate | None]:
    """See that there is a gate for as long as the context lasts; None: there is to be none.

    Args:
        config: The robot.yaml.
        safety: Its section; None: there is to be no gate.
        assumed: The section is not written.
        ros: What ROS gave on the command line.
    """
    if safety is None:
        console.print(f"warning: {NO_GATE}", style="yellow", markup=False, soft_wrap=True)
        yield None
        return
    if _there(safety.place()):
        try:
            strange = other_wheels(config, safety.place(), ros)
        except (ConfigError, OSError) as error:
            fail(str(error), 2)
        if strange:
            fail(strange)
        console.print(f"gate: uses the one that runs in {safety.place()}", markup=False, soft_wrap=True)
        make = partial(OwnGate, words=ros.words)
        found = FoundGate(config, safety, assumed=assumed, make=make)
        try:
            yield found
        finally:
            found.close()
        return
    if assumed:
        console.print(f"warning: {ASSUMED}", style="yellow", markup=False, soft_wrap=True)
    own = OwnGate(config, safety, assumed=assumed, words=ros.words)
    try:
        try:
            own.wait()
        except GateError as error:
            if not _there(safety.place()):  # else another one was faster
                fail(str(error))
        yield own
    finally:
        own.close()
