"""The service navigation tried in the simulated building, with parameters of one's own: to map it, to drive, to patrol.

All but robot and building is real, as in `nine_goals`: an orchestrator of its own, the service's process, the bridge,
the agent. Where the service maps, a guide drives the robot past the building's goals, as a person with a joystick does.
"""

from __future__ import annotations

import json
import shutil
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from skytether.api.client import Client
from skytether.api.rest import RobotCreate, SiteCreate
from skytether.messages import String, Twist, decode
from skytether.robot.agent.agent import Agent
from skytether.robot.agent.config import AgentConfig

from .embedded import EmbeddedOrchestrator
from .nine_goals import LIMITS, ROBOT, SERVICE
from .trial.errors import TrialError
from .world.agent import Clockwork, WorldGraph, WorldHardware
from .world.contacts import Contact
from .world.guide import Guide
from .world.picture import draw_run, frame
from .world.plan import building
from .world.simulation import Simulation

FILES = ("map", "keep_out", "speed_zones", "behaviours")
"""Parameters that name files."""
_START_LIMIT_S = 180.0
"""Numba compiles for a while where it has not yet."""
_FIND_LIMIT_S = 120.0
"""Likewise: the first match of a scan with the map is compiled then. Without `start` the robot may never be found."""
_FAR_M = 0.1
"""What has driven less has not driven."""
_LOOK_S = 0.05
_FRAME_S = 0.2
_SAVE_EVERY_S = 2.0
_SETTLE_S, _SETTLE_LIMIT_S = 6.0, 60.0
"""After the guide stands: no scan was kept for so long, so that the map was saved with the last one; and no longer."""


class ParamsError(ValueError):
    """The file of parameters cannot be used; the text says why."""


