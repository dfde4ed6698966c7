"""The guard's loop: what the gate says goes in, one velocity goes to the wheels, and nothing is ever waited for.

The gate and the writer are started, watched and started anew. The emergency stop lives here, and so does a way to
stop the robot that needs no gate.
"""

from __future__ import annotations

import os
import select
import time
from collections import deque
from collections.abc import Callable

from . import board
from .board import Board, Role
from .child import Child, StartError
from .claim import Claim, ClaimError
from .clock import now as boottime
from .descriptors import receive
from .enable import Enable, Power, WriterLine, open_line
from .estop import LATCH_FILE, EstopFile, KeptEstop, boot_id, clean, lasting_file
from .log import Log
from .mailbox import bind
from .onlooker import Onlooker
from .protocol import LARGEST, STOP_SOCKET, Answer, Beat, pack_answer, unpack_beat, unpack_note
from .record import Record
from .requests import Reply, Requests
from .settings import Settings
from .systemd import Systemd
from .teller import SPEAKS, Teller, repeat_s
from .velocity import STANDSTILL
from .watch import Watch
from .wheels import SocketWheels, WriterWheels

_AGAIN_S = 1.0
"""Between starts of a child."""
_DEATHS, _DEATHS_S = 3, 60.0
"""A gate that ended so often within that time is not to be trusted: a person has to look at it."""
_KEPT_S = 1.0
"""A stop that is not on disk after so long is answered as such."""
_ENDS_S = 10.0
"""A guard that is told to end brakes for so long at most."""
_LEAVES_S = 2.0
"""For writer and gate to leave their graph, and for the disk."""
_MOST_PACKETS = 64
"""Taken from the gate in one turn; one that says more has gone mad, and the rest waits."""
_LAST_PACKETS = 1024
"""Of a gate that has ended: more than the kernel keeps."""
_LAST_STOPS = 5
"""Said at the end."""
_AT_MOST = 4
"""Turns in a period, however often the gate says something."""


class GuardError(Exception):
    """The guard cannot start; the text says why and what to do."""


