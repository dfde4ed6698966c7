"""The gate as a process: ``python -m skytether.robot.safety.gate.gate FD CONFIG BOARD [ESTOP]``.

Started by the guard alone. One loop at a fixed rate: what came on the sockets goes in, one velocity goes to the guard,
which owns the wheels. The guard answers each; when it does not, it is gone or frozen, and the gate stops the wheels
itself. The configuration comes as a file in memory that nobody can change, so that a file that somebody edits changes
nothing under way.
"""

from __future__ import annotations

import gc
import logging
import os
import signal
import socket
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from math import isfinite
from typing import Any

from skytether.guard import privileges
from skytether.guard.board import Board, Role
from skytether.guard.child import LEAVE
from skytether.guard.claim import Heir
from skytether.guard.clock import now as boottime
from skytether.guard.estop import LATCH_FILE, EstopFile, boot_id, lasting_file
from skytether.guard.folder import Known
from skytether.guard.mailbox import bind
from skytether.guard.requests import Requests
from skytether.guard.settings import thaw
from skytether.guard.velocity import STANDSTILL
from skytether.messages import Twist, TwistStamped, warm
from skytether.robot.graphs.wheels_watch import NOBODY, KnowsTheDeaf, Others, WatchesWheels
from skytether.robot.graphs.wheels_watch import sentence as sentence_of_others
from skytether.robot.log_throttle import LogThrottle

from ...control.command import Hand
from ...graphs.gate_io import Sensors, Wheels
from ..config.safety_config import SafetyConfig
from ..display.feed import Feed
from ..display.snapshot import snapshot
from ..io.hardware import receive_known
from ..io.io_factory import open_sensors, open_wheels
from ..io.process_setup import SWITCH_S, log_without_waiting
from ..protocol import COMMAND_SOCKET, CONTROL_SOCKET, DISPLAY_SOCKET, GateState, pack_state, unpack_command
from ..rules.rules import Gate, GateDecision
from .control import Control
from .heartbeat import Heartbeat

_log = logging.getLogger("skytether.gate")

_COMMANDS_EACH_TURN = 64
"""The kernel keeps about as many; of a sender that is faster it takes no more."""
_MANY_COMMANDS = 16
"""In one turn; an agent at 100 Hz has two."""
_LAST_STOPS_S = 0.5
"""How long a gate without a guard tells the wheels to stand before it ends."""


