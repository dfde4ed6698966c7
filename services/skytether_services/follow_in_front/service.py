"""The shell of following in front: topics in, `Follower`, topics out."""

from __future__ import annotations

import json
import math

from skytether.messages import (
    CompressedImage,
    LaserScan,
    Odometry,
    PointCloud,
    String,
    TFMessage,
    Twist,
    Vector3,
    yaw_of,
)
from skytether.service import ConfigError, Input, Lasting, MeanDelay, Output, Rate, Received, Service
from skytether_services.planar.frames import MOST_BYTES, Frames
from skytether_services.planar.geometry import Pose

from .face_tracker import FaceTracker
from .follower import Follower, Report, Scan
from .params import Params

_STEP_HZ = 60.0
"""How often is looked what came."""
_TOLD_HZ = 2.0
_EARLY = 0.8
"""A picture that comes after this share of the period of `Params.face_rate` is looked at: pictures come unevenly."""
_LASTS = 0.5
"""What lasts for so long [s] is reported."""


class FollowInFront(Service[Params]):
    """Keeps a robot ahead of the person who walks behind it and steers it with the face."""

    rate_hz = _STEP_HZ

    tf = Input(TFMessage, max_bytes=MOST_BYTES)
    picture = Input(CompressedImage, "usb_cam/image_raw/compressed")
    scan = Input(LaserScan)
    odom = Input(Odometry, "RosAria/pose")
    # Table 2 of the thesis sends these for its log; a recorder may run beside this service.
    front_scan = Input(LaserScan, "RosAria/laserscan")
    sonar = Input(PointCloud, "RosAria/sonar")

    cmd_vel = Output(Twist)
    status = Output(String)

    def start(self) -> None:
        params = self.params
        try:
            self._follower = Follower(params, FaceTracker(params.field_of_view).step)
        except ValueError as error:
            raise ConfigError(str(error)) from error
        self._frames = Frames()
        self._odom_frame, self._base_frame = "odom", "base_link"
        self._delay = MeanDelay()
        self._errors = {"scan": 0.0, "picture": 0.0}
        self._commands, self._tells = Rate(params.rate), Rate(_TOLD_HZ)
        self._looked_at = -math.inf
        self._told = ""
        self._lasting = Lasting()

    def step(self, now: float) -> None:
        self._listen(now)
        if self._commands.due(now):
            velocity = self._follower.step(now, self._delay.seconds, max(self._errors.values()))
            self.cmd_vel.publish(Twist(Vector3(x=velocity.linear), Vector3(z=velocity.angular)))
            self._publish_report(self._follower.report, now)
        # After the command, which is of this moment: a picture takes some milliseconds, or a stalled machine seconds.
        self._receive_picture(now)

    def _listen(self, now: float) -> None:
        """Hand what the robot measured on, but for pictures."""
        if tf := self.tf.take():
            self._delay.note(tf)
            self._frames.set_transforms(tf.message)
            if (found := self._frames.lookup(self._odom_frame, self._base_frame)) and math.isfinite(found[1]):
                self._follower.odometry(found[1], found[0], tf.made_at, now)
        if odom := self.odom.take():
            self._delay.note(odom)
            message = odom.message
            self._odom_frame = message.header.frame_id or self._odom_frame
            self._base_frame = message.child_frame_id or self._base_frame
            at = message.pose.pose
            pose = Pose(at.position.x, at.position.y, yaw_of(at.orientation))
            self._follower.odometry(message.header.stamp.seconds(), pose, odom.made_at, now)
        if scan := self.scan.take():
            self._errors["scan"] = scan.sent_at_error
            self._receive_scan(scan, now)

    def _receive_picture(self, now: float) -> None:
        """Look at a picture, if one came and is due."""
        if (picture := self.picture.take()) and now - self._looked_at >= _EARLY / self.params.face_rate:
            self._looked_at = now
            self._errors["picture"] = picture.sent_at_error
            self._follower.picture(picture.message.data.tobytes(), picture.made_at, now)

    def _receive_scan(self, received: Received[LaserScan], now: float) -> None:
        scan, laser = received.message, self.params.laser
        found = self._frames.lookup(self._base_frame, scan.header.frame_id) if laser is None else (laser.pose, 0.0)
        self._follower.laser_unknown = found is None
        if found is None:
            return
        limits = (scan.range_min, scan.range_max)
        stamp, at = scan.header.stamp.seconds(), received.made_at
        self._follower.scan(Scan(stamp, at, scan.ranges, scan.angle_min, scan.angle_increment, limits, found[0]), now)

    def _publish_report(self, report: Report, now: float) -> None:
        if self._lasting.due(report.code, now, _LASTS):
            self.report(report.code, report.message)
        if report.code != self._told or self._tells.due(now):
            self._told = report.code
            self.status.publish(String(json.dumps(_document(report))))


def _document(report: Report) -> dict[str, object]:
    operator = report.operator
    place = None
    if operator is not None:
        distance = math.hypot(operator.x, operator.y)
        place = {"distance": round(distance, 3), "x": round(operator.x, 3), "y": round(operator.y, 3)}
    return {
        "state": report.state,
        "code": report.code,
        "message": report.message,
        "operators": report.operators,
        "operator": place,
        "face": round(report.face, 4) if math.isfinite(report.face) else None,
        "face_rate": round(report.face_rate, 2),
    }