def read_params(file: Path) -> tuple[dict[str, Any], tuple[Path, ...]]:
    """Read a YAML file of the service's parameters. Files that it names are looked for beside it.

    Returns:
        The parameters, with absolute paths; and the folders that the service must be able to read.

    Raises:
        ParamsError: It is no such file.
    """
    try:
        found = yaml.safe_load(file.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise ParamsError(f"{file} cannot be read: {error}") from error
    if not isinstance(found, dict):
        raise ParamsError(f"{file} holds no parameters: write 'name: value', as 'mode: map'")
    params, folders = dict(found), []
    for name in FILES:
        value = params.get(name)
        if isinstance(value, str) and value:
            path = (file.parent / value).resolve()
            params[name] = str(path)
            folders.append(path.parent)
    return params, tuple(dict.fromkeys(folders))


@dataclass(frozen=True, slots=True)
class Driven:
    """What came of a run.

    Attributes:
        state: The service's last, as `skytether_services.navigation` names it.
        code: Likewise.
        message: Likewise.
        goal: Of the list, that is driven to.
        round: Of the list.
        time_s: Since the service had found the robot, or matched its first scan, or told what is wrong [s].
        distance_m: Way covered.
        contacts: What the robot touched.
        files: What was written.
    """

    state: str
    code: str
    message: str
    goal: int
    round: int
    time_s: float
    distance_m: float
    contacts: tuple[Contact, ...]
    files: tuple[Path, ...]

    @property
    def wrong(self) -> str | None:
        """Why this was no good run; None: it was one. A run of which the time was over on the way is good."""
        why = f"{self.code}: {self.message}"
        if self.contacts:
            return f"the robot touched {self.contacts[0].name}"
        if self.state in ("failed", "standing"):
            return why
        if self.state == "mapping" and len(self.files) == 1:
            return f"no map was saved: {self.message}"
        if self.distance_m < _FAR_M:
            return f"the robot did not move; {self.state}: {self.message}"
        return None

    def document(self) -> dict[str, Any]:
        """For ``--json``."""
        return {
            "state": self.state,
            "code": self.code,
            "message": self.message,
            "goal": self.goal,
            "round": self.round,
            "time_s": round(self.time_s, 2),
            "distance_m": round(self.distance_m, 3),
            "contacts": [{"with": str(c.kind), "name": c.name} for c in self.contacts],
            "files": [str(file) for file in self.files],
        }


class _Base(WorldHardware):
    """Obeys the agent; or, as soon as it is asked to, the guide, whatever the agent says."""

    def __init__(self, world: Simulation, graph: WorldGraph) -> None:
        super().__init__(Clockwork(world), graph=graph)
        self._robot = world.robots[0]
        self.guide = Guide(world.plan.goals, world.params)
        self.guided = threading.Event()

    def write(self, twist: Twist) -> None:
        super().write(self.guide.step(self._robot.pose, self._robot.scan) if self.guided.is_set() else twist)


def drive(
    params: Mapping[str, Any],
    output: Path,
    *,
    readable: tuple[Path, ...] = (),
    seconds: float = 600.0,
    seed: int = 1,
    on_status: Callable[[float, Mapping[str, Any]], None] = lambda *_: None,
) -> Driven:
    """Drive, in real time, until all goals are reached or given up, the guide has been everywhere, or the time is over.

    Args:
        params: Of the service.
        output: Folder for the picture of the way, and the map that was built; made if missing.
        readable: Folders that the service must be able to read.
        seconds: Counted as `Driven.time_s`.
        seed: Of the noise of sensors and odometry.
        on_status: Told the time [s] and the service's status, whenever its state, code or goal changes.

    Raises:
        TrialError: The service did not speak in time.
        skytether.api.client.ApiError: The parameters are refused.
        OSError: Something cannot be written.
    """
    output.mkdir(parents=True, exist_ok=True)
    world = Simulation(building(), seed=seed)
    graph = WorldGraph()
    base = _Base(world, graph)
    status: dict[str, Any] = {}
    mapping = params.get("mode") == "map"
    if mapping:
        often = {"save_every": _SAVE_EVERY_S, **params.get("mapping", {})}
        params = {**params, "mapping": often}

    def on_status_message(payload: bytes | memoryview) -> None:
        status.update(json.loads(decode(String, payload, "cdr").data))

    frames = [frame(world)]
    with ExitStack() as stack:
        orchestrator = stack.enter_context(EmbeddedOrchestrator())
        operator = stack.enter_context(Client(orchestrator.url, orchestrator.operator_token))
        if readable:
            options = {"readable": [str(folder) for folder in readable]}
            operator.create_site(SiteCreate(name="building", tier="edge", runtime="process", options=options))
            operator.delete_site("local")
        token = operator.create_robot(RobotCreate(name=ROBOT, services=(SERVICE,))).token
        config = AgentConfig(
            robot=ROBOT, url=orchestrator.url, token=token, service=SERVICE, params=params, limits=LIMITS,
            bind=("127.0.0.1", 0),
        )  # fmt: skip
        agent = Agent(config, base, graph=graph)
        stack.callback(graph.subscribe("status", on_status_message))
        stack.enter_context(agent)
        # A scan that was matched: before that they would only queue up, and be left out.
        _wait_until(lambda: bool(status.get("scans") if mapping else status), agent)
        if mapping:
            base.guided.set()
        else:
            _wait_for_place(status)
        told: tuple[Any, ...] = ()
        began, framed_at, done_at = time.monotonic(), 0.0, seconds
        while (now := time.monotonic() - began) < done_at:
            known = tuple(status.get(key) for key in ("state", "code", "goal", "round"))
            if known != told:
                told = known
                on_status(now, dict(status))
            if now - framed_at >= _FRAME_S:
                framed_at = now
                frames.append(frame(world))
            if status["state"] in ("succeeded", "failed") or (base.guide.done and done_at == seconds):
                done_at = now
            time.sleep(_LOOK_S)
        took = time.monotonic() - began
        files = []
        if mapping:
            base.guided.clear()  # the agent's fallback: it stands
            _settle(status)
            files = _copied(status.get("saved"), output)
    way = output / "way.png"
    robot = world.robots[0]
    title = f"{status['state']}: {robot.distance:.1f} m in {took:.1f} s, {len(world.contacts)} contacts"
    draw_run(world.plan, frames, way, contacts=world.contacts, title=title)
    return Driven(
        state=status["state"],
        code=status.get("code", ""),
        message=status.get("message", ""),
        goal=status.get("goal", 0),
        round=status.get("round", 0),
        time_s=took,
        distance_m=robot.distance,
        contacts=tuple(world.contacts),
        files=(*files, way),
    )


def _wait_until(there: Callable[[], bool], agent: Agent) -> None:
    """Raises TrialError where it does not come true in time."""
    deadline = time.monotonic() + _START_LIMIT_S
    while not there():
        if time.monotonic() > deadline:
            trouble = agent.status().trouble or "it said nothing"
            raise TrialError(f"the service did not speak within {_START_LIMIT_S:.0f} s: {trouble}")
        time.sleep(_LOOK_S)


def _wait_for_place(status: Mapping[str, Any]) -> None:
    """Until the robot is found on the map, or cannot be, or the limit is over: the run says then what is wrong."""
    deadline = time.monotonic() + _FIND_LIMIT_S
    hopeless = ("no_map", "map_broken")
    while time.monotonic() < deadline and not (status.get("localised") or status.get("code") in hopeless):
        time.sleep(_LOOK_S)


def _settle(status: Mapping[str, Any]) -> None:
    """Wait until the map is on the disk."""
    ends = time.monotonic() + _SETTLE_LIMIT_S
    scans, since = status.get("scans"), time.monotonic()
    while (now := time.monotonic()) < ends and not (status.get("saved") and now - since > _SETTLE_S):
        if status.get("scans") != scans:
            scans, since = status.get("scans"), now
        time.sleep(_LOOK_S)


def _copied(saved: str | None, output: Path) -> list[Path]:
    """The map's files, from the instance's data, which ends with the orchestrator."""
    if not saved:
        return []
    files = [Path(saved).with_suffix(suffix) for suffix in (".yaml", ".pgm", ".png")]
    return [Path(shutil.copyfile(file, output / file.name)) for file in files if file.exists()]
