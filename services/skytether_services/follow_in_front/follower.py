"""The loop of following in front, without topics: scans and pictures in, a velocity and the reason out.

Times are the service's; whoever calls says when something was measured.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from skytether.control.admittance import Velocity
from skytether_services.planar.geometry import Pose
from skytether_services.planar.odometry_track import OdometryTrack, Reach
from skytether_services.planar.transforms import compose

from .camera_image import Picture, PictureError, decode
from .face_choice import FaceChoice, choose
from .face_tracker import Face
from .formation import Formation, State
from .operator import Operator, OperatorChoice, OperatorState
from .params import Params
from .status import SENTENCES, Code
from .tracker import PeopleTracker

_REACH = Reach(linear=2.0, angular=4.0, distance=0.15, turn=0.3)
"""What no robot does between two messages of its odometry."""
_WAITS = 0.3
"""A scan waits so long for the odometry of its moment, s."""
_MOST_WAITING = 8
"""So many scans wait at the most."""
_LAG = 0.1
"""From a velocity's arrival to half of its effect: the base's period and its wheels, s."""
_MOST_DELAY = 1.0
"""Nothing is predicted further than this, s."""
_FACE_COUNTS = 0.5
"""A face speaks for somebody's being a person for so long, s."""


class Scan(NamedTuple):
    """A laser's sweep.

    Attributes:
        stamp: By the robot's clock [s].
        at: When it was made, by the service's [s].
        ranges: [m].
        first: Angle of the first ray [rad].
        step: Between neighbouring rays [rad].
        limits: Smallest and largest range that means something [m].
        mount: The laser on the robot.
    """

    stamp: float
    at: float
    ranges: NDArray[np.floating]
    first: float
    step: float
    limits: tuple[float, float]
    mount: Pose


@dataclass(frozen=True, slots=True)
class Report:
    """How it stands.

    Attributes:
        state: What the law does.
        code: Why.
        message: The same for people.
        operator: Who is followed; None: nobody.
        operators: So many were picked so far.
        face: Where the operator's face points off the robot's heading, positive to its left [rad]; NaN: not known.
        face_rate: Of the operator's face [Hz].
    """

    state: State
    code: Code
    message: str
    operator: Operator | None
    operators: int
    face: float
    face_rate: float


