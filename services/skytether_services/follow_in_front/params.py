"""Parameters of the service: what a robot may set when it asks for it."""

from __future__ import annotations

import math
from dataclasses import dataclass

from skytether.service import param
from skytether_services.planar.geometry import Pose

from .formation import FormationParams
from .operator import OperatorParams

_BEYOND = 1.0
"""Who was picked may go so much further away, m."""


@dataclass(frozen=True)
class LaserPose:
    """Where the laser is on the robot."""

    x: float = param(unit="m", doc="forward of the centre of rotation")
    y: float = param(0.0, unit="m", doc="to the left of it")
    yaw: float = param(math.pi, unit="rad", doc="where it looks; pi: straight back")

    @property
    def pose(self) -> Pose:
        """The same, for the algorithms."""
        return Pose(self.x, self.y, self.yaw)


@dataclass(frozen=True)
class Params:
    """What a robot may set when it asks for the service."""

    rate: float = param(10.0, unit="Hz", ge=2, le=60, doc="how often a velocity is sent")
    face_rate: float = param(15.0, unit="Hz", ge=0.5, le=60, doc="pictures a second that are looked at, at the most")
    least_face_rate: float = param(5.0, unit="Hz", gt=0, le=60, doc="with fewer faces a second the robot goes slowly")
    distance: float = param(0.9, unit="m", ge=0.5, le=2.0, doc="from the robot's middle to the operator's")
    distance_gain: float = param(0.7, unit="1/s", gt=0, le=3, doc="velocity per error of the distance")
    steering_gain: float = param(0.9, unit="1/s", gt=0, le=3, doc="turn per angle of the face")
    dead_band: float = param(0.087, unit="rad", ge=0, le=0.5, doc="a face that points less aside does not steer")
    max_linear: float = param(0.8, unit="m/s", gt=0, le=1.5, doc="largest forward speed; never backwards")
    max_angular: float = param(0.6, unit="rad/s", gt=0, le=3, doc="largest turning rate")
    slow_after: float = param(0.6, unit="s", gt=0, le=5, doc="with legs or a face older than this the robot slows down")
    stop_after: float = param(1.2, unit="s", gt=0, le=10, doc="with legs or a face older than this it stands")
    predict: bool = param(True, doc="whether the delay of the link is made up for by prediction")
    near: float = param(0.4, unit="m", gt=0, le=2, doc="an operator is no nearer to the robot's middle")
    far: float = param(2.0, unit="m", gt=0, le=4, doc="nor further away, to be picked")
    side: float = param(0.61, unit="rad", gt=0, le=1.5, doc="nor further off the line straight back, to be picked")
    field_of_view: float = param(
        1.082, unit="rad", gt=0.1, le=2.5, doc="of the camera, from the left of its picture to the right"
    )
    camera_turn: float = param(
        0.0, unit="rad", ge=-0.5, le=0.5, doc="of the camera off straight back, positive to the robot's left"
    )
    laser: LaserPose | None = param(None, doc="the rear laser on the robot; none: as `tf` tells")  # noqa: RUF009

    @property
    def formation(self) -> FormationParams:
        """Of the control law.

        Raises:
            ValueError: Numbers do not fit each other; the text says which.
        """
        return FormationParams(
            distance=self.distance,
            distance_gain=self.distance_gain,
            steering_gain=self.steering_gain,
            dead_band=self.dead_band,
            max_linear=self.max_linear,
            max_angular=self.max_angular,
            slow_after=self.slow_after,
            stop_after=self.stop_after,
            least_face_rate=self.least_face_rate,
            predict=self.predict,
        )

    @property
    def operator(self) -> OperatorParams:
        """Of the choice of the operator.

        Raises:
            ValueError: ``near`` is not below ``far``.
        """
        if self.near >= self.far:
            raise ValueError(f"near must be below far, not {self.near} and {self.far}")
        gone = max(OperatorParams().gone, self.far + _BEYOND)
        return OperatorParams(near=self.near, far=self.far, side=self.side, gone=gone)
