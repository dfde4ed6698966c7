"""The gate as a process: ``python -m skytether.robot.safety.gate FD``, started by the guard and by nobody else.

One loop at a fixed rate: what came on the sockets goes in, one velocity goes to the guard, which owns the wheels. The
guard answers each; when it does not, it is gone or frozen, and the gate stops the wheels itself. The configuration
comes on standard input, so that a file that somebody edits changes nothing under way.
"""

from __future__ import annotations

import gc
import json
import logging
import os
import socket
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from math import isfinite
from pathlib import Path
from typing import Any

from skytether.control.admittance import STANDSTILL, Velocity
from skytether.guard.clock import now as boottime
from skytether.messages import Twist, warm
from skytether.robot.notices import Notices

from .config import SafetyConfig
from .hardware import Sensors, Wheels, bind, receive_from
from .process import log_without_waiting
from .protocol import COMMAND_SOCKET, CONTROL_SOCKET, Beat, GateState, pack_beat, pack_state, unpack_command
from .rules import Decision, Gate
from .sources import Hand
from .ways import open_sensors, open_wheels

_log = logging.getLogger("skytether.gate")

_COMMANDS_EACH_TURN = 64
"""The kernel keeps about as many; of a sender that is faster it takes no more."""
_MANY_COMMANDS = 16
"""In one turn; an agent at 100 Hz has two."""
_LAST_STOPS_S = 0.5
"""How long a gate without a guard tells the wheels to stand before it ends."""
_ASKING_S = 1.0
"""For one request at the control socket."""
_LATCH = "latch"
_RELEASED = "released"