class Follower:
    """One robot ahead of one person.

    Args:
        params: Of the service.
        faces: Finds the faces of the next picture: `FaceTracker.step`.

    Raises:
        ValueError: Parameters do not fit each other; the text says which.
    """

    def __init__(self, params: Params, faces: Callable[[Picture], list[Face]]) -> None:
        self._params = params
        self._faces = faces
        self._formation = Formation(params.formation)
        self._tracker = PeopleTracker()
        self._choice = OperatorChoice(params.operator)
        self._track = OdometryTrack(_REACH)
        self._waiting: deque[tuple[Scan, float]] = deque(maxlen=_MOST_WAITING)
        self._operator: Operator | None = None
        self._scan_at = self._scan_came = self._odometry_came = -math.inf
        self._picture_at = self._picture_came = -math.inf
        self._only_face: tuple[float, float] | None = None
        self._picture_error = ""
        self.laser_unknown = False
        """Scans came, and nothing told where on the robot they were made."""
        self._face_choice = FaceChoice.NONE
        self._face = math.nan
        self._report = Report(State.STANDING, Code.LASER_SILENT, SENTENCES[Code.LASER_SILENT], None, 0, math.nan, 0.0)

    @property
    def report(self) -> Report:
        """How it stood at the last step."""
        return self._report

    def odometry(self, stamp: float, pose: Pose, at: float, now: float) -> None:
        """Take where the robot was, by its own reckoning, at its time ``stamp``, which was ``at`` here [s]."""
        before = self._track.newest
        self._track.add(stamp, pose, at)
        if self._track.newest is not before:
            self._odometry_came = now

    def scan(self, scan: Scan, now: float) -> None:
        """Take a sweep of the rear laser."""
        self._scan_came = now
        self._waiting.append((scan, now))
        self._try_scans(now)

    def picture(self, data: bytes, at: float, now: float) -> None:
        """Take a picture of the camera that was made at a time [s]."""
        self._picture_came = now
        if at <= self._picture_at:
            return
        self._picture_at, self._picture_error = at, ""
        try:
            faces = self._faces(decode(data))
        except PictureError as error:
            self._picture_error, self._face_choice = str(error), FaceChoice.NONE
            return
        turn = self._params.camera_turn
        faces = [face._replace(angle=face.angle + turn, bearing=face.bearing + turn) for face in faces]
        if faces:
            self._only_face = (faces[0].bearing, at) if len(faces) == 1 else None
        operator = self._operator
        legs = math.atan2(operator.y, -operator.x) if operator is not None else None
        face, self._face_choice = choose(faces, legs)
        self._face = face.angle if face is not None else math.nan
        if face is not None and operator is not None:
            self._formation.face(face.angle, at)

    def step(self, now: float, delay: float, doubt: float = 0.0) -> Velocity:
        """The velocity to command now.

        Args:
            now: [s].
            delay: A message's way from here to the robot [s].
            doubt: What was measured may be older by so much than was said [s]; inf: nobody knows how old it is.
        """
        self._try_scans(now)
        self._formation.doubt = doubt
        self._formation.lead = min(max(delay, 0.0), _MOST_DELAY) + _LAG
        velocity, state = self._formation.step(now)
        code = self._code(state, now)
        message = SENTENCES[code]
        if code is Code.BAD_PICTURE:
            message = f"{message}: {self._picture_error}."
        self._report = Report(
            state, code, message, self._operator, self._choice.picked, self._face, self._formation.face_rate
        )
        return velocity

    def _try_scans(self, now: float) -> None:
        """Look at the scans that wait, as soon as it is known where the robot was then."""
        waiting = list(self._waiting)
        self._waiting.clear()
        for scan, came in waiting:
            robot = self._track.pose_at(scan.stamp)
            if robot is not None:
                self._track_operator(scan, robot)
            elif now - came <= _WAITS:
                self._waiting.append((scan, came))

    def _track_operator(self, scan: Scan, robot: Pose) -> None:
        """Find the operator in a scan; where the robot was is known."""
        if scan.at <= self._scan_at:
            return
        self._scan_at = scan.at
        self._tracker.step(scan.ranges, scan.first, scan.step, scan.limits, compose(robot, scan.mount), scan.at)
        picked = self._choice.picked
        bearing, face_at = self._only_face or (math.nan, -math.inf)
        face = bearing if abs(scan.at - face_at) <= _FACE_COUNTS else None
        self._operator = self._choice.step(self._tracker.tracks, robot, scan.at, face=face)
        if self._choice.picked != picked:
            self._formation.lose()
        if self._operator is not None:
            o = self._operator
            self._formation.legs(o.x, o.y, o.vx, o.vy, o.seen_at)

    def _code(self, state: State, now: float) -> Code:
        """Why."""
        if state is State.FOLLOWING:
            return Code.FOLLOWING
        if state is State.FACE_SLOW:
            return Code.FACE_SLOW
        slow = self._params.slow_after
        if now - self._odometry_came > slow:
            return Code.ODOMETRY_SILENT
        if now - self._scan_came > slow:
            return Code.LASER_UNKNOWN if self.laser_unknown else Code.LASER_SILENT
        if now - self._scan_at + self._formation.doubt > self._params.stop_after:
            return Code.LATE
        if self._operator is None:
            by_choice = {OperatorState.SEVERAL: Code.SEVERAL_PEOPLE, OperatorState.LOST: Code.OPERATOR_LOST}
            return by_choice.get(self._choice.choice, Code.NO_OPERATOR)
        if now - self._operator.seen_at > slow:
            return Code.LATE if self._operator.seen_at >= self._scan_at else Code.OPERATOR_LOST
        return self._code_of_face(state, now)

    def _code_of_face(self, state: State, now: float) -> Code:
        slow = self._params.slow_after
        if now - self._picture_came > slow:
            return Code.CAMERA_SILENT
        if now - self._picture_at > slow:
            return Code.LATE
        if self._picture_error:
            return Code.BAD_PICTURE
        if self._face_choice is FaceChoice.SEVERAL:
            return Code.SEVERAL_FACES
        if self._face_choice is FaceChoice.NONE:
            return Code.NO_FACE
        if self._formation.aside:
            return Code.OPERATOR_ASIDE
        # An operator who was just picked: a picture of them is still to come, or the robot to stand first.
        return Code.NO_FACE if state is State.STANDING else Code.FOLLOWING
