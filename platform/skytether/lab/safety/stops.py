"""Attacks on the emergency stop: whatever dies, an acknowledged stop holds until somebody resets it."""

from __future__ import annotations

import signal
import socket
from collections.abc import Callable
from contextlib import ExitStack

from .attacks import Attacks
from .stage import Stage

_WATCH_S = 1.5
"""After a new gate has started, the robot has to stand for so long."""
_REASONS = {
    "released": "released",
    "empty": "",
    "lines": "one\ntwo\n\nreleased\n",
    "not-utf-8": "\udcff\udcfe",
    "zeros": "a\0b\0",
    "long": "x" * 3000,
}
_FREEZES_S = (0.3, 0.12, 0.5)
"""The first begins right at the reset."""
_NOTICED_S = 0.6
"""An agent that goes on after a freeze would drive within this."""
_IDLE_CLIENTS = 6
_IDLE_S = 0.5
"""An answer that takes longer waits for somebody else."""


def enter(attacks: Attacks) -> None:
    """Add them."""
    for role in ("gate", "guard", "agent"):
        attacks.add(
            f"stop-{role}-killed",
            f"a stop is acknowledged, and the {role} killed at once",
            stop_and_kill(role),
            seconds=5,
        )
    attacks.add("stop-both-killed", "a stop is acknowledged, guard and gate are killed", _both, seconds=6)
    attacks.add("stop-gate-frozen", "a stop while the gate is frozen", _frozen, seconds=5)
    attacks.add("stop-idle-clients", f"a stop while {_IDLE_CLIENTS} clients say nothing", _idle, seconds=2)
    for name, reason in _REASONS.items():
        attacks.add(f"stop-reason-{name}", f"a stop whose reason is {_named(reason)}", _reason(reason), seconds=4)
    attacks.add("button-gate-frozen", "the button is pressed while the gate is frozen", _button, seconds=4)
    attacks.add("button-silent", "the button falls silent", _silent, seconds=2)
    attacks.add(
        "reset-agent-frozen",
        "a reset, nobody says start, and the agent is frozen for 0.12 to 0.5 s, and goes on",
        _reset_and_freeze,
        seconds=5,
    )
    attacks.add("reset-alone", "a reset, and nobody says start", _reset, seconds=3)


def _named(reason: str) -> str:
    shown = ascii(reason)
    return shown if len(shown) < 30 else f"{len(reason)} letters"


def stop_and_kill(role: str) -> Callable[[Stage], None]:
    """A stop, and then one is killed."""

    def run(stage: Stage) -> None:
        victim = stage.robot.pid(role)
        with stage.stands(stage.promised.stop, f"a stop was acknowledged, and the {role} killed"):
            acknowledged = stage.stop()
            stage.robot.kill(victim)
            if role == "gate":
                stage.robot.another_gate(victim)
            stage.sleep(_WATCH_S)
            if acknowledged:
                _is_stopped(stage, role)

    return run


def _is_stopped(stage: Stage, role: str) -> None:
    """A robot that stands by chance will drive; it must say that it is stopped."""
    if role != "guard" and not stage.robot.ask("status")["stopped"]:
        stage.wrong("stop", "the stop is lost: the status says that there is none")


def _both(stage: Stage) -> None:
    gate, guard = stage.robot.pid("gate"), stage.robot.pid("guard")
    with stage.stands(stage.promised.stop, "a stop was acknowledged; gate and guard were killed and started again"):
        stage.stop()
        stage.robot.kill(guard)
        stage.robot.kill(gate)
        stage.robot.guard.wait()
        stage.robot.start_guard()
        stage.robot.another_gate(gate)
        stage.sleep(_WATCH_S)
        _is_stopped(stage, "gate")


def _frozen(stage: Stage) -> None:
    gate = stage.robot.signal("gate", signal.SIGSTOP)
    stage.sleep(0.02)
    with stage.stands(stage.promised.stop, "a stop while the gate was frozen"):
        acknowledged = stage.stop()
        stage.robot.kill(gate, signal.SIGCONT)
        stage.sleep(_WATCH_S)
        if acknowledged:
            _is_stopped(stage, "gate")


def _idle(stage: Stage) -> None:
    with ExitStack() as clients:
        for path in sorted(stage.robot.folder.glob("*.sock")):
            for _ in range(_IDLE_CLIENTS):
                client = clients.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET))
                client.setblocking(False)
                try:
                    client.connect(str(path))
                except OSError:  # a socket of datagrams, or its queue is full
                    break
        with stage.stands(stage.promised.stop, f"a stop beside {_IDLE_CLIENTS} idle clients"):
            stage.timed(stage.stop, "the stop is acknowledged", _IDLE_S)
            stage.sleep(0.7)


def _reason(reason: str) -> Callable[[Stage], None]:
    def run(stage: Stage) -> None:
        gate = stage.robot.pid("gate")
        with stage.stands(stage.promised.stop, f"a stop whose reason is {_named(reason)}"):
            acknowledged = stage.stop(reason)
            stage.sleep(0.3)
            stage.robot.kill(gate)
            stage.robot.another_gate(gate)
            stage.sleep(0.7)
            if acknowledged:
                _is_stopped(stage, "gate")

    return run


def _button(stage: Stage) -> None:
    gate = stage.robot.signal("gate", signal.SIGSTOP)
    stage.sleep(0.7)
    with stage.stands(0.0, "the button was pressed while the gate was frozen and the robot stood"):
        stage.robot.pressed = True
        stage.sleep(0.3)
        stage.robot.kill(gate, signal.SIGCONT)
        stage.sleep(1.0)
    stage.robot.pressed = False


def _silent(stage: Stage) -> None:
    with stage.stands(stage.promised.button, "the button fell silent"):
        stage.robot.pressed = None
        stage.sleep(1.2)
    stage.robot.pressed = False


def _reset_and_freeze(stage: Stage) -> None:
    agent = stage.robot.pid("agent")
    with stage.stands(stage.promised.stop, "a stop, then a reset, nobody says start, and the agent hangs"):
        stage.stop()
        stage.sleep(0.4)
        stage.robot.reset()
        for seconds in _FREEZES_S:
            stage.robot.kill(agent, signal.SIGSTOP)
            stage.sleep(seconds)
            stage.robot.kill(agent, signal.SIGCONT)
            stage.sleep(_NOTICED_S)


def _reset(stage: Stage) -> None:
    with stage.stands(stage.promised.stop, "a stop, then a reset, and nobody says start"):
        stage.stop()
        stage.sleep(0.5)
        stage.robot.reset()
        stage.sleep(1.0)
