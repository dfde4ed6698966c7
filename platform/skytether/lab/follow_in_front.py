"""The interaction experiment of the thesis (Mello, section 5.5): a robot ahead of the person who steers it by the face.

A simulated robot asks an orchestrator for the service ``follow-in-front``, sends it what it sees of the person behind
it, and is driven. That person walks one round of a lemniscate marked on the floor, of which the robot knows nothing.
What is around robot and service is of `skytether.lab.trial`.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from statistics import median
from types import MappingProxyType
from typing import Any

from skytether.messages import Header, Message, Point32, PointCloud, Range
from skytether.robot.control.supervisor import VelocityLimits

from .follow_in_front_report import IMAGE, LASER, POSE, SCAN, SONAR
from .follow_in_front_result import FollowResult, FollowTraces
from .measures import kinematic_tracking_error
from .throttle import native_threads_time
from .trial.errors import TrialError
from .trial.results import Measured, Point, rounded
from .trial.rig import Drive, Rig, Status, Task
from .trial.scenario import ROBOT_CPU, Scenario, TrialSettings
from .world.camera import Camera
from .world.lemniscate import Lemniscate
from .world.operator import Operator
from .world.plan import hall
from .world.robot import RearParams, RobotParams
from .world.sensors import sonar_radius
from .world.simulation import CAMERA, REAR_SCAN, Readings, Simulation

ROBOT, SERVICE = "pioneer", "follow-in-front"
LIMITS = VelocityLimits(linear_max=0.8, angular_max=1.0, max_gap_s=0.3)
"""What the simulated robot can do. Commands come each 100 ms: one that is lost on the way must not stop it."""
NAMES: Mapping[str, str] = MappingProxyType({"odom": POSE, "scan": LASER, REAR_SCAN: SCAN, CAMERA: IMAGE})
"""Topics as the drivers of the thesis's robot name them (Table 2); its sonars are all in one message."""
FACE_RATE_EMBEDDED = 5.0
"""Faces a second on the robot's own computers (section 5.5.2) [Hz]; elsewhere the service's default, 15."""
SCENARIOS: Mapping[str, Scenario] = MappingProxyType(
    {
        scenario.name: scenario
        for scenario in (
            Scenario("embedded", params={"face_rate": FACE_RATE_EMBEDDED}, cpu=ROBOT_CPU),
            Scenario("edge", 0.0099, 0.0101, 0.0081),
            Scenario("commercial", 0.1241, 0.0144, 0.0023),
        )
    }
)
"""Round trips, deviations and losses that section 5.5.3 measured with ping."""
LOST_BEHIND_M, LOST_ASIDE_M = 2.5, 1.0
"""Further from the operator, or from the path, the robot is lost, and the trial over."""


@dataclass(frozen=True, slots=True)
class FollowSettings(TrialSettings):
    """One trial.

    Attributes:
        share: Of the round, after which it is over.
        drive_limit_s: It must be by then [s]: thrice the thesis's mean.
    """

    share: float = 1.0
    drive_limit_s: float = 160.0

    def document(self) -> dict[str, Any]:
        return {**TrialSettings.document(self), "share": self.share}


class _Pictures:
    """Brings the camera's pictures to the robot, and counts what drawing them costs, which no robot pays.

    Args:
        publish: As `WorldGraph.publish`.
    """

    def __init__(self, publish: Callable[[str, Message], object]) -> None:
        self._publish = publish
        self._drawing_s = self._publishing_s = 0.0

    def publish(self, topic: str, message: Message) -> None:
        """In the camera's thread, which does nothing else but draw."""
        begun = time.thread_time()
        self._drawing_s = begun - self._publishing_s
        self._publish(NAMES[topic], message)
        self._publishing_s += time.thread_time() - begun

    def drawing_s(self) -> float:
        """Processor time so far [s], with that of the threads which the library for drawing has beside Python's."""
        return self._drawing_s + native_threads_time()