class Guard:
    """The loop.

    Args:
        settings: What is configured.
        log: For people.
        refused: What `privileges.acquire` was not permitted, for the status.
        clock: `clock.now`; replaced by tests only.

    Raises:
        GuardError: Another guard has this folder, or the folder cannot be made.
    """

    def __init__(self, settings: Settings, log: Log, refused: list[str], clock: Callable[[], float] = boottime) -> None:
        self._refused = refused
        self._settings = settings
        self._log = log
        self._clock = clock
        try:
            self._claim = Claim(settings.folder)
        except ClaimError as error:
            raise GuardError(str(error)) from error
        boot = boot_id()
        self._record = Record(settings.record, boot)
        latch = os.path.join(settings.folder, LATCH_FILE)
        keeper = EstopFile(latch, boot, self._not_kept, lasting_file(settings.folder, settings.record))
        self._latch = KeptEstop(keeper)
        keeper.start()
        try:
            self._requests = Requests(os.path.join(settings.folder, STOP_SOCKET), self._answer)
        except OSError as error:
            raise GuardError(f"cannot have {STOP_SOCKET} in {settings.folder}: {error.strerror}") from error
        try:
            self._estop = None if settings.estop is None else bind(settings.estop)
        except OSError as error:
            raise GuardError(f"cannot have {settings.estop} for stops: {error.strerror}") from error
        self._claim.add(os.path.join(settings.folder, STOP_SOCKET))
        if isinstance(settings.estop, str):
            self._claim.add(settings.estop)
        self._claim.start()
        self._watch = Watch(settings.bounds, settings.period_s, settings.patience_s)
        self._board_file = board.make()
        self._board = Board(self._board_file)
        self._wheels: WriterWheels | Teller
        if settings.wheels is None:
            self._wheels = WriterWheels()
        else:
            way = SocketWheels(settings.wheels)
            self._wheels = Teller(way, self._watch, self._board, Role.FIRST, settings.period_s, clock)
        self._enable = self._enable_signal()
        self._systemd = Systemd()
        self._gate: Child | None = None
        self._writer: Child | None = None
        self._display = Onlooker("display", settings.display, settings.config, log)
        self._tried: dict[str, float] = {}
        self._restarts: dict[str, int] = {}
        self._dead: list[Child] = []
        self._deaths: deque[float] = deque(maxlen=_DEATHS)
        self._due = self._last = self._started = clock()
        self._troubles: dict[str, str] = {}
        self._ready = self._ends = False

    def _enable_signal(self) -> Enable | None:
        settings, wheels = self._settings, self._wheels
        if not settings.enable:
            return None
        bounds = settings.bounds
        fastest = max(bounds.linear_max, -bounds.linear_min)
        brakes = max(fastest / bounds.linear_braking, bounds.angular_max / bounds.angular_braking)
        power = Power(brakes + 2 * settings.period_s + settings.patience_s, settings.enable_after_s)
        if settings.enable[0] == "topic" and isinstance(wheels, WriterWheels):
            return Enable(lambda: WriterLine(wheels), power)
        return Enable(lambda: open_line(settings.enable), power)

    def run(self, ended: Callable[[], bool]) -> bool:
        """Guard until told to end, or until nobody can reach this guard any more; the wheels stand at the end.

        Returns:
            Whether it was told to end.
        """
        for sentence in self._refused:
            self._log.line("INFO", sentence)
        self._event("guard", "start", self._latch.reason or "released")
        while not ended() and not self._claim.lost:
            self.turn()
        lost = self._claim.lost
        self._systemd.notify("STOPPING=1")
        if lost:
            self._log.line("ERROR", f"{lost} was removed or replaced: nobody could stop this guard; it brakes and ends")
        self._event("guard", "end", f"{lost} was removed or replaced" if lost else "told to end")
        self._brake()
        if self._gate is not None:
            self._gate.leave()
        if self._writer is not None:
            self._writer.socket.close()  # it says standstill for a while, leaves the graph and ends
        self._display.leave()
        self._requests.close()
        if self._estop is not None:
            self._estop.close()
        end = time.monotonic() + _LEAVES_S
        while time.monotonic() < end and not (
            self._record.written
            and self._latch.kept
            and all(child is None or child.reaped() for child in (self._gate, self._writer))
        ):
            time.sleep(0.01)
        if self._gate is not None:
            self._gate.end()
        if self._writer is not None:
            self._writer.end()
        self._display.end()
        return not lost

    def turn(self) -> None:
        """Wait for the gate, a period at most, and tell the wheels once."""
        now = self._clock()
        if now < self._last:  # it went back
            self._due = now
        if now < self._due:
            waited, rests = self._requests.sockets(), self._last + self._settings.period_s / _AT_MOST - now
            wait = min(self._due - now, self._settings.period_s)
            if self._gate is not None and not self._gate.gone and rests <= 0:
                waited.append(self._gate.socket)
            elif rests > 0:
                wait = min(wait, rests)
            select.select(waited, [], [], max(0.0, wait))
        self._requests.turn()
        beat = self._receive()
        now = self._clock()  # after it: what is said later than now would be from the future
        if beat or now >= self._due:
            told = self._write_velocity(now)
            self._last = now
            self._due = self._next(now) if told else now + self._settings.period_s / 2
            if beat:
                self._answer_gate(now)
                self._ready = True
        self._supervise_children(self._clock())
        self._systemd.notify("READY=1\nWATCHDOG=1" if self._ready else "WATCHDOG=1")

    def _receive(self, most: int = _MOST_PACKETS) -> bool:
        """Take in what the gate says. True if it said anything."""
        gate, newest = self._gate, None
        for _ in range(most):
            if gate is None or gate.gone:
                break
            try:
                data = receive(gate.socket, LARGEST)[0]
            except BlockingIOError:
                break
            except ConnectionResetError:  # it ended with answers unread; its last words still wait behind that
                continue
            except OSError:
                data = b""
            if not data:
                gate.gone = True
                self._watch.forget()
                break
            beat = unpack_beat(data)
            note = unpack_note(data) if beat is None else None
            if beat is not None:
                newest = beat
                self._stop_as_the_gate_says(beat)
            elif note:
                self._event("gate", "trouble", note)
        if newest is None or gate is None:
            return False
        gate.heard_at = self._clock()
        self._watch.on_beat(newest)
        fresh = 0 <= gate.heard_at - newest.at <= self._settings.patience_s
        if newest.reset and fresh and self._latch.reset(newest.seen):
            self._event("person", "reset", "the emergency stop was reset")
        return True

    def _stop_as_the_gate_says(self, beat: Beat) -> None:
        # What the gate said before it knew of the last reset is what the reset has ended.
        if beat.stopped and beat.seen == self._latch.generation:
            self._stop("gate", beat.stopped)

    def _next(self, now: float) -> float:
        """When the wheels are told something again, if the gate says nothing."""
        repeat = repeat_s(self._settings.period_s, self._settings.patience_s)
        return self._watch.due(now, repeat, bool(self._latch.reason))

    def _write_velocity(self, now: float) -> bool:
        """Tell the wheels. False: not yet."""
        stopped, told, kind = bool(self._latch.reason), True, "wheels"
        wrong = self._watch.target(now, stopped)[1]
        if wrong and self._gate is not None and self._gate.heard_at is not None and not self._ends:
            self._trouble(wrong.split()[0], "brake", f"the gate {wrong}; the guard stops the wheels", now)
        try:
            if isinstance(self._wheels, WriterWheels):
                self._wheels.receive()
                self._watch.learn(self._board.newest().told)
                self._wheels.write(*self._watch.asks(now, stopped))
                if self._wheels.trouble:
                    kind = "unread"
                    raise OSError(self._wheels.trouble)
            else:
                self._wheels.refresh(now)
                told = self._wheels.write_velocity(now, stopped)
            self._troubles.pop("wheels", None)
        except OSError as error:  # tried again in a moment; a motor drive that hears nothing stops by itself
            sentence = f"the wheels cannot be told anything: {error.strerror or error}"
            self._troubles["wheels"] = sentence
            self._trouble(kind, "wheels", sentence, now)
        if self._enable is not None:
            self._toggle(self._enable, now, well=not wrong and not self._latch.reason and not self._ends)
        return told

    def _toggle(self, enable: Enable, now: float, *, well: bool) -> None:
        """Let the enable signal change, as long as all is well and the wheels are told what they are to do."""
        told = self._watch.told
        known = 0 <= now - told.at <= self._settings.patience_s and "wheels" not in self._troubles
        enable.turn(now, well=well, told=known, stands=told.velocity == STANDSTILL)
        if enable.trouble:
            self._troubles["enable"] = enable.trouble
            self._trouble("enable", "enable", enable.trouble, now)
        else:
            self._troubles.pop("enable", None)

    def _answer_gate(self, now: float) -> None:
        latch = self._latch
        answer = Answer(now, latch.generation, latch.kept, latch.reason)
        if self._gate is not None:
            try:
                self._gate.socket.send(pack_answer(answer))
            except OSError:  # it does not read; it will hang or have ended
                return

    def _supervise_children(self, now: float) -> None:
        """Start what is not there, end what hangs."""
        self._dead = [child for child in self._dead if not child.reaped()]
        self._gate = self._kept_alive("gate", self._gate, self._settings.gate, now)
        self._display.turn(now)
        if self._settings.writer:
            writer = self._kept_alive("writer", self._writer, self._settings.writer, now)
            if writer is not self._writer and isinstance(self._wheels, WriterWheels):
                self._wheels.lead_to(writer.socket if writer is not None else None)
            self._writer = writer
            if writer is not None and isinstance(self._wheels, WriterWheels) and self._wheels.heard_at is not None:
                writer.heard_at = max(writer.heard_at or 0.0, self._wheels.heard_at)

    def _kept_alive(self, name: str, child: Child | None, command: tuple[str, ...], now: float) -> Child | None:
        if child is None:
            if now - self._tried.get(name, -_AGAIN_S) < _AGAIN_S:
                return None
            self._tried[name] = now
            more = (self._estop.fileno(),) if name == "gate" and self._estop is not None else ()
            try:
                return Child(name, command, self._settings.config, now, (self._board_file, *more))
            except StartError as error:
                self._trouble(f"start:{name}", "trouble", f"the {name} cannot be started: {error}", now)
                return None
        why = child.ended(now)
        if not why:
            return child
        self._log.line("ERROR", f"the {name} {why}; the wheels stand and it is started anew")
        self._event(name, "death", why)
        self._restarts[name] = self._restarts.get(name, 0) + 1
        if name == "gate":
            self._receive(_LAST_PACKETS)  # its last word may be a stop
            self._watch.forget()
        child.end()
        place = self._board.place(Role.SECOND if name == "gate" else Role.FIRST)
        if pid := place.end_speaker(SPEAKS * self._settings.period_s):  # a program that it had may go on
            self._log.line("ERROR", f"process {pid} of the {name} stood still as it told the wheels something: ended")
        self._dead.append(child)
        if name == "gate":
            self._deaths.append(now)
            if len(self._deaths) == _DEATHS and now - self._deaths[0] <= _DEATHS_S:
                self._stop("guard", f"the gate ended {_DEATHS} times within a minute, at last: {why}")
        return None

    def _brake(self) -> None:
        """The wheels are braked before the guard ends, whatever was wanted."""
        self._ends = True
        self._watch.forget()
        end, last = self._clock() + _ENDS_S, _LAST_STOPS
        while last and self._clock() < end:
            now = self._clock()
            if self._watch.told.velocity == STANDSTILL or now - self._watch.told.at > self._settings.patience_s:
                last -= 1
            self._receive()
            self._watch.forget()
            self._write_velocity(now)
            self._answer_gate(now)
            self._systemd.notify("WATCHDOG=1")
            time.sleep(self._settings.period_s)

    def _stop(self, who: str, reason: str) -> bool:
        """True if this is new."""
        if not self._latch.stop(reason):
            return False
        self._log.line("WARNING", f"emergency stop: {self._latch.reason}")
        self._event(who, "stop", self._latch.reason)
        return True

    def _trouble(self, kind: str, what: str, sentence: str, now: float) -> None:
        if self._log.trouble(kind, sentence, now):
            self._event("guard", what, sentence)

    def _not_kept(self, why: str) -> None:
        self._log.line("ERROR", f"{why}; the emergency stop would not outlive the guard")

    def _event(self, who: str, what: str, detail: str) -> None:
        self._record.add(who, what, detail, time.time(), self._clock())

    def _answer(self, asked: object) -> Reply | Callable[[], Reply | None]:
        request = asked if isinstance(asked, dict) else {}
        what = request["do"]
        if what == "status":
            return self._status()
        if what != "stop":
            return {"refused": f"there is no request {str(what)[:40]!r}; the guard knows status and stop"}
        if not self._stop("person", clean(request.get("reason")) or "somebody asked for it"):
            self._latch.renew()
        end = self._clock() + _KEPT_S

        def kept() -> Reply | None:
            if self._latch.kept or not self._latch.reason:
                return self._status()
            if self._latch.unkept or self._clock() > end:
                why = self._latch.unkept or "the disk does not answer"
                return {**self._status(), "note": f"the stop is in effect, but could not be kept: {why}"}
            return None

        return kept

    def _status(self) -> dict[str, object]:
        told, latch = self._watch.told, self._latch
        self._troubles.pop("record", None)
        if self._record.trouble:
            self._troubles["record"] = self._record.trouble
        return {
            "stopped": latch.reason,
            "kept": latch.kept,
            "linear_m_s": told.velocity.linear,
            "angular_rad_s": told.velocity.angular,
            "told_s_ago": round(self._clock() - told.at, 3) if told.at == told.at else None,
            "pid": os.getpid(),
            "gate_pid": self._gate.pid if self._gate is not None else 0,
            "writer_pid": self._writer.pid if self._writer is not None else 0,
            "gate_restarts": self._restarts.get("gate", 0),
            "writer_restarts": self._restarts.get("writer", 0),
            "seconds": round(self._clock() - self._started, 1),
            "enabled": None if self._enable is None else self._enable.on,
            "not_permitted": list(self._refused),
            "notes": [self._record.note] if self._record.note else [],
            "troubles": [*self._troubles.values(), *([self._display.trouble] if self._display.trouble else [])],
        }
