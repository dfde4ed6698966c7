"""Parameters of the service: what a robot may set when it asks for it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum

from skytether.service import param
from skytether_services.planar.geometry import Pose

from .checkers import GoalParams, ProgressParams
from .controller import MotionLimits
from .costmap import InflationParams
from .dwa import DwaParams
from .footprint import Footprint
from .layers import WindowParams
from .localisation import LocalisationParams
from .mppi import MppiParams
from .neighbours import SharingParams
from .obstacles import ObstacleParams
from .planner import PlannerParams
from .prediction import DelayParams


class ModeName(StrEnum):
    """What the service does."""

    NAVIGATE = "navigate"
    MAP = "map"


class ControllerName(StrEnum):
    """Which controller follows the path."""

    MPPI = "mppi"
    DWA = "dwa"


@dataclass(frozen=True)
class PoseParams:
    """A place with a heading, in the map."""

    x: float = param(unit="m", doc="in the map")
    y: float = param(unit="m", doc="in the map")
    yaw: float = param(0.0, unit="rad", doc="heading; positive: to the left")

    @property
    def pose(self) -> Pose:
        """The same, for the algorithms."""
        return Pose(self.x, self.y, self.yaw)


@dataclass(frozen=True)
class CornerParams:
    """A corner of the robot's outline."""

    x: float = param(unit="m", doc="forward of the centre of rotation")
    y: float = param(unit="m", doc="to the left of it")


_X, _Y, _CUT = 0.35, 0.25, 0.08
PIONEER_LX = (
    CornerParams(_X - _CUT, -_Y),
    CornerParams(_X, -_Y + _CUT),
    CornerParams(_X, _Y - _CUT),
    CornerParams(_X - _CUT, _Y),
    CornerParams(-_X + _CUT, _Y),
    CornerParams(-_X, _Y - _CUT),
    CornerParams(-_X, -_Y + _CUT),
    CornerParams(-_X + _CUT, -_Y),
)
"""The outline of the thesis's robot, which is that of the simulated world too."""


@dataclass(frozen=True)
class FootprintParams:
    """The robot's outline."""

    corners: tuple[CornerParams, ...] = param(
        PIONEER_LX, max_length=64, doc="of a convex polygon around the centre of rotation, in order; none: a circle"
    )
    radius: float = param(0.3, unit="m", gt=0, doc="of the circle, where there are no corners")
    padding: float = param(0.02, unit="m", ge=0, doc="added all around: cells are coarse, and so is a pose")

    @property
    def footprint(self) -> Footprint:
        """The same, for the algorithms.

        Raises:
            ValueError: It is no outline around the centre of rotation.
        """
        return Footprint(self.radius, tuple((corner.x, corner.y) for corner in self.corners), self.padding)


@dataclass(frozen=True)
class RateParams:
    """How often things are done: the remote frequencies of the thesis (Table 5), but for the planner's."""

    control: float = param(30.0, unit="Hz", gt=0, le=100, doc="of the loop: a velocity each time")
    planner: float = param(1.0, unit="Hz", gt=0, le=30, doc="a new plan at least as often; at once when blocked")
    local_costmap: float = param(40.0, unit="Hz", gt=0, le=100, doc="updates, at most one in each step of the loop")
    global_costmap: float = param(10.0, unit="Hz", gt=0, le=100, doc="updates, at most one in each step of the loop")
    publish_local_costmap: float = param(5.0, unit="Hz", ge=0, le=30, doc="on `local_costmap`; 0: never")
    publish_global_costmap: float = param(0.0, unit="Hz", ge=0, le=10, doc="on `global_costmap`; 0: never")
    publish_particles: float = param(1.0, unit="Hz", ge=0, le=10, doc="on `particle_cloud`; 0: never")
    publish_status: float = param(2.0, unit="Hz", gt=0, le=30, doc="on `status`; at once when it changes")


@dataclass(frozen=True)
class SensorParams:
    """What is expected of laser and odometry."""

    scan_timeout: float = param(0.6, unit="s", gt=0, doc="the robot stands when the newest scan is older")
    odometry_timeout: float = param(0.4, unit="s", gt=0, doc="the robot stands when the newest odometry is older")
    least_hits: float = param(
        0.02, ge=0, le=1, doc="share of a scan's rays that must meet something; with less the laser is taken for blind"
    )
    jump_distance: float = param(
        0.15, unit="m", gt=0, doc="odometry that moves this much more than the robot can, jumps"
    )
    jump_turn: float = param(0.3, unit="rad", gt=0, doc="and so does one that turns this much more")
    settle: float = param(1.0, unit="s", ge=0, doc="the robot stands so long after a jump of its odometry")
    laser: PoseParams | None = param(  # noqa: RUF009 - immutable
        None, doc="pose of the laser on the robot; none: from `tf`, as the transform of the scans' frame"
    )


