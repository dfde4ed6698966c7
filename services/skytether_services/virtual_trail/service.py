"""The shell of the virtual trail: topics in, `Guide`, topic out."""

from __future__ import annotations

from skytether.messages import JointState, Odometry, Twist, Vector3, WrenchStamped, yaw_of
from skytether.service import ConfigError, Input, Output, Service
from skytether_services.virtual_trail.guide import Guide
from skytether_services.virtual_trail.odometry import Wheels
from skytether_services.virtual_trail.params import Params
from skytether_services.virtual_trail.path import Pose


class VirtualTrail(Service[Params]):
    """Guides a person with a smart walker along a trail."""

    rate_hz = 100.0

    force = Input(WrenchStamped)
    wheels = Input(JointState)
    odom = Input(Odometry)
    cmd_vel = Output(Twist)

    def start(self) -> None:
        try:
            self._guide = Guide(self.params)
        except ValueError as error:
            raise ConfigError(str(error)) from error

    def step(self, now: float) -> None:
        if force := self.force.take():
            self._guide.force(force.message.wrench.force.x, force.received_at)
        if (wheels := self.wheels.take()) and (sample := wheels_of(wheels.message)):
            self._guide.wheels(sample, wheels.received_at)
        if odom := self.odom.take():
            self._guide.odometry(odom.message.header.stamp.seconds(), pose_of(odom.message))
        if velocity := self._guide.step(now):
            self.cmd_vel.publish(Twist(Vector3(x=velocity.linear), Vector3(z=velocity.angular)))


def wheels_of(message: JointState) -> Wheels | None:
    """Both wheels' angles, wherever they stand in the message; None if one is missing."""
    angles = dict(zip(message.name, map(float, message.position), strict=False))
    try:
        return Wheels(message.header.stamp.seconds(), angles["left_wheel"], angles["right_wheel"])
    except KeyError:
        return None


def pose_of(message: Odometry) -> Pose:
    """Pose in the plane."""
    pose = message.pose.pose
    return Pose(pose.position.x, pose.position.y, yaw_of(pose.orientation))
