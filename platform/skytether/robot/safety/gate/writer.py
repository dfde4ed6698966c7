"""The writer as a process: ``python -m skytether.robot.safety.gate.writer FD CONFIG BOARD``, started by the guard.

It publishes on the robot's graph what the guard wants. The guard has no library of a graph in its process so. On a
graph it is the first to tell the wheels: the guard only says where they are to get, and the limits are held here. A
writer whose guard is silent brakes by itself, from what the wheels were told last, and keeps saying standstill. While
nobody listens to it, it is silent, and the gate may be heard.
"""

from __future__ import annotations

import gc
import logging
import select
import signal
import socket
import sys
from collections.abc import Callable
from math import nan

from skytether.guard import privileges
from skytether.guard.board import Board, Role
from skytether.guard.claim import Heir
from skytether.guard.clock import now as boottime
from skytether.guard.protocol import LARGEST, Answer, pack_answer, unpack_beat, unpack_enable
from skytether.guard.settings import thaw
from skytether.guard.teller import SPEAKS, Teller, repeat_s
from skytether.guard.velocity import STANDSTILL
from skytether.guard.watch import Watch
from skytether.messages import Twist, TwistStamped, warm
from skytether.robot.log_throttle import LogThrottle

from ...graphs.gate_io import Wheels
from ..config.safety_config import SafetyConfig
from ..io.io_factory import open_wheels
from ..io.process_setup import SWITCH_S, log_without_waiting

_log = logging.getLogger("skytether.writer")
_LAST_STOPS_S = 0.5
"""How long a writer without a guard says standstill before it ends."""
_PACKETS = 64


class Writer:
    """The loop.

    Args:
        config: The section of robot.yaml.
        guard: The socket to the guard; whole packets, never waits.
        wheels: On the graph.
        board: What the wheels were told.
        clock: `skytether.guard.clock.now`; replaced by tests only.
    """

    def __init__(
        self,
        config: SafetyConfig,
        guard: socket.socket,
        wheels: Wheels,
        board: Board,
        clock: Callable[[], float] = boottime,
    ) -> None:
        self._guard = guard
        self._wheels = wheels
        self._clock = clock
        self._period = 1 / config.rate_hz
        self._repeat_s = repeat_s(self._period, config.guard_s)
        self._watch = Watch(config.bounds(), self._period, config.guard_s)
        self._teller = Teller(wheels, self._watch, board, Role.FIRST, self._period, clock)
        board.place(Role.FIRST).end_speaker(SPEAKS * self._period)  # left by a writer before this one
        self._log_throttle = LogThrottle(_log)
        self._heir = Heir(str(config.place()), guard)
        self._gone = False
        self._wanted_at = nan
        self._due = clock()

    def run(self) -> None:
        """Write until the guard is gone, then stop the wheels."""
        while not self._gone:
            select.select([self._guard], [], [], max(0.0, min(self._due - self._clock(), self._period)))
            self.turn()
        _log.error("the guard is gone; the writer stops the wheels and ends")
        stood = 0.0
        while stood < _LAST_STOPS_S:
            now = self._clock()
            if not self._heir.may():
                _log.error("another guard has the wheels by now; the writer ends")
                return
            self._write_velocity(now)
            stood = stood + self._period if self._watch.told.velocity == STANDSTILL else 0.0
            select.select([], [], [], self._period)

    def turn(self) -> None:
        """Take in what the guard wants, and tell the wheels if it is time."""
        heard = self._receive()
        now = self._clock()
        if self._gone or (not heard and now < self._due):
            return
        told = self._write_velocity(now)
        self._due = self._watch.due(now, self._repeat_s) if told else now + self._period / 2
        try:
            self._guard.send(pack_answer(Answer(now, stopped=self._teller.unread)))
        except BlockingIOError:
            pass
        except OSError:
            self._gone = True

    def _receive(self) -> bool:
        """Take in what the guard wants. True if that is newer than what it wanted before."""
        newest = None
        for _ in range(_PACKETS):
            try:
                data = self._guard.recv(LARGEST)
            except BlockingIOError:
                break
            except OSError:
                data = b""
            if not data:
                self._gone = True
                self._watch.forget()
                break
            newest = unpack_beat(data) or newest
            level = unpack_enable(data)
            if level is not None:
                self._enable(level)
        if newest is None or newest.at == self._wanted_at:
            return False
        self._watch.on_beat(newest)
        self._wanted_at = newest.at
        return True

    def _enable(self, level: bool) -> None:
        try:
            self._wheels.enable(level)
        except Exception as error:  # then the signal does not change, and the power goes
            self._log_throttle.warn("enable", f"the enable signal cannot be published: {error}", self._clock())

    def _write_velocity(self, now: float) -> bool:
        """Tell the wheels. False: not yet."""
        self._teller.refresh(now)
        try:
            told = self._teller.write_velocity(now)
        except Exception as error:  # tried again in a moment
            self._log_throttle.warn("wheels", f"the wheels cannot be told anything: {error}", now)
            told = True
        if self._teller.ended:
            self._log_throttle.warn("ended", self._teller.ended, now)
        return told


def main() -> None:
    """Run as the guard's child."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # it ends when the guard does, with the wheels at a standstill
    config = SafetyConfig.model_validate_json(thaw(int(sys.argv[2])))
    logging.basicConfig(format="%(levelname)s writer: %(message)s", level=logging.INFO)
    log_without_waiting()
    sys.setswitchinterval(SWITCH_S)
    guard = socket.socket(fileno=int(sys.argv[1]))
    guard.setblocking(False)
    warm([Twist, TwistStamped], config.encoding)
    for sentence in privileges.acquire(privileges.WRITER):
        _log.info("%s", sentence)
    board = Board(int(sys.argv[3]))
    wheels = open_wheels(config, "guard", board.place(Role.FIRST))
    writer = Writer(config, guard, wheels, board)
    gc.collect()
    gc.freeze()
    try:
        writer.run()
    finally:
        wheels.close()


if __name__ == "__main__":
    main()
