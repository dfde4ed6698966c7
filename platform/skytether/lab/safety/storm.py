"""Storms: processes frozen and killed at random, stops, resets and starts between; the same for the same seed.

What holds always is held against it: limits, an acknowledged stop until somebody resets, a standstill until somebody
says start.
"""

from __future__ import annotations

import signal
from collections.abc import Callable
from random import Random
from typing import NamedTuple

from skytether.guard.clock import now
from skytether.robot.safety.client import GateError, ask

from .attacks import Attacks
from .robot import StagingError
from .stage import Stage

SEEDS = (1, 2, 3)
_LASTS_S = 2.5
_MOST_ACTS = 10
_FREEZES_S = ((0.015, 0.1), (0.05, 0.15), (0.1, 0.4), (0.3, 1.5))
"""Around the patience of guard and gate most of all."""
_PATIENCE_S = 0.6
"""For an answer: somebody may be frozen."""
_LOOK_S = 0.003
_WATCH_S = 0.5
"""After all go on, the robot has to stay where it stands."""


class _Act(NamedTuple):
    at: float
    what: str
    role: str
    lasts: float


def enter(attacks: Attacks) -> None:
    """Add them."""
    for seed in SEEDS:
        attacks.add(f"storm-{seed}", WHAT.format(seed), storm(seed, ("agent", "gate", "guard")), seconds=6)


WHAT = "processes are frozen and killed at random, stops, resets and starts between (seed {})"


def storm(seed: int, roles: tuple[str, ...]) -> Callable[[Stage], None]:
    """One storm."""

    def run(stage: Stage) -> None:
        _Storm(stage, _plan(Random(seed), roles)).run()

    return run


def _plan(dice: Random, roles: tuple[str, ...]) -> list[_Act]:
    acts = []
    for _ in range(dice.randint(2, _MOST_ACTS)):
        what = dice.choice(["freeze"] * 6 + ["kill"] * 2 + ["stop"] * 2 + ["stop-kill", "reset", "start"])
        lasts = dice.uniform(*dice.choice(_FREEZES_S))
        acts.append(_Act(dice.uniform(0, 0.8 * _LASTS_S), what, dice.choice(roles), lasts))
    return sorted(acts)


class _Storm:
    """One under way.

    Args:
        stage: Where.
        plan: What happens, in order of time.
    """

    def __init__(self, stage: Stage, plan: list[_Act]) -> None:
        self._stage = stage
        self._robot = stage.robot
        self._plan = plan
        self._frozen: dict[int, float] = {}
        self._stopped_at: float | None = None
        """When a stop was acknowledged that nobody has reset since."""
        self._idle_at: float | None = None
        """Since when nobody may begin to drive: the gate was killed, or the robot reset."""

    def run(self) -> None:
        """To its end, and until all go on."""
        began = now()
        while now() - began < _LASTS_S:
            self._thaw(now())
            while self._plan and self._plan[0].at <= now() - began:
                self._do(self._plan.pop(0))
            self._stage.sleep(_LOOK_S)
        self._thaw(float("inf"))
        if self._robot.guard.poll() is not None:
            self._robot.start_guard()
        self._stage.expect(self._answers, "a gate answers after the storm")
        self._stage.sleep(_WATCH_S)
        if self._stopped_at is not None and not self._robot.ask("status")["stopped"]:
            self._stage.wrong("stop", "an acknowledged stop is lost in the storm")
        self._end_of_stop()
        self._end_of_idleness()

    def _do(self, act: _Act) -> None:
        try:
            if act.what in ("stop", "stop-kill"):
                self._ask("stop")
                self._stopped_at = self._stopped_at or now()
            if act.what in ("kill", "stop-kill"):
                self._idle_at = self._idle_at or (now() if act.role in ("gate", "guard") else None)
                self._robot.signal(act.role, signal.SIGKILL)
            elif act.what == "freeze":
                self._frozen[self._robot.signal(act.role, signal.SIGSTOP)] = now() + act.lasts
            elif act.what == "reset":
                self._end_of_stop()
                asked = now()
                self._ask("reset")
                self._idle_at = self._idle_at or asked
            elif act.what == "start":
                self._end_of_idleness()
                self._ask("start")
        except (GateError, StagingError):  # nobody answers or says no, or that process is dead already
            return

    def _thaw(self, until: float) -> None:
        for pid in [pid for pid, end in self._frozen.items() if end <= until]:
            del self._frozen[pid]
            self._robot.kill(pid, signal.SIGCONT)

    def _end_of_stop(self) -> None:
        promised = self._stage.promised
        if self._stopped_at is not None:
            self._stage.stood(self._stopped_at, promised.stop + promised.partner, "a stop was acknowledged in a storm")
        self._stopped_at = None

    def _end_of_idleness(self) -> None:
        promised = self._stage.promised
        if self._idle_at is not None:
            within = promised.stop + 2 * promised.partner
            self._stage.stood(self._idle_at, within, "nobody has said start in a storm")
        self._idle_at = None

    def _ask(self, do: str) -> None:
        ask(self._robot.folder, {"do": do, "reason": "a storm"}, _PATIENCE_S)

    def _answers(self) -> bool:
        if self._robot.guard.poll() is not None:  # it was told to end, or braked before it ended
            self._robot.start_guard()
        try:
            ask(self._robot.folder, {"do": "status"}, _PATIENCE_S)
        except GateError:
            return False
        return True