class GateLoop:
    """The loop around the rules.

    Args:
        config: The section of robot.yaml.
        guard: The socket to the guard; whole packets, never waits.
        sensors: Where readings come from.
        wheels: For the day that nobody else tells them anything.
        board: What the wheels were told.
        refused: What `privileges.acquire` was not permitted, for the status.
        clock: `skytether.guard.clock.now`; replaced by tests only.
    """

    def __init__(
        self,
        config: SafetyConfig,
        guard: socket.socket,
        sensors: Sensors,
        wheels: Wheels,
        board: Board,
        refused: Sequence[str] = (),
        clock: Callable[[], float] = boottime,
    ) -> None:
        self._config = config
        self._clock = clock
        self._sensors = sensors
        self._wheels = wheels
        self._period = 1 / config.rate_hz
        self._refused = refused
        self._watched = wheels if isinstance(wheels, WatchesWheels) else None
        self._others_noticed = 0
        folder = config.place()
        self._gate = Gate(config.rules())
        self._heartbeat = Heartbeat(
            guard, wheels, config.bounds(), self._period, config.guard_s, board, self._trouble, clock
        )
        also = lasting_file(str(folder), str(config.record_file()))
        self._keeper = EstopFile(str(folder / LATCH_FILE), boot_id(), _log.error, also)
        self._keeper.start()
        self._control = Control(self._gate, self._heartbeat, self._keeper, self._status, clock)
        self._heir = Heir(str(folder), guard)
        self._requests = Requests(str(folder / CONTROL_SOCKET), self._control.handle)
        self._commands = bind(str(folder / COMMAND_SOCKET))
        self._known = Known.of(self._commands)
        self._log_throttle = LogThrottle(_log)
        self._feed = None
        if config.display is not None:
            self._feed = Feed(str(folder / DISPLAY_SOCKET), config.display.rate_hz, clock())
        self._started = self._turned_at = clock()
        self._overruns = 0
        self._turns = 0
        self._last: GateDecision | None = None
        self._said = STANDSTILL

    def run(self) -> None:
        """Turn until the guard is gone, then stop the wheels."""
        deadline = self._clock()
        while not self._heartbeat.gone:
            self.turn()
            deadline += self._period
            late = self._clock() - deadline
            if late < 0:
                time.sleep(-late)
            elif late > self._period:
                self._overruns += 1
                deadline += late  # turns that were missed are not made up for
        _log.error("the guard is gone; the gate stops the wheels and ends")
        stood = 0.0
        while stood < _LAST_STOPS_S:
            self._heartbeat.receive()
            now = self._clock()
            if not self._heir.may():
                _log.error("another guard has the wheels by now; the gate ends")
                return
            stands = self._heartbeat.stop_wheels(now) == STANDSTILL
            stood = stood + self._period if stands else 0.0
            time.sleep(self._period)

    def turn(self) -> None:
        """One turn of the loop."""
        self._heartbeat.receive()
        now = self._clock()
        if now - self._turned_at > self._config.guard_s:
            self._gate.stalled(now)
        self._turned_at = now
        for topic, message in self._sensors.stops():  # before all else, a reset above all
            self._gate.sense(topic, message, now)
        self._control.turn(now)
        agent = self._receive_commands(now)
        wall = time.time()
        for topic, message in self._sensors.read():
            self._gate.sense(topic, message, now, wall)
        if (told := self._heartbeat.differs(self._said, now)) is not None:
            self._gate.rebase(*told)
        decision = self._gate.step(now)
        self._last = decision
        self._turns += 1
        self._said = self._heartbeat.send(decision.velocity, self._gate.stopped, self._control.resets, now)
        if self._said != decision.velocity:
            self._gate.rebase(self._said, now)
        self._requests.turn()
        for kind, sentence in decision.troubles.items():
            self._trouble(kind, sentence, now)
        if self._others.noticed != self._others_noticed:  # the log has it from the watch
            self._others_noticed = self._others.noticed
            self._heartbeat.note(self._other_publishers)
        if agent:
            self._send_state(agent, decision, now)
        if self._feed is not None:
            self._show(self._feed, decision, now)

    def close(self) -> None:
        """Close the sockets."""
        self._requests.close()
        self._commands.close()
        self._heir.close()
        if self._feed is not None:
            self._feed.close()

    def _receive_commands(self, now: float) -> Any:
        """Take in what the agent wants; the address of the agent, None: it said nothing."""
        agent = None
        arrived, strange = receive_known(self._commands, self._known, 256, _COMMANDS_EACH_TURN)
        if strange:
            self._trouble("sender", strange, now)
        if len(arrived) > _MANY_COMMANDS:
            sentence = f"more than {_MANY_COMMANDS} commands came within one turn; the newest counts"
            self._trouble("rate", sentence, now)
        for data, sender in arrived:
            command = unpack_command(data, Hand.AGENT, now)
            if command is None:
                self._trouble("bytes", "something that is no command comes to the gate's command socket", now)
            else:
                agent = sender
                self._gate.command(command, now)
        return agent

    @property
    def _stopped(self) -> str:
        known = self._heartbeat.answer is not None
        return self._gate.stopped or ("" if known else "the guard has not answered yet")

    @property
    def _others(self) -> Others:
        return self._watched.others if self._watched is not None else NOBODY

    @property
    def _other_publishers(self) -> str:
        names = self._others.names
        return sentence_of_others(self._config.wheels_at(), names) if names else ""

    def _trouble(self, kind: str, sentence: str, now: float) -> None:
        if self._log_throttle.warn(kind, sentence, now):
            self._heartbeat.note(sentence)

    def _send_state(self, agent: Any, decision: GateDecision, now: float) -> None:
        told = self._heartbeat.told(now)
        state = GateState(now, told.velocity, told.at, self._stopped, decision.hand, self._gate.started)
        with suppress(OSError):  # it is gone, or does not read; it asks again
            self._commands.sendto(pack_state(state), agent)

    def _show(self, feed: Feed, decision: GateDecision, now: float) -> None:
        if self._clock() - now > self._period / 2:
            return  # a late turn has no time for it
        told, gate = self._heartbeat.told(now).velocity, self._gate
        feed.turn(lambda: snapshot(decision, gate.asked, told, self._stopped, gate.modes), now)
        if feed.trouble:
            self._trouble("display", feed.trouble, now)

    def _status(self) -> dict[str, Any]:
        last, answer = self._last, self._heartbeat.answer
        told = self._heartbeat.told(self._clock()).velocity
        feed = self._feed.trouble if self._feed is not None else ""
        of_wheels = self._wheels.troubles if isinstance(self._wheels, KnowsTheDeaf) else ()
        more = [sentence for sentence in (feed, self._other_publishers, *of_wheels) if sentence]
        return {
            "stopped": self._stopped,
            "kept": answer.kept if answer else None,
            "hand": last.hand if last else None,
            "waiting": dict(self._gate.waiting),
            "modes": self._gate.modes,
            "zone": last.zone if last else None,
            "way_m": round(last.way, 3) if last and isfinite(last.way) else None,
            "share": round(last.share, 3) if last else None,
            "linear_m_s": told.linear,
            "angular_rad_s": told.angular,
            "troubles": [*(last.troubles.values() if last else ()), *more],
            "beyond": list(self._config.notes()),
            "counts": dict(self._gate.counts),
            "turns": self._turns,
            "overruns": self._overruns,
            "seconds": round(self._clock() - self._started, 1),
            "wheels": self._config.wheels_at(),
            "pid": os.getpid(),
            "guard_pid": os.getppid(),
            "not_permitted": list(self._refused),
        }


def main() -> None:
    """Run as the guard's child."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # it ends when the guard does, with the wheels at a standstill
    signal.signal(LEAVE, lambda *_: sys.exit())  # the guard has stopped the wheels, and ends
    config = SafetyConfig.model_validate_json(thaw(int(sys.argv[2])))
    logging.basicConfig(format="%(levelname)s gate: %(message)s", level=logging.INFO)
    log_without_waiting()
    sys.setswitchinterval(SWITCH_S)
    guard = socket.socket(fileno=int(sys.argv[1]))
    guard.setblocking(False)
    warm([*config.kinds().values(), Twist, TwistStamped], config.encoding)
    refused = privileges.acquire(privileges.GATE)
    notices = LogThrottle(_log)
    estop = socket.socket(fileno=int(sys.argv[4])) if len(sys.argv) > 4 else None
    sensors = open_sensors(config, lambda kind, sentence: notices.warn(kind, sentence, boottime()), estop)
    board = Board(int(sys.argv[3]))
    wheels = open_wheels(config, "gate", board.place(Role.SECOND))
    loop = GateLoop(config, guard, sensors, wheels, board, refused)
    gc.collect()
    gc.freeze()  # what is there now stays: later collections are short
    try:
        loop.run()
    finally:
        wheels.close()  # a graph is left in order: its master would name the node for ever
        sensors.close()


if __name__ == "__main__":
    main()
