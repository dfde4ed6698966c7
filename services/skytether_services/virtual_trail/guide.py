"""The guiding loop of the virtual trail, without clocks and topics (thesis section 2.5.1, figure 12).

Forces, wheel angles and odometry go in as they come; each step gives the velocity to command, or None while the
walker's place is not known yet.
"""

from __future__ import annotations

import math

from skytether.control.admittance import STANDSTILL, AdmittanceParams, Velocity, angular_step, linear_step
from skytether_services.virtual_trail.filter import LowPass
from skytether_services.virtual_trail.follower import orientation_error, preview_distance
from skytether_services.virtual_trail.odometry import Odometry, Wheels
from skytether_services.virtual_trail.params import Params, path_of
from skytether_services.virtual_trail.path import Pose

_WINDOW = 0.5
"""How far ahead of the last place on the trail the next one is looked for, m."""

_JUMP = 0.25
"""A pose that moves further than this between two steps is a new place, m: twice the way of half a second."""

_STRONGEST = 500.0
"""No person pushes harder, N; a broken sensor must not charge the filter for seconds."""

_MOST_ANGLE = 1e9
"""Of a wheel [rad]: it would have rolled round the earth more than once."""
_LONGEST_STEP = 0.05
"""A step that comes later than this after the last one counts as this, s: a stalled machine makes no leap."""


def modified_torque(*, gain: float, linear: float, distance: float, error: float) -> float:
    """Eq. 2.4: tau_v = k_tau v_c d tanh(error) [N m].

    Args:
        gain: k_tau [N s/m].
        linear: v_c, the commanded forward velocity [m/s]: who walks slowly is turned slowly.
        distance: d, between both force sensors [m].
        error: Orientation error [rad].
    """
    return gain * linear * distance * math.tanh(error)


def end_limit(remaining: float, *, rate: float, creep: float) -> float:
    """Largest forward velocity [m/s] so near the trail's end: falls in proportion, then creeps, then is zero.

    Args:
        remaining: Way to the end [m].
        rate: Velocity per way [1/s].
        creep: Velocity with which the end is reached [m/s]; without it the last millimetres would take for ever.
    """
    return max(rate * remaining, creep) if remaining > 0 else 0.0


class Guide:
    """One walker on one trail. Keeps nothing that its next inputs would not restore."""

    def __init__(self, params: Params) -> None:
        """Raises ValueError for a trail or an admittance that cannot be."""
        self._params = params
        self._path = path_of(params.trail)
        self._admittance = AdmittanceParams(
            mass=params.admittance_mass,
            damping=params.admittance_damping,
            angular_mass=params.angular_mass,
            angular_damping=params.angular_damping,
            max_linear=params.max_linear,
            max_angular=params.max_angular,
        )
        self._odometry = Odometry(radius=params.wheel_radius, track=params.wheel_track)
        self._filter = LowPass(params.force_cutoff)
        self._preview = preview_distance(
            torque_gain=params.torque_gain,
            sensor_distance=params.sensor_distance,
            angular_damping=params.angular_damping,
        )
        self._force: tuple[float, float] | None = None
        self._wheels_at = -math.inf
        self._velocity = STANDSTILL
        self._stepped_at: float | None = None
        self._place: tuple[Pose, float] | None = None

    @property
    def progress(self) -> float | None:
        """Arc length reached on the trail [m]; None until the walker's place is known."""
        return self._place[1] if self._place is not None else None

    def force(self, total: float, now: float) -> None:
        """Take a new force, F_l + F_r [N], that arrived now; what is not finite is ignored."""
        if math.isfinite(total):
            self._force = (min(max(total / 2, -_STRONGEST), _STRONGEST), now)

    def wheels(self, sample: Wheels, now: float) -> None:
        """Take new wheel angles that arrived now; what is no angle of a wheel, or not new, is ignored."""
        rolled = all(abs(angle) <= _MOST_ANGLE for angle in (sample.left, sample.right))  # false for NaN, too
        if math.isfinite(sample.stamp) and rolled and self._odometry.wheels(sample):
            self._wheels_at = now

    def odometry(self, stamp: float, pose: Pose) -> None:
        """Take the robot's own pose of its time ``stamp`` [s]; what is not finite is ignored."""
        if all(map(math.isfinite, (stamp, *pose))):
            self._odometry.anchor(stamp, pose)

    def go_on(self, velocity: Velocity) -> None:
        """Take the velocity that the walker was told, if it was not the last step's: the next goes on from it."""
        self._velocity = velocity

    def step(self, now: float) -> Velocity | None:
        """The velocity to command now; None while there is nothing to go by.

        Without a new force the last one keeps acting, which repeats the last command in effect (thesis section 2.5.1),
        until it or the wheels are older than ``input_timeout``. Then it says nothing, rather than zero: the robot
        notices silence at once and helps itself, while a stream of zeros would hold the person still.
        """
        dt = min(now - self._stepped_at, _LONGEST_STEP) if self._stepped_at is not None else 0.0
        self._stepped_at = now
        pose = self._odometry.pose
        if pose is None or self._force is None:
            return None
        force, force_at = self._force
        p = self._params
        if now - min(force_at, self._wheels_at) > p.input_timeout:
            self._filter.reset()
            self._velocity = STANDSTILL
            return None
        s = self._locate(pose)
        linear = linear_step(self._admittance, self._velocity.linear, self._filter.step(force, dt), dt)
        linear = min(linear, end_limit(self._path.length - s, rate=p.end_rate, creep=p.end_creep))
        error = orientation_error(self._path, pose, s, lateral_gain=p.lateral_gain, preview=self._preview)
        torque = modified_torque(gain=p.torque_gain, linear=linear, distance=p.sensor_distance, error=error)
        angular = angular_step(self._admittance, self._velocity.angular, torque, dt) if linear > 0 else 0.0
        self._velocity = Velocity(linear, angular)
        return self._velocity

    def _locate(self, pose: Pose) -> float:
        """Arc length of the nearest point: not behind the last one, but anywhere after a start or a jump."""
        low, high = 0.0, math.inf
        if self._place is not None:
            before, s = self._place
            if math.hypot(pose.x - before.x, pose.y - before.y) <= _JUMP:
                low, high = s, s + _WINDOW
        s = self._path.closest(pose.x, pose.y, low, high)
        self._place = (pose, s)
        return s
