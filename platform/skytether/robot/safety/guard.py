"""The guard: owns the wheels, starts the gate, and stops the wheels whenever the gate does not say at once what to do.

It is small so that there is little in it to fail: it reads no sensor, no command, no file. What the gate sends is taken
if it is fresh, a number and within the limits; else the robot brakes. A gate that ended or hangs is started anew.
"""

from __future__ import annotations

import fcntl
import logging
import select
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from math import isfinite
from typing import IO

from skytether.control.admittance import STANDSTILL, Velocity
from skytether.guard.clock import now as boottime
from skytether.robot.notices import Notices
from skytether.robot.supervisor import Limits

from . import kinematics as reach
from .config import SafetyConfig
from .hardware import Wheels
from .process import Systemd
from .protocol import Beat, unpack_beat

_log = logging.getLogger("skytether.guard")

_HANGS_S = 3.0
"""A gate that says nothing for this long is ended and started anew."""
_STARTS_S = 15.0
"""A gate may take this long to say its first word."""
_AGAIN_S = 1.0
"""Between starts of the gate."""
_END_S = 2.0
_LAST_STOPS = 5
_ROUNDING = 1e-6


class GuardError(Exception):
    """The guard cannot start; the text says why and what to do."""


class Watch:
    """What the wheels are told. Pure: time is an argument.

    Args:
        limits: Of the wheels.
        max_age_s: Of what the gate said.
    """

    def __init__(self, limits: Limits, max_age_s: float) -> None:
        self.velocity = STANDSTILL
        """What the wheels were last told."""
        self._limits = limits
        self._max_age_s = max_age_s
        self._beat: Beat | None = None
        self._now: float | None = None

    def hear(self, beat: Beat) -> None:
        """Take in what the gate says."""
        self._beat = beat

    def look(self, now: float) -> str:
        """Decide what the wheels are told now: `velocity`.

        Returns:
            What is wrong with the gate; empty: nothing.
        """
        limits = self._limits
        dt = limits.period_s if self._now is None else min(max(0.0, now - self._now), limits.max_step_s)
        self._now = now
        wrong = self._wrong(now)
        if wrong or self._beat is None:
            self.velocity = reach.brake_on_curve(limits, self.velocity, dt or limits.period_s)
        else:
            self.velocity = self._beat.velocity
        return wrong

    def _wrong(self, now: float) -> str:
        beat, limits = self._beat, self._limits
        if beat is None or not 0 <= now - beat.at + _ROUNDING <= self._max_age_s:
            return "says nothing"
        linear, angular = beat.velocity
        if not (isfinite(linear) and isfinite(angular)):
            return "sends what is no number"
        if not limits.linear_min - _ROUNDING <= linear <= limits.linear_max + _ROUNDING:
            return f"wants {linear:g} m/s, which is beyond the limits"
        if abs(angular) > limits.angular_max + _ROUNDING:
            return f"wants {angular:g} rad/s, which is beyond the limits"
        return ""


class Child:
    """The gate's process and the socket to it."""

    def __init__(self, config: SafetyConfig, now: float) -> None:
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        ours.setblocking(False)
        with theirs:
            self.process = subprocess.Popen(
                [sys.executable, "-P", "-m", f"{__package__}.gate", str(theirs.fileno())],
                stdin=subprocess.PIPE,
                pass_fds=[theirs.fileno()],
                start_new_session=True,  # a Ctrl-C is for the guard, which ends the gate when the wheels stand
            )
        self.socket = ours
        self.started_at = now
        self.heard_at: float | None = None
        given = self.process.stdin
        if given is not None:
            threading.Thread(target=_give, args=(given, config.model_dump_json().encode()), daemon=True).start()

    def hear(self, now: float) -> Beat | None:
        """The newest that it said, answered; None: nothing."""
        newest = None
        try:
            while data := self.socket.recv(64):
                beat = unpack_beat(data)
                if beat is not None:
                    newest = beat
        except OSError:  # nothing waits, or it is gone, which `ended` knows
            pass
        if newest is not None:
            self.heard_at = now
            try:
                self.socket.send(b".")
            except OSError:
                return newest
        return newest

    def ended(self, now: float) -> str:
        """Why it has to be started anew; empty: it has not."""
        status = self.process.poll()
        if status is not None:
            return f"ended with status {status}"
        if self.heard_at is None:
            return f"did not start within {_STARTS_S:g} s" if now - self.started_at > _STARTS_S else ""
        return f"hangs for {_HANGS_S:g} s" if now - self.heard_at > _HANGS_S else ""

    def end(self) -> None:
        """End it for certain; a frozen one, too."""
        self.process.kill()
        self.process.wait()
        self.socket.close()