class Keeper:
    """Remembers an emergency stop over a restart: a small file, written by a thread of its own.

    Args:
        path: Of the file. One that is missing, or says anything but "released", means that the robot was not left
            released, unless this is the first gate here.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._wanted = ""
        self._changed = threading.Event()

    def before(self) -> str:
        """Why the robot is to stand from the start; empty: it is not."""
        try:
            text = self._path.read_text(errors="replace").strip()
        except FileNotFoundError:
            return ""
        except OSError as error:
            return f"whether it was stopped before cannot be read: {error}"
        if text == _RELEASED:
            return ""
        return text.removesuffix(_AGAIN) + _AGAIN if text else "the gate before ended in the middle of a change"

    def keep(self, reason: str) -> None:
        """Have it written; returns at once."""
        self._wanted = reason or _RELEASED
        self._changed.set()

    def run(self) -> None:
        """Write what is to be kept, for ever."""
        while True:
            self._changed.wait()
            self._changed.clear()
            try:
                self._write(self._wanted)
            except OSError as error:
                _log.error("cannot write %s: %s; an emergency stop would not outlive the gate", self._path, error)

    def _write(self, text: str) -> None:
        """In place: a file that is there needs no room on a full disk."""
        file = os.open(self._path, os.O_WRONLY | os.O_CREAT, 0o600)
        try:
            os.pwrite(file, text.encode()[:_LATCH_BYTES].ljust(_LATCH_BYTES), 0)
        finally:
            os.close(file)


_AGAIN = " (before the gate was started again)"
_LATCH_BYTES = 512


class GateLoop:
    """The loop around the rules.

    Args:
        config: The section of robot.yaml.
        guard: The socket to the guard; whole packets, never waits.
        sensors: Where readings come from.
        wheels: For the day that the guard is gone.
        clock: `skytether.guard.clock.now`; replaced by tests only.
    """

    def __init__(
        self,
        config: SafetyConfig,
        guard: socket.socket,
        sensors: Sensors,
        wheels: Wheels,
        clock: Callable[[], float] = boottime,
    ) -> None:
        self.guard_gone = False
        self._config = config
        self._clock = clock
        self._guard = guard
        self._sensors = sensors
        self._wheels = wheels
        folder = config.place()
        self._keeper = Keeper(folder / _LATCH)
        self._gate = Gate(config.rules(), self._keeper.before())
        self._kept = self._gate.stopped
        self._keeper.keep(self._kept)
        self._commands = bind(str(folder / COMMAND_SOCKET), 0o660)
        self._lock = threading.Lock()
        self._notices = Notices(_log)
        self._started = self._heard = clock()
        self._overruns = 0
        self._turns = 0
        self._last: Decision | None = None

    def run(self) -> None:
        """Turn until the guard is gone, then stop the wheels."""
        threading.Thread(target=self._keeper.run, name="keeper", daemon=True).start()
        threading.Thread(target=self._answer, name="control", daemon=True).start()
        period = 1 / self._config.rate_hz
        deadline = self._clock()
        while not self.guard_gone:
            self.turn(self._clock())
            deadline += period
            late = self._clock() - deadline
            if late < 0:
                time.sleep(-late)
            elif late > period:
                self._overruns += 1
                deadline += late  # turns that were missed are not made up for
        _log.error("the guard is gone; the gate stops the wheels and ends")
        end = self._clock() + _LAST_STOPS_S
        while self._clock() < end:
            self._stop_wheels(self._clock())
            time.sleep(period)

    def turn(self, now: float) -> None:
        """One turn of the loop."""
        agent: object = None
        with self._lock:
            arrived = receive_from(self._commands, 256, _COMMANDS_EACH_TURN)
            if len(arrived) > _MANY_COMMANDS:
                sentence = f"more than {_MANY_COMMANDS} commands came within one turn; the newest counts"
                self._notices.say("rate", sentence, now)
            for data, sender in arrived:
                command = unpack_command(data, Hand.AGENT, now)
                if command is None:
                    self._notices.say("bytes", "something that is no command comes to the gate's command socket", now)
                else:
                    agent = sender
                    self._gate.command(command, now)
            for topic, message in self._sensors.read():
                self._gate.sense(topic, message, now)
            decision = self._gate.step(now)
            self._last = decision
            self._turns += 1
        for kind, sentence in decision.troubles.items():
            self._notices.say(kind, sentence, now)
        if self._gate.stopped != self._kept:
            self._kept = self._gate.stopped
            self._keeper.keep(self._kept)
        self._tell_guard(decision.velocity, now)
        if agent:
            self._tell_agent(agent, decision, now)

    def _tell_agent(self, agent: Any, decision: Decision, now: float) -> None:
        state = GateState(now, decision.velocity, now, self._gate.stopped, decision.hand)
        with suppress(OSError):  # it is gone, or does not read; it asks again
            self._commands.sendto(pack_state(state), agent)

    def _tell_guard(self, velocity: Velocity, now: float) -> None:
        try:
            while not self.guard_gone:
                self.guard_gone = not self._guard.recv(16)
                self._heard = now
        except BlockingIOError:
            pass
        except OSError:
            self.guard_gone = True
        frozen = now - self._heard > self._config.guard_s
        if frozen:
            self._notices.say("guard", "the guard does not answer; the gate stops the wheels itself", now)
            self._stop_wheels(now)
        try:
            self._guard.send(pack_beat(Beat(now, STANDSTILL if frozen else velocity)))
        except BlockingIOError:
            pass
        except OSError:
            self.guard_gone = True

    def _stop_wheels(self, now: float) -> None:
        try:
            self._wheels.write(STANDSTILL)
        except Exception as error:  # tried again at the next turn
            self._notices.say("wheels", f"the wheels cannot be told to stand: {error}", now)

    def _answer(self) -> None:
        """The thread of the control socket: one request, one answer, the next."""
        path = self._config.place() / CONTROL_SOCKET
        path.unlink(missing_ok=True)
        listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        before = os.umask(0o177)
        try:
            listener.bind(str(path))
        finally:
            os.umask(before)
        listener.listen(8)
        while True:
            try:
                link, _ = listener.accept()
                with link:
                    link.settimeout(_ASKING_S)
                    link.send(json.dumps(self.answer(link.recv(4096)), allow_nan=False).encode())
            except Exception as error:  # whoever asks badly gets no answer; the next one does
                self._notices.say("control", f"a request at {path} failed: {error}", self._clock())

    def answer(self, request: bytes) -> dict[str, Any]:
        """What a request of a person gets; from any thread."""
        try:
            asked = json.loads(request)
            what = asked["do"]
        except (ValueError, TypeError, KeyError):
            return {"refused": 'the request must be JSON such as {"do": "status"}'}
        if not self._lock.acquire(timeout=_ASKING_S):
            return {"refused": "the gate's loop hangs; the guard holds the wheels"}
        try:
            if what == "stop":
                reason = asked.get("reason")
                self._gate.engage(str(reason)[:200] if reason else "somebody asked for it")
            elif what == "reset":
                refused = self._gate.reset(self._clock())
                if refused:
                    return {"refused": refused}
            elif what == "start":
                started, refused = self._gate.start(self._clock())
                return {"refused": refused} if refused else self._status() | {"started": started}
            elif what != "status":
                return {"refused": f"there is no request {str(what)[:40]!r}; there are status, stop, reset and start"}
            return self._status()
        finally:
            self._lock.release()

    def _status(self) -> dict[str, Any]:
        last = self._last
        return {
            "stopped": self._gate.stopped,
            "hand": last.hand if last else None,
            "waiting": dict(self._gate.waiting),
            "zone": last.zone if last else None,
            "way_m": round(last.way, 3) if last and isfinite(last.way) else None,
            "share": round(last.share, 3) if last else None,
            "linear_m_s": last.velocity.linear if last else 0.0,
            "angular_rad_s": last.velocity.angular if last else 0.0,
            "troubles": list(last.troubles.values()) if last else [],
            "counts": dict(self._gate.counts),
            "turns": self._turns,
            "overruns": self._overruns,
            "seconds": round(self._clock() - self._started, 1),
            "pid": os.getpid(),
            "guard_pid": os.getppid(),
        }


def main() -> None:
    """Run as the guard's child."""
    config = SafetyConfig.model_validate_json(sys.stdin.read())
    logging.basicConfig(format="%(levelname)s gate: %(message)s", level=logging.INFO)
    log_without_waiting()
    guard = socket.socket(fileno=int(sys.argv[1]))
    guard.setblocking(False)
    warm([*config.kinds().values(), Twist], "cdr" if config.ros1 is None else "ros1")
    notices = Notices(_log)
    sensors = open_sensors(config, lambda kind, sentence: notices.say(kind, sentence, boottime()))
    loop = GateLoop(config, guard, sensors, open_wheels(config, "gate"))
    gc.collect()
    gc.freeze()  # what is there now stays: later collections are short
    loop.run()


if __name__ == "__main__":
    main()
