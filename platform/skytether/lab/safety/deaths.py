"""Attacks on processes: killed, frozen and continued, told to end, alone and two at a time."""

from __future__ import annotations

import signal
from collections.abc import Callable
from contextlib import nullcontext
from itertools import permutations

from skytether.guard.velocity import STANDSTILL

from .attacks import Attacks
from .stage import Promised, Stage

Run = Callable[[Stage], None]
ROLES = ("agent", "gate", "guard")
_FREEZES_S = (0.2, 1.0, 2.0)
_NEXT_S = 0.05
"""From the first death to the second: less than it takes to notice the first."""
_TOO_OFTEN = 3
"""Ends of the gate within a minute after which the robot is stopped."""
_WATCH_S = 1.0
"""For so long the robot has to stay where it stands."""
_STARTS_AGAIN_S = 0.5
"""The guard starts gate and writer again; none drives on sooner than this."""


def enter(attacks: Attacks, roles: tuple[str, ...] = ROLES) -> None:
    """Add them, for the processes that there are."""
    for role in roles:
        attacks.add(f"{role}-killed", f"the {role} is killed", killed(role), seconds=3)
        for seconds in _FREEZES_S:
            attacks.add(
                f"{role}-frozen-{seconds:g}",
                f"the {role} is frozen for {seconds:g} s, and goes on",
                frozen(role, seconds),
                seconds=seconds + 1.5,
            )
    for first, second in permutations(roles, 2):
        attacks.add(
            f"{first}-{second}-killed",
            f"the {first} is killed, {1e3 * _NEXT_S:.0f} ms later the {second}",
            both_killed(first, second),
            seconds=3.5,
        )
    for first, second in permutations(("gate", "guard")):
        attacks.add(
            f"{first}-{second}-frozen",
            f"the {first} is frozen for 1 s, {1e3 * _NEXT_S:.0f} ms later the {second}; both go on in this order",
            _both_frozen(first, second),
            seconds=3,
        )
        attacks.add(
            f"{first}-frozen-{second}-killed",
            f"the {first} is frozen for 1 s, {1e3 * _NEXT_S:.0f} ms later the {second} is killed",
            _frozen_and_killed(first, second),
            seconds=4,
        )
    attacks.add("gate-killed-thrice", "the gate is killed three times within a minute", _thrice, seconds=6)
    for name, number in (("terminated", signal.SIGTERM), ("hung-up", signal.SIGHUP)):
        attacks.add(
            f"guard-{name}",
            f"the guard is told to end ({number.name})",
            ended(number, everybody=False),
            seconds=4,
        )
        attacks.add(
            f"all-{name}",
            f"guard, gate and agent are told to end at once ({number.name})",
            ended(number, everybody=True),
            seconds=4,
        )


def _alone(role: str) -> Callable[[Promised], float]:
    return lambda promised: promised.agent if role == "agent" else promised.partner


def _two(first: str, second: str) -> Callable[[Promised], float]:
    if {first, second} & {"agent", "writer"}:  # somebody is left who can speak to the wheels
        return lambda promised: promised.partner
    return lambda promised: promised.silence


def killed(role: str) -> Run:
    """One is killed."""

    def run(stage: Stage) -> None:
        victim = stage.robot.pid(role)
        with stage.stands(_alone(role)(stage.promised), f"the {role} was killed"):
            stage.robot.kill(victim)
            if role == "writer":  # the next one goes on from the standstill, as soon as it is there
                stage.expect(lambda: stage.robot.velocity == STANDSTILL, "the robot stands")
            else:
                stage.sleep(_STARTS_AGAIN_S if role == "gate" else _WATCH_S)
        if role == "guard":
            stage.expect(lambda: not stage.robot.alive("gate"), "the gate ends without its guard")

    return run


def _thrice(stage: Stage) -> None:
    for _ in range(_TOO_OFTEN - 1):
        stage.robot.another_gate(stage.robot.signal("gate", signal.SIGKILL))
        stage.robot.go()
    victim = stage.robot.pid("gate")
    with stage.stands(stage.promised.partner, "the gate was killed three times; nobody has reset the robot"):
        stage.robot.kill(victim)
        stage.robot.another_gate(victim)
        stage.robot.start()
        stage.sleep(_WATCH_S)
        if not stage.robot.ask("status")["stopped"]:
            stage.wrong("stop", "a gate that ended three times within a minute is not stopped")


def frozen(role: str, seconds: float) -> Run:
    """One is frozen for a while, and goes on."""

    def run(stage: Stage) -> None:
        pid = stage.robot.pid(role)
        demand = (
            stage.stands(_alone(role)(stage.promised), f"the {role} was frozen") if seconds > 0.5 else nullcontext()
        )
        with demand:
            stage.robot.kill(pid, signal.SIGSTOP)
            stage.sleep(seconds)
        stage.robot.kill(pid, signal.SIGCONT)
        stage.drives_on(f"the robot drives on after the {role} was frozen for {seconds:g} s")

    return run


def both_killed(first: str, second: str) -> Run:
    """One is killed, and then another."""

    def run(stage: Stage) -> None:
        one, victim = stage.robot.pid(first), stage.robot.pid(second)
        stage.robot.kill(one)
        stage.sleep(_NEXT_S)
        with stage.stands(_two(first, second)(stage.promised), f"{first} and {second} were killed"):
            stage.robot.kill(victim)
            stage.sleep(_WATCH_S)

    return run


def _both_frozen(first: str, second: str) -> Run:
    def run(stage: Stage) -> None:
        one, other = stage.robot.pid(first), stage.robot.pid(second)
        stage.robot.kill(one, signal.SIGSTOP)
        stage.sleep(_NEXT_S)
        with stage.stands(_two(first, second)(stage.promised), f"{first} and {second} were frozen"):
            stage.robot.kill(other, signal.SIGSTOP)
            stage.sleep(1.0 - _NEXT_S)
        stage.robot.kill(one, signal.SIGCONT)
        stage.sleep(_NEXT_S)
        stage.robot.kill(other, signal.SIGCONT)
        stage.drives_on(f"the robot drives on after {first} and {second} were frozen")

    return run


def _frozen_and_killed(first: str, second: str) -> Run:
    def run(stage: Stage) -> None:
        frozen, victim = stage.robot.pid(first), stage.robot.pid(second)
        stage.robot.kill(frozen, signal.SIGSTOP)
        stage.sleep(_NEXT_S)
        with stage.stands(_two(first, second)(stage.promised), f"the {first} was frozen and the {second} killed"):
            stage.robot.kill(victim)
            stage.sleep(1.0 - _NEXT_S)
            stage.robot.kill(frozen, signal.SIGCONT)
            stage.sleep(0.5)

    return run


def ended(number: signal.Signals, everybody: bool) -> Run:
    """The guard is told to end; or all are, as systemd does."""

    def run(stage: Stage) -> None:
        promised = stage.promised.partner if everybody else stage.promised.stop
        roles = ROLES if everybody else ("guard",)
        victims = [stage.robot.pid(role) for role in roles]
        with stage.stands(promised, f"{', '.join(roles)}: told to end"):
            for victim in victims:
                stage.robot.kill(victim, number)
            stage.sleep(_WATCH_S)
        stage.expect(lambda: not stage.robot.alive("guard"), "the guard ends when it is told to")
        stage.expect(lambda: not stage.robot.alive("gate"), "the gate ends with its guard")

    return run