def _give(pipe: IO[bytes], text: bytes) -> None:
    """Hand the configuration over without ever making the guard wait."""
    try:
        with pipe:
            pipe.write(text)
    except OSError:  # the gate ended, which is seen elsewhere
        return


class Guard:
    """The loop around the watch.

    Args:
        config: The section of robot.yaml.
        wheels: The only way to them.
        clock: `skytether.guard.clock.now`; replaced by tests only.

    Raises:
        GuardError: Another guard has this folder, or the folder cannot be made.
    """

    def __init__(self, config: SafetyConfig, wheels: Wheels, clock: Callable[[], float] = boottime) -> None:
        self._config = config
        self._wheels = wheels
        self._clock = clock
        self._period = 1 / config.rate_hz
        self._watch = Watch(config.rules().limits, config.guard_s)
        self._notices = Notices(_log)
        self._systemd = Systemd()
        self._lock = self._take_folder()

    def run(self, stopped: Callable[[], bool]) -> None:
        """Guard until told to stop; the wheels stand at the end."""
        child: Child | None = None
        started, ready = -_AGAIN_S, False
        try:
            while not stopped():
                now = self._clock()
                if child is None and now - started >= _AGAIN_S:
                    started, child = now, Child(self._config, now)
                ready |= self._turn(child)
                if child is not None and (why := child.ended(self._clock())):
                    _log.error("the gate %s; the wheels stand and it is started anew", why)
                    child.end()
                    child = None
                self._systemd.tell("READY=1\nWATCHDOG=1" if ready else "WATCHDOG=1")
        finally:
            self._systemd.tell("STOPPING=1")
            for _ in range(_LAST_STOPS):
                self._write(STANDSTILL, self._clock())
            if child is not None:
                child.end()
            for _ in range(_LAST_STOPS):
                self._write(STANDSTILL, self._clock())
            self._systemd.close()
            self._lock.close()

    def _turn(self, child: Child | None) -> bool:
        """Wait for the gate, a period at most, and tell the wheels once. True if the gate said something."""
        if child is None:
            time.sleep(self._period)
            beat = None
        else:
            select.select([child.socket], [], [], self._period)
            beat = child.hear(self._clock())
            if beat is not None:
                self._watch.hear(beat)
            elif child.process.poll() is not None:
                time.sleep(self._period)  # its end makes the socket readable at once
        now = self._clock()
        wrong = self._watch.look(now)
        if wrong and child is not None and child.heard_at is not None:
            self._notices.say(wrong.split()[0], f"the gate {wrong}; the guard stops the wheels", now)
        self._write(self._watch.velocity, now)
        return beat is not None

    def _write(self, velocity: Velocity, now: float) -> None:
        try:
            self._wheels.write(velocity)
        except Exception as error:  # tried again in a moment; a motor drive that hears nothing stops by itself
            self._notices.say("wheels", f"the wheels cannot be told anything: {error}", now)

    def _take_folder(self) -> IO[bytes]:
        folder = self._config.place()
        try:
            folder.mkdir(parents=True, exist_ok=True)
            lock = (folder / "lock").open("ab")
        except OSError as error:
            raise GuardError(f"cannot use the folder {folder} for the gate's sockets: {error.strerror}") from error
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            lock.close()
            raise GuardError(f"another gate runs in {folder}; end it, or name another safety.folder") from error
        return lock