@dataclass(frozen=True)
class LocaliserParams:
    """How the robot is found on the map."""

    min_particles: int = param(500, ge=50, le=20_000, doc="as few are enough while all are in one place")
    max_particles: int = param(2000, ge=50, le=20_000, doc="as many at most")
    start_deviation: float = param(0.25, unit="m", gt=0, doc="standard deviation of a first pose that was given")
    start_turn_deviation: float = param(0.15, unit="rad", gt=0, doc="of its heading")

    @property
    def localisation(self) -> LocalisationParams:
        """The same, for the algorithm."""
        return replace(LocalisationParams(), min_particles=self.min_particles, max_particles=self.max_particles)


@dataclass(frozen=True)
class MappingModeParams:
    """The mode that maps."""

    save_as: str = param(
        "map", doc="name of the files in the instance's data: NAME.yaml, .pgm, .png; where there is one, NAME-2"
    )
    save_every: float = param(30.0, unit="s", ge=0, doc="between two savings; 0: at the end and when asked only")
    publish_every: float = param(5.0, unit="s", ge=0, doc="between two maps on `new_map`; 0: never")


@dataclass(frozen=True)
class Params:
    """What a robot may set when it asks for the service."""

    mode: ModeName = param(  # noqa: RUF009 - immutable
        ModeName.NAVIGATE, doc="drive to goals on a map, or build a map while somebody else drives"
    )
    map: str = param(
        "", doc="YAML file of the map, as of map_server; relative: in the instance's data; none: from the topic `map`"
    )
    start: PoseParams | None = param(  # noqa: RUF009 - immutable
        None, doc="where the robot is at the start; none: it has to find out; in mode `map`: the origin"
    )
    goals: tuple[PoseParams, ...] = param((), max_length=1000, doc="where to go at once, one after the other")
    rounds: int = param(1, ge=0, doc="how often the list of goals is driven; 0: again and again")
    stop_at_each: bool = param(
        True, doc="stand at each goal of a list with its heading; false: drive through, to the last"
    )
    skip_unreachable: bool = param(False, doc="go on with the next goal of a list where one is given up")
    behaviours: str = param("", doc="YAML file of the behaviour tree; none: the built-in one")
    controller: ControllerName = param(ControllerName.MPPI, doc="what follows the path")  # noqa: RUF009 - immutable
    rates: RateParams = param(RateParams(), doc="how often things are done")  # noqa: RUF009 - immutable
    footprint: FootprintParams = param(FootprintParams(), doc="the robot's outline")  # noqa: RUF009
    limits: MotionLimits = param(MotionLimits(), doc="what the robot can do")  # noqa: RUF009
    sensors: SensorParams = param(SensorParams(), doc="what is expected of laser and odometry")  # noqa: RUF009
    localisation: LocaliserParams = param(LocaliserParams(), doc="how the robot is found on the map")  # noqa: RUF009
    inflation: InflationParams = param(InflationParams(), doc="costs around what is in the way")  # noqa: RUF009
    obstacles: ObstacleParams = param(ObstacleParams(), doc="what scans do to the costmaps")  # noqa: RUF009
    window: WindowParams = param(WindowParams(), doc="size of the local costmap")  # noqa: RUF009
    keep_out: str = param("", doc="mask of zones that no part of the robot may enter, a YAML file like the map's")
    speed_zones: str = param("", doc="mask of zones in which the speed is limited to a percentage, likewise")
    planner: PlannerParams = param(PlannerParams(), doc="how paths are searched")  # noqa: RUF009
    goal: GoalParams = param(GoalParams(), doc="when a goal counts as reached")  # noqa: RUF009
    pass_within: float = param(0.5, unit="m", gt=0, doc="a goal that is driven through is passed as near as this")
    progress: ProgressParams = param(ProgressParams(), doc="when the robot counts as stuck")  # noqa: RUF009
    delay: DelayParams = param(DelayParams(), doc="how the delay of the link is made up for")  # noqa: RUF009
    mppi: MppiParams = param(MppiParams(), doc="of this controller; its period is that of the loop")  # noqa: RUF009
    dwa: DwaParams = param(DwaParams(), doc="of this controller")  # noqa: RUF009
    sharing: SharingParams = param(SharingParams(), doc="with the other robots of the group")  # noqa: RUF009 - immutable
    mapping: MappingModeParams = param(MappingModeParams(), doc="of the mode `map`")  # noqa: RUF009 - immutable
    seed: int = param(1, ge=0, doc="of particles and trajectories")
