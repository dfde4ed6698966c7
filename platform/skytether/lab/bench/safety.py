"""The promises of docs/safety.md, attacked on real processes: what the wheels received, held against them.

Guard, gate and agent are the real programs; sensors and wheels are played here, on the gate's own sockets. Each attack
begins with a robot that drives, and ends with one that drives again. Only a suspend is rehearsed, without processes.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from skytether.lab.safety import cloud, deaths, hardware, ros1, ros2, starve, stops, storm, suspend
from skytether.lab.safety.attacks import Attack, Attacks, MakeRobot
from skytether.lab.safety.checker import Finding, tightest
from skytether.lab.safety.cores import busy_cores
from skytether.lab.safety.robot import PlayedRobot, StagingError
from skytether.lab.safety.stage import Stage
from skytether.robot.safety.client import GateError

_SHOWN = 5
"""Violations of an attack that are told in words; the others are counted."""
_START_S = 3.0

Tell = Callable[[str], object]


@dataclass(frozen=True, slots=True)
class SafetyRow:
    """One line of the table.

    Attributes:
        attack: Its name.
        n: How often it was staged.
        violations: Promises that were not kept.
        velocity_max_m_s: Fastest that the wheels were told.
        acceleration_max_m_s2: Largest change of velocity by its time, a period of the loop added: that much a time may
            be off. Braking included.
        standstill_max_s: Time from the attack to standstill, where the least was to spare; None: none is demanded.
        promised_s: What it may be, from the configuration.
        what: The violations in words, the first few of them.
    """

    attack: str
    n: int
    violations: int
    velocity_max_m_s: float
    acceleration_max_m_s2: float
    standstill_max_s: float | None
    promised_s: float | None
    what: tuple[str, ...]

    def line(self, what: str) -> str:
        """For ``--markdown``; ``what`` is done, in words."""
        stands = "" if self.standstill_max_s is None else f"{self.standstill_max_s:.2f} of {self.promised_s:.2f}"
        return (
            f"| `{self.attack}` | {what} | {self.n} | {self.violations} | {self.acceleration_max_m_s2:.1f} | {stands} |"
        )

    def document(self) -> dict[str, object]:
        """For ``--json``."""
        return asdict(self)


HEADING = """\
| attack | what is done | n | violations | m/s² | stands after [s] |
| --- | --- | --- | --- | --- | --- |"""
"""Of the lines of ``--markdown``."""


def attacks(with_ros1: bool = False, with_ros2: bool = False) -> list[Attack]:
    """All that there are, in the order in which they are staged.

    Args:
        with_ros1: Those that need a ROS 1 master, too.
        with_ros2: Those that need ROS 2, too.
    """
    known = Attacks()
    deaths.enter(known)
    stops.enter(known)
    hardware.enter(known)
    cloud.enter(known)
    starve.enter(known)
    suspend.enter(known)
    storm.enter(known)
    if with_ros1:
        ros1.enter(known)
    if with_ros2:
        ros2.enter(known)
    return known.all


def select(names: Sequence[str], with_ros1: bool = False, with_ros2: bool = False) -> list[Attack]:
    """Those of that name, or whose name begins with it and a hyphen; without a name all of them.

    Args:
        names: Of attacks.
        with_ros1: See `attacks`.
        with_ros2: See `attacks`.

    Raises:
        ValueError: There is none.
    """
    known = attacks(with_ros1, with_ros2)
    chosen = []
    for name in names:
        found = [attack for attack in known if attack.name == name or attack.name.startswith(f"{name}-")]
        if not found:
            raise ValueError(f"there is no attack '{name}'; there are: {', '.join(attack.name for attack in known)}")
        chosen += [attack for attack in found if attack not in chosen]
    return chosen or known


def estimate(chosen: Sequence[Attack], n: int) -> float:
    """About how long it takes [s]."""
    return _START_S + n * sum(attack.seconds + (_START_S if attack.spoils else 0) for attack in chosen)


def bench_safety(
    chosen: Sequence[Attack],
    n: int,
    busy: bool = False,
    tell: Tell = lambda _: None,
    safety: Mapping[str, Any] | None = None,
) -> Iterator[SafetyRow]:
    """Stage attacks, one after the other.

    Args:
        chosen: See `select`.
        n: How often each.
        busy: Other programs take all cores meanwhile.
        tell: Told what goes on.
        safety: Keys of the section ``safety`` that are to be others.
    """
    with ExitStack() as undo:
        if busy:
            undo.enter_context(busy_cores())
        robots = undo.enter_context(_Robots(safety or {}))
        for attack in chosen:
            found = []
            for i in range(n):
                tell(f"{attack.name}, {i + 1} of {n}")
                with ThreadPoolExecutor(1) as alone:  # what a thread mounts is gone with it, and with what it started
                    found.append(alone.submit(_stage, attack, robots).result())
            yield _row(attack, found)


class _Robots:
    """The robot that is attacked; another one when it is of no use any more."""

    def __init__(self, safety: Mapping[str, Any]) -> None:
        self._safety = safety
        self._undo = ExitStack()
        self._robot: PlayedRobot | None = None
        self._made_by: MakeRobot | None = None

    def __enter__(self) -> _Robots:
        return self

    def __exit__(self, *_: object) -> None:
        self.end()

    def get(self, attack: Attack) -> PlayedRobot:
        """One that drives, or will."""
        if self._made_by is not attack.robot:
            self.end()
        if self._robot is None:
            folder = Path(self._undo.enter_context(tempfile.TemporaryDirectory(prefix="skytether-bench-")))
            self._robot = self._undo.enter_context((attack.robot or PlayedRobot)(folder, self._safety))
            self._made_by = attack.robot
        return self._robot

    def end(self) -> None:
        """End it; the next one is new."""
        self._robot = None
        self._undo.close()


def _stage(attack: Attack, robots: _Robots) -> Finding:
    """Stage an attack once: a robot that drives, the attack, and a robot that drives again."""
    if attack.rehearse is not None:
        return attack.rehearse()
    stage = Stage(robots.get(attack))
    try:
        stage.robot.go()
        if attack.run is not None:
            attack.run(stage)
        if not attack.spoils:
            stage.robot.go()
    except (StagingError, GateError, OSError) as error:
        stage.wrong("stuck", str(error).partition("\n")[0])
    finding = stage.finding()
    if attack.spoils or any(violation.kind == "stuck" for violation in finding.violations):
        robots.end()
    return finding


def _row(attack: Attack, findings: Sequence[Finding]) -> SafetyRow:
    violations = [violation for finding in findings for violation in finding.violations]
    took, promised = tightest(f.standstill for f in findings if f.standstill is not None) or (None, None)
    return SafetyRow(
        attack=attack.name,
        n=len(findings),
        violations=len(violations),
        velocity_max_m_s=round(max(finding.velocity_max for finding in findings), 3),
        acceleration_max_m_s2=round(max(finding.acceleration_max for finding in findings), 3),
        standstill_max_s=round(took, 3) if took is not None else None,
        promised_s=round(promised, 3) if promised is not None else None,
        what=tuple(f"{violation.kind}: {violation.text}" for violation in violations[:_SHOWN]),
    )