def sonar_cloud(readings: Readings, params: RobotParams) -> PointCloud | None:
    """The sonars' echoes in one message, as RosAria has them: points [m] in the robot's frame; None: there are none."""
    points, header = [], None
    for topic, message in readings:
        if isinstance(message, Range):
            angle = params.sonar_angles[int(topic.removeprefix("sonar_"))]
            away = sonar_radius(params, angle) + message.range
            points.append(Point32(away * math.cos(angle), away * math.sin(angle), params.laser_z))
            header = Header(message.header.stamp, "base_link")
    return PointCloud(header, points) if header is not None else None


class FollowTrial:
    """One run. A context manager, as its `Rig` is.

    Raises:
        WorldError: MuJoCo is missing. Entering: there is no OpenGL that draws without a display.
    """

    def __init__(self, settings: FollowSettings) -> None:
        self.settings = settings
        self.curve = Lemniscate()
        self.operator = Operator(self.curve, settings.seed)
        params = RobotParams(rear=RearParams())
        self.world = Simulation(hall(), seed=settings.seed, params=params, operator=self.operator)
        pictures = _Pictures(lambda topic, message: self.rig.graph.publish(topic, message))
        self.camera = Camera(self.world, pictures.publish)
        task = Task(SERVICE, settings.scenario.params, ROBOT, LIMITS, NAMES)
        observers = (self.camera.observe, self._note_sonars)
        self.rig = Rig(settings, task, self.world, observers=observers, simulating=pictures.drawing_s)
        self._operator_way: list[Point] = []
        self._looks = self._following = 0
        self._stack = ExitStack()

    def __enter__(self) -> FollowTrial:
        with ExitStack() as stack:
            stack.enter_context(self.camera)
            stack.enter_context(self.rig)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *error: object) -> None:
        self._stack.close()

    @property
    def round(self) -> float:
        """Share of it that the robot has done."""
        return 1.0 if self.operator.done else self.operator.lap.s / self.curve.length

    @property
    def lost(self) -> bool:
        """Whether the operator has lost the robot."""
        place = self.world.robots[0].pose[:2]
        aside = float(self.curve.distances([place])[0])
        return aside > LOST_ASIDE_M or math.dist(place, self.operator.pose[:2]) > LOST_BEHIND_M

    def drive(self, on_progress: Callable[[float, Status], None] = lambda *_: None) -> FollowResult:
        """Wait until the round is done, the robot is lost, or the time is over.

        Args:
            on_progress: Told the share of the round, and the service's status, some twenty times a second.

        Raises:
            TrialError: The service did not drive in time, or the camera gave up.
        """
        with self.rig.driving() as drive:
            for now in drive.passes():
                if self.camera.trouble:
                    raise TrialError(self.camera.trouble)
                if self.round >= self.settings.share or self.lost:
                    break
                self._looks += 1
                self._following += self.rig.status.get("state") == "following"
                if drive.tracker.sample(now):
                    self._operator_way.append(rounded(self.operator.pose[:2]))
                on_progress(self.round, self.rig.status)
            return self._result(drive.measured(), drive)

    def _note_sonars(self, world: Simulation, found: Sequence[Readings]) -> None:
        cloud = sonar_cloud(found[0], world.params)
        if cloud is not None:
            self.rig.graph.publish(SONAR, cloud)

    def _result(self, measured: Measured, drive: Drive) -> FollowResult:
        lost = self.lost
        aside = self.curve.distances(drive.tracker.way)
        traces = FollowTraces(**drive.tracker.traces(), operator=tuple(self._operator_way))
        return FollowResult(
            **measured.shared(),
            completed=self.round >= self.settings.share and not lost and not measured.contacts,
            round=self.round,
            lost=lost,
            kte_m=kinematic_tracking_error(aside) if aside.size else math.nan,
            deviation_max_m=float(aside.max()) if aside.size else math.nan,
            following=self._following / self._looks if self._looks else math.nan,
            up_mbit_s=_median_mbit(traces.sent_kbit_s),
            up_arrived_mbit_s=_median_mbit(traces.arrived_kbit_s),
            down_mbit_s=_median_mbit(traces.back_sent_kbit_s),
            down_arrived_mbit_s=_median_mbit(traces.back_arrived_kbit_s),
            traces=traces,
        )


def _median_mbit(kbit_s: Sequence[float]) -> float:
    return median(kbit_s) / 1000 if kbit_s else math.nan
