"""Path follower: how far the walker's orientation is from the one that leads it along the trail.

The thesis takes the orientation error of eq. 2.4 from a kinematic path following controller ("defined in [79]"). This
is the usual form of that family: the desired orientation is the tangent of the trail, turned towards the trail by an
angle that grows with the lateral error and saturates at a right angle, ``theta_d = theta_path - atan(k e)``.

The tangent is the one a short distance ahead. Eq. 2.4 turns only in answer to an error, so without preview the walker
would run beside an arc with a standing error; see `preview_distance`. Delay needs no compensation: the loop closes over
the way covered, not over time, and 500 ms are 0.1 m at walking pace, less than the preview. (Predicting the pose over
the round trip was tried in simulation: the tracking error was 1 to 2 cm at 0 to 500 ms with and without.)
"""

from __future__ import annotations

import math

from skytether_services.virtual_trail.path import Path, Pose, wrap


def preview_distance(*, torque_gain: float, sensor_distance: float, angular_damping: float) -> float:
    """How far ahead to take the tangent so that an arc is followed without a standing error [m].

    By eq. 2.3 and 2.4 a walker in a steady turn has omega = k_tau v d tanh(error) / d_omega: it runs on a curvature of
    (k_tau d / d_omega) error, for small errors. The tangent of an arc of curvature c turns by c times the preview;
    that is the error needed for c if the preview is d_omega / (k_tau d).

    Args:
        torque_gain: k_tau [N s/m].
        sensor_distance: d [m].
        angular_damping: d_omega [N m s/rad].
    """
    return angular_damping / (torque_gain * sensor_distance)


def lateral_error(path: Path, pose: Pose, s: float) -> float:
    """Distance from the trail's point at arc length s, across its tangent [m]; positive to the left of the trail."""
    point = path.at(s)
    return -math.sin(point.heading) * (pose.x - point.x) + math.cos(point.heading) * (pose.y - point.y)


def orientation_error(path: Path, pose: Pose, s: float, *, lateral_gain: float, preview: float) -> float:
    """Desired minus actual orientation [rad] in [-pi, pi): positive means: turn left.

    Args:
        path: The trail.
        pose: Of the walker, in the trail's frame.
        s: Arc length of the trail's point beside the walker [m].
        lateral_gain: k, of the lateral error [1/m].
        preview: How far ahead the tangent is taken [m].
    """
    tangent = path.at(s + preview).heading
    return wrap(tangent - math.atan(lateral_gain * lateral_error(path, pose, s)) - pose.heading)
